# SPDX-License-Identifier: Apache-2.0
"""What each node that takes part in the loop is told about time and scheduling."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from blf_dsc_controller.configuration.schema import parameter

_ROUNDING = 1e-12
"""Relative; the product of a decimal fraction and 1e9 is off by a few 1e-16."""

_AT_START = 'the process asks for it once, before the first sample'


@dataclass(frozen=True)
class Realtime:
    """What the process asks of the operating system."""

    priority: int = parameter(
        0,
        'SCHED_FIFO priority asked for; 0 leaves scheduling as it is',
        at_least=0,
        at_most=99,
        read_only=_AT_START,
    )
    lock_memory: bool = parameter(
        False,
        'keep all memory of the process from being swapped out',
        read_only=_AT_START,
    )


def autostart() -> Any:
    """Field of a managed node that says whether it waits for a manager."""
    return parameter(
        True,
        'configure and activate the node at once; false: wait for a manager to do it',
        read_only='it only matters at the start',
    )


def nanoseconds(sample_time: float) -> int:
    """Return the sample time [s] in nanoseconds, the unit that stamps are counted in."""
    return round(sample_time * 1e9)


def sample_time_problems(sample_time: float) -> list[str]:
    """Ask for whole nanoseconds, or stamps would drift from the time in the law."""
    whole = nanoseconds(sample_time)
    if abs(sample_time * 1e9 - whole) <= _ROUNDING * whole:
        return []
    problem = (
        f'sample_time: got {sample_time!r} s, no whole number of nanoseconds: '
        f'write {whole * 1e-9:.9f}'
    )
    return [problem]


def joint_problems(joints: tuple[str, ...]) -> list[str]:
    """Ask for a name of its own for each joint, since joints are matched by name."""
    repeated = sorted({name for name in joints if joints.count(name) > 1})
    problems = [f'joints: {name!r} is there more than once' for name in repeated]
    return problems + ['joints: a name is empty'] * ('' in joints)
