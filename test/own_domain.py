# SPDX-License-Identifier: Apache-2.0
"""ROS domains of this test process: claimed as `closed_loop` claims its own, so that none meets.

A context takes the next of them, for nodes of the last test leave the graph slowly.
"""

from __future__ import annotations

import itertools
import os
import socket

_WANTED = 8
_DOMAINS = 100
_CLAIMS = []


def _claimed():
    """Domains that no other process holds; the system lets go of them when this one ends."""
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
        yield domain


MINE = tuple(itertools.islice(_claimed(), _WANTED))
_NEXT = itertools.cycle(MINE[1:])


def own_domain() -> int:
    """Domain that this process has not used lately."""
    return next(_NEXT)
