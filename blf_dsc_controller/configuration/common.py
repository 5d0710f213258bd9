# SPDX-License-Identifier: Apache-2.0
"""Parameters and checks that several nodes share."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, TypeAlias

from blf_dsc_controller.configuration.schema import counted, parameter

PerJoint: TypeAlias = Annotated[tuple[float, ...], 'joints']
"""Array with one entry per joint."""

_ROUNDING = 1e-12  # relative; the product of a decimal fraction and 1e9 is off by a few 1e-16

_at_start = partial(parameter, read_only='the process requests it once, before the first sample')


@dataclass(frozen=True)
class Realtime:
    """What the process requests from the operating system."""

    priority: int = _at_start(
        0,
        'SCHED_FIFO priority to request, below 50, which is that of controller_manager; 0: leave '
        'scheduling as it is',
        at_least=0,
        at_most=99,
    )
    lock_memory: bool = _at_start(False, 'lock the memory of the process, to prevent swapping')


def autostart() -> Any:
    """Declare whether a lifecycle node activates itself."""
    return parameter(
        True,
        'configure and activate the node at once; false: wait for a lifecycle manager',
        read_only='it has no effect later',
    )


class Sampled:
    """A configuration with a sample time."""

    sample_time: float

    @property
    def sample_time_ns(self) -> int:
        """The sample time in nanoseconds, the unit of the stamps."""
        return round(self.sample_time * 1e9)

    def sample_time_problems(self) -> list[str]:
        """Require whole nanoseconds, or stamps would drift from the time in the law."""
        if abs(self.sample_time * 1e9 - self.sample_time_ns) <= _ROUNDING * self.sample_time_ns:
            return []
        got = f'got {self.sample_time!r} s, not a whole number of nanoseconds'
        return [f'sample_time: {got}: write {self.sample_time_ns * 1e-9:.9f}']


def joint_problems(joints: tuple[str, ...], arm: str, needed: int | None) -> list[str]:
    """Require distinct names, since joints are matched by name, and as many as the arm needs."""
    repeated = sorted({name for name in joints if joints.count(name) > 1})
    problems = [f'joints: the name {name!r} is repeated' for name in repeated]
    if '' in joints:
        problems.append('joints: a name is empty')
    if needed is not None and len(joints) != needed:
        got = counted(len(joints), 'name', 'names')
        problems.append(f'joints: got {got}, but {arm} has {needed} joints')
    return problems
