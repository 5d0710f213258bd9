# SPDX-License-Identifier: Apache-2.0
"""ROS domains of this test process: claimed as a run claims its own, so that none meets another.

A context takes the next of them, for nodes of the last test leave the graph slowly.
"""

from __future__ import annotations

import os
import socket

_WANTED = 8
_DOMAINS = 100
_CLAIMS = []
_MINE = []


def _claim():
    """Domain that no other process holds, None if there is none left.

    The system lets go of it when this process ends.
    """
    first = os.getpid() % _DOMAINS
    for k in range(_DOMAINS):
        domain = 1 + (first + k) % _DOMAINS
        claim = socket.socket(socket.AF_UNIX)
        try:
            claim.bind(f'\0blf_dsc_controller domain {domain}')
        except OSError:
            claim.close()
            continue
        _CLAIMS.append(claim)
        return domain
    return None


def own_domain() -> int:
    """Domain that this process has not used lately."""
    if len(_MINE) < _WANTED:
        claimed = _claim()
        if claimed is not None:
            _MINE.append(claimed)
            return claimed
    if not _MINE:  # on a very crowded machine one is shared
        _MINE.append(1 + os.getpid() % _DOMAINS)
    _MINE.append(_MINE.pop(min(1, len(_MINE) - 1)))  # the first is that of the environment
    return _MINE[-1]
