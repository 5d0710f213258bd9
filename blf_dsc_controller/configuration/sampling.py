# SPDX-License-Identifier: Apache-2.0
"""What each node that takes part in the loop is told about time and scheduling."""

from __future__ import annotations

from dataclasses import dataclass

from blf_dsc_controller.configuration.parameter import parameter

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
        False,  # noqa: FBT003
        'keep all memory of the process from being swapped out',
        read_only=_AT_START,
    )


def nanoseconds(sample_time: float) -> int:
    """The sample time [s] in nanoseconds, the unit that stamps are counted in."""
    return round(sample_time * 1e9)


def sample_time_problems(sample_time: float) -> list[str]:
    """A sample time must be whole nanoseconds, or stamps would drift from the time in the law."""
    whole = nanoseconds(sample_time)
    if abs(sample_time * 1e9 - whole) <= _ROUNDING * whole:
        return []
    return [
        f'sample_time: got {sample_time!r} s, which is not a whole number of nanoseconds: '
        f'write {whole * 1e-9:.9f}'
    ]


_ROUNDING = 1e-12
"""Relative; the product of a decimal fraction and 1e9 is off by a few 1e-16."""


def joint_problems(joints: tuple[str, ...]) -> list[str]:
    """Joints are matched by name, so each needs a name of its own."""
    repeated = sorted({name for name in joints if joints.count(name) > 1})
    problems = [f'joints: {name!r} is there more than once' for name in repeated]
    return problems + ['joints: a name is empty'] * ('' in joints)
