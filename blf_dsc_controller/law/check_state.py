# SPDX-License-Identifier: Apache-2.0
"""Flags of the compiled checks, their limits, and what they keep from past samples."""

from __future__ import annotations

from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array, Cell, size_of, view_of
from blf_dsc_controller.law import effect, kept_estimates, oscillation, repeats, sensor

SUSPECT = 1
"""A value that is not finite, a torque demand past its limit, or too large an error."""

OUTSIDE = 2
"""An error outside its bound."""

INVALID = 4
"""A joint state that is not finite or too fast; the law did not use it."""

NO_EFFECT = 8
"""Commands that do not reach the arm, or an arm that is held: see `effect`."""

CONTRADICTION = 16
"""Velocities that are not those of the positions; the law did not use them. Goes with INVALID."""

OSCILLATES = 32
"""The arm oscillates: at the beginning, and again and again while it lasts."""

NOT_SENSORS = 64
"""The load observer is left out from now on: see `torque_sensors`."""


class Checks(NamedTuple):
    """Limits of the checks, and the values that these keep from past samples."""

    velocity_limit: Annotated[Array, 'n']  # rad/s; 0 disables all checks
    error_ratio: Cell  # |xi1| / k from which an error is suspect; 0: never
    sample_time: Cell  # s, for the checks over several samples; 0: none
    ratio: Annotated[Array, 'n']  # largest |xi1| / k so far
    estimates: kept_estimates.State
    repeats: repeats.State
    sensor: sensor.State
    effect: effect.State
    oscillation: oscillation.State


@inner
def are_on(checks: Checks) -> bool:
    """Whether anything is checked: neither by default nor in a `Controller.trial`."""
    return bool(checks.velocity_limit[0] > 0.0)


checks_of = view_of(Checks)
checks_size = size_of(Checks)
