# SPDX-License-Identifier: Apache-2.0
"""A hand on the page's controls, without a browser."""

from __future__ import annotations

from types import SimpleNamespace

HAND = object()  # stands for the browser that an event comes from


def click(button):
    """Call what a click on a button calls."""
    for callback in button._impl.update_cb:
        callback(SimpleNamespace(client=HAND, target=button))


def drag(slider, value):
    """Move a slider and call what that calls."""
    slider.value = value  # calls back, too, as from no browser
    for callback in slider._impl.update_cb:
        callback(SimpleNamespace(client=HAND, target=slider))


def nodes(page):
    """Names of all that is drawn in space."""
    return set(page.server.scene._handle_from_node_name)
