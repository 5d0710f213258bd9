# SPDX-License-Identifier: Apache-2.0
"""Joint states as they arrive: turns counted on, and velocities that the positions show.

Velocities are compared with the positions between states in a row.  Those of an arm
that measures none, and those that contradict the positions once, are differenced.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.sensor import restart
from blf_dsc_controller.run import NANOSECOND
from blf_dsc_controller.supervision.recent_motion import is_gap
from blf_dsc_controller.supervision.supervisor import Fault
from blf_dsc_controller.supervision.velocity import Velocity
from blf_dsc_controller.supervision.wraps import Wraps

Vector = NDArray[np.float64]


class Readings:
    """Reads the joint states of an arm, one after the other.

    Measurements are [q (n,) rad, dq (n,) rad/s, effort (n,) N m], stamps in ns.

    Attributes:
        gap: time [s] between the last state, used or not, and the one before.
        is_after_gap: whether this time is too long to compare the two.
    """

    def __init__(self, config: ControllerConfig, controller: Controller) -> None:
        """Compare velocities with positions by the checks of the controller."""
        self.gap = 0.0
        self.is_after_gap = False
        self._controller = controller
        self._n = len(config.joints)
        self._sample_time = config.sample_time
        self._wraps = Wraps(config)
        is_estimated = config.safety.velocity == 'estimated'
        self._velocity = Velocity(self._n) if is_estimated else None
        self._seen = self._before = 0  # stamps of the last state, and of the one before

    def take_stamp(self, stamp: int) -> None:
        """Begin a state; velocities are compared anew unless it follows the one before."""
        self.gap = (stamp - self._seen) * NANOSECOND
        self.is_after_gap = is_gap(self.gap, self._sample_time)
        self._before, self._seen = self._seen, stamp
        if self.gap < 0.0 or self.is_after_gap:
            self.compare_anew()

    def compare_anew(self) -> None:
        """Compare velocities with positions from the next state on."""
        restart(self._controller.checks.sensor)

    def skip(self) -> None:
        """Let the next state follow the one before this one, which is not trusted."""
        self._seen = self._before

    def count_turns(
        self, measurement: Vector, fastest: Vector
    ) -> tuple[Vector, Fault | None]:
        """Return a measurement with turns counted on, and a wrap that cannot be one.

        `fastest` (n,) [rad/s] is the largest speed of each joint.
        """
        return self._wraps.count(measurement, self.gap, fastest)

    def replace_velocities(self, stamp: int, measurement: Vector) -> None:
        """Overwrite velocities in a measurement if they are differenced."""
        if self._velocity is not None:
            self._velocity.replace(stamp, measurement)

    def compare_velocities(self, measurement: Vector) -> bool:
        """Compare velocities with positions; return whether they contradict each other."""
        is_next = self.gap > 0.0 and not self.is_after_gap
        if not is_next or not np.isfinite(measurement[: -self._n]).all():
            return False
        return self._controller.compare_velocities(self.gap, measurement)

    def distrust_velocities(self, stamp: int, measurement: Vector) -> None:
        """Difference all velocities from the positions, from this measurement on."""
        sensor = self._controller.checks.sensor
        self._velocity = Velocity(self._n)
        before = stamp - round(self.gap / NANOSECOND)
        self._velocity.begin(before, sensor.read_before[: self._n])
        self._velocity.replace(stamp, measurement)
        restart(sensor)

    def believe_positions(self) -> None:
        """Take the next positions of joints with a range as they are."""
        self._wraps.restart()

    def restart(self) -> None:
        """Begin with the next state, for a new start."""
        if not self._wraps.restart():
            return
        # to positions that differ from those before
        self.compare_anew()
        if self._velocity is not None:
            self._velocity = Velocity(self._n)

    @property
    def velocity(self) -> Vector:
        """Velocity (n,) [rad/s] that the positions show, behind a low pass."""
        return self._controller.checks.sensor.derived

    @property
    def speed(self) -> float:
        """Largest speed of a joint [rad/s], as the positions show it."""
        return float(np.abs(self.velocity).max())

    def slow(self, limit: Vector) -> Vector:
        """Return velocities (n,) to be damped in a stop, as the positions show them.

        `limit` (n,) [rad/s] is the largest.
        """
        return np.minimum(np.maximum(self.velocity, -limit), limit)  # faster than clip
