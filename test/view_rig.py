# SPDX-License-Identifier: Apache-2.0
"""Operation of the page's controls without a browser."""

from __future__ import annotations

from types import SimpleNamespace

HAND = object()  # stands for the browser that an event comes from


def click(button):
    """Call the callbacks of a click on a button."""
    for callback in button._impl.update_cb:
        callback(SimpleNamespace(client=HAND, target=button))


def nodes(page):
    """Return the names of all objects drawn in the 3D scene."""
    return set(page.server.scene._handle_from_node_name)
