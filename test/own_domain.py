# SPDX-License-Identifier: Apache-2.0
"""ROS domains of this test process, claimed as a run claims its own, so that none is shared.

Each context takes the next one, because nodes of the last test leave the graph slowly.
"""

from __future__ import annotations

import os
from contextlib import ExitStack

from blf_dsc_controller.cli import session as isolation
from blf_dsc_controller.errors import BlfDscError

_WANTED = 8
_CLAIMS = ExitStack()  # released when this process exits
_MINE = []


def _claim():
    """Claim a domain that no other process holds; return None if none is left."""
    try:
        return _CLAIMS.enter_context(isolation.own_domain())
    except BlfDscError:
        return None


def own_domain() -> int:
    """Return a domain that this process has not used recently."""
    if len(_MINE) < _WANTED:
        claimed = _claim()
        if claimed is not None:
            _MINE.append(claimed)
            return claimed
    if not _MINE:  # on a crowded machine, share one
        _MINE.append(1 + os.getpid() % 100)
    _MINE.append(_MINE.pop(min(1, len(_MINE) - 1)))  # the first is the environment's
    return _MINE[-1]
