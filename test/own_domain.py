# SPDX-License-Identifier: Apache-2.0
"""ROS domains of this test process, claimed as a run claims its own: nobody else is in them.

Each context takes the next one, because nodes of the last test leave the graph slowly. Nor does
it take one in which this process has left something: a rig that other tests share, or a node.
"""

from __future__ import annotations

from contextlib import ExitStack

from blf_dsc_controller.cli import domains

_WANTED = 8
_CLAIMS = ExitStack()  # released when this process exits
_MINE = []


def avoid_domain_of_shell():
    """Claim the domain of the shell, so that no run of a test enters it either."""
    claim = domains.claimed(domains.shell_domain())
    if claim is not None:  # else another process of these tests holds it
        _CLAIMS.enter_context(claim)


def own_domain() -> int:
    """Return a domain that this process has not used recently, and in which nobody is."""
    if len(_MINE) < _WANTED:
        _MINE.append(_CLAIMS.enter_context(domains.own_domain()))
        return _MINE[-1]
    for _ in _MINE:
        _MINE.append(_MINE.pop(1))  # the first is the environment's
        if not domains.bound_ports(_MINE[-1]):
            return _MINE[-1]
    raise RuntimeError(f'somebody is in each of the domains {_MINE}')
