# SPDX-License-Identifier: Apache-2.0
"""The torque ripple of the drives, by runs of the slow motion; found as `blf_dsc identify` does."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from blf_dsc_controller.commissioning.measurement import Measured, named
from blf_dsc_controller.commissioning.slow_motion import SECONDS
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.identification.identify import find_ripples
from blf_dsc_controller.identification.problem import Effort
from blf_dsc_controller.identification.recording import Recording, joined, resampled
from blf_dsc_controller.identification.ripple import (
    NOTHING,
    Listed,
    Ripples,
    listed_ripples,
)
from blf_dsc_controller.run import NANOSECOND, TURNING, Run


def ripples_in(
    runs: Sequence[Measured], names: Sequence[str] = ()
) -> tuple[Ripples, ...]:
    """Return what runs of a slow motion together show of each joint.

    `names` are those of the runs in errors.

    Raises BlfDscError if the arm stopped in one, or if one ended before its time.
    """
    recordings = []
    for measured, name in zip(runs, names or [''] * len(runs), strict=True):
        with named(name):
            recordings.append(_recording(measured.run))
    recording, _ = joined(*recordings)
    robot = runs[0].config.robot
    effort: Effort = 'command'
    if robot.drive_compensates != 'none':  # commands lack gravity
        effort = 'without-gravity'
    return find_ripples(recording, robot, effort)


def to_learn(ripples: Sequence[Ripples]) -> tuple[Listed, ...]:
    """Return the entries of `learning.ripple_cycles`: none of joints whose motion repeated."""
    return listed_ripples([NOTHING if each.repeats else each for each in ripples])


def _recording(run: Run) -> Recording:
    """Return positions and torques of a run, for the time that counts."""
    end = int(run.stamp[0]) + round(SECONDS / NANOSECOND)
    if run.stops and run.stops[0].stamp < end:
        stop = run.stops[0]
        after = NANOSECOND * (stop.stamp - int(run.stamp[0]))
        raise BlfDscError(
            f'the arm stopped {after:.3g} s after the start of the slow motion, which shows torque '
            f'ripple in {SECONDS:g} s: {stop.text}'
        )
    if run.stamp[-1] < end:
        raise BlfDscError(
            f'the run has {run.duration:.3g} s of the slow motion, which shows torque ripple in '
            f'{SECONDS:g} s'
        )
    rows = slice(int(np.searchsorted(run.stamp, end)))
    turning = np.array([run.units(joint) == TURNING for joint in run.joints])
    values = run.stamp[rows], run.position[rows], run.torque[rows]
    return resampled(run.joints, *values, 'commands', turning)
