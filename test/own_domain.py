# SPDX-License-Identifier: Apache-2.0
"""ROS domains of this test process, claimed as a run claims its own, so that none is shared.

Each context takes the next one, because nodes of the last test leave the graph slowly.
"""

from __future__ import annotations

import os
import socket

_WANTED = 8
_DOMAINS = 100
_CLAIMS = []
_MINE = []


def _claim():
    """Claim a domain that no other process holds; return None if none is left.

    The system releases it when this process exits.
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
    """Return a domain that this process has not used recently."""
    if len(_MINE) < _WANTED:
        claimed = _claim()
        if claimed is not None:
            _MINE.append(claimed)
            return claimed
    if not _MINE:  # on a crowded machine, share one
        _MINE.append(1 + os.getpid() % _DOMAINS)
    _MINE.append(_MINE.pop(min(1, len(_MINE) - 1)))  # the first is the environment's
    return _MINE[-1]
