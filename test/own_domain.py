# SPDX-License-Identifier: Apache-2.0
"""ROS domains of this test process, claimed as a run claims its own, so that none is shared.

Each context takes the next one, because nodes of the last test leave the graph slowly.
"""

from __future__ import annotations

import os
from contextlib import ExitStack, suppress

from blf_dsc_controller.cli import session as isolation
from blf_dsc_controller.errors import BlfDscError

_WANTED = 8
_CLAIMS = ExitStack()  # released when this process exits
_MINE = []


def own_domain() -> int:
    """Return a domain that this process has not used recently."""
    if len(_MINE) < _WANTED:
        with suppress(BlfDscError):  # if other processes hold them all
            _MINE.append(_CLAIMS.enter_context(isolation.own_domain()))
            return _MINE[-1]
    if not _MINE:  # on a crowded machine, share one
        _MINE.append(1 + os.getpid() % 100)
    _MINE.append(_MINE.pop(min(1, len(_MINE) - 1)))  # the first is the environment's
    return _MINE[-1]
