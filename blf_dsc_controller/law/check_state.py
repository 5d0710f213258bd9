# SPDX-License-Identifier: Apache-2.0
"""Flags of the compiled checks, their limits, and what they keep from past samples."""

from __future__ import annotations

from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.layout import Array, Cell, size_of, view_of
from blf_dsc_controller.law.oscillation import Oscillation

SUSPECT = 1
"""A value that is not finite, a torque demand past its limit, or too large an error."""

OUTSIDE = 2
"""An error outside its bound."""

NO_EFFECT = 8
"""Commands that do not reach the arm, or an arm that is held: see `effect`."""

INVALID = 4
"""A joint state that is not finite or too fast; the law did not use it."""


CONTRADICTION = 16
"""Velocities that are not those of the positions; the law did not use them. Goes with INVALID."""

OSCILLATES = 32
"""The arm oscillates: at the beginning, and again and again while it lasts."""


class Checks(NamedTuple):
    """Limits of the checks, and the values that they keep from past samples."""

    velocity_limit: Cell  # rad/s, of each joint; 0 disables all checks
    error_ratio: Cell  # |xi1| / k from which an error is suspect; 0: never
    ratio: Annotated[Array, 'n']  # largest |xi1| / k so far
    # estimates and d^3 of the last sample that was not suspect
    kept: Annotated[Array, 'm + n']
    sample_time: Cell  # s, for the check of the effect of commands; 0: none
    last: Annotated[Array, 'n']  # N m, command of the last sample
    # (N m)^2, mean square step of the commands over _CHATTERS
    chatter: Annotated[Array, 'n']
    at_rest: Cell  # s, since a joint has last moved
    q: Annotated[Array, 'n']  # rad, where it has
    qr: Annotated[Array, 'n']  # rad, the reference of then
    moved: Annotated[Array, 'm + n']  # estimates and d^3 of then
    # |xi1| / k of the sample that `consistent` is of, relaxed since
    least_ratio: Cell
    # estimates and d^3 from before the error grew
    consistent: Annotated[Array, 'm + n']
    # measured inertia of each joint over the assumed, of the same sample
    consistent_scale: Annotated[Array, 'n']
    recent: Annotated[Array, 'n']  # N m, average of the commands over _RECENT
    before: Annotated[Array, 'n']  # N m, average of them over _BEFORE
    compares: Cell  # 1: measured efforts are torques, to be compared with the commands
    lack: Annotated[Array, 'n']  # N m, average of commands less efforts over _RECENT
    # N m, of it the error of the model of what the drives add
    lack_in_motion: Annotated[Array, 'n']
    usual: Annotated[Array, 'n']  # N m, average of the lack over _BEFORE
    lacking: Cell  # s, since a lack has become too large
    read: Annotated[Array, '2 * n']  # q and dq as last read
    age: Cell  # s, since they were new
    used: Annotated[Array, '3 * n']  # the measurement that the law uses
    # of `sensor`, the readings of q and dq
    readings: Cell  # in a row so far
    last_read: Annotated[Array, '2 * n']
    read_before: Annotated[Array, '2 * n']
    noise: Annotated[Array, '2 * n']  # mean square
    resolution: Annotated[Array, 'n']  # rad, smallest change of a position; 0: none yet
    derived: Annotated[Array, 'n']  # rad/s, filtered velocity by the positions
    measured: Annotated[Array, 'n']  # rad/s, measured velocity through the same filter
    # (rad/s)^2, mean squares of their difference and of the larger of both
    mismatch: Annotated[Array, 'n']
    speed: Annotated[Array, 'n']
    oscillation: Oscillation


checks_of = view_of(Checks)
checks_size = size_of(Checks)
