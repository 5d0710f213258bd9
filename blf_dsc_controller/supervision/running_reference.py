# SPDX-License-Identifier: Apache-2.0
"""The reference that a law follows, from its start on the arm: what is planned, and when."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.errors import StartError
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.reference.approach import (
    AT_REST,
    BlendedReference,
    MotionError,
    check_takeover,
    plan_resumption,
    plan_start,
)
from blf_dsc_controller.reference.retargeting import plan_stop
from blf_dsc_controller.reference.terms import remaining
from blf_dsc_controller.reference.turns import reference_near
from blf_dsc_controller.run import NANOSECOND
from blf_dsc_controller.supervision.reading import Reading

Vector = NDArray[np.float64]

_SAME_PLACE = 0.05  # of the bound


class PreparedStart(NamedTuple):
    """A start that was planned before the first state."""

    positions: Vector  # rad, from which it begins at rest
    motion: BlendedReference

    def fits(
        self, config: ControllerConfig, bound: Vector, q: Vector, dq: Vector
    ) -> bool:
        """Whether it can be used for an arm at q (n,) [rad] with dq (n,) [rad/s].

        The bound (n,) [rad] is the one at the start.
        """
        moved = np.abs(q - self.positions)
        if not np.all(moved < _SAME_PLACE * np.array(config.barrier.bound)):
            return False
        if np.abs(dq).max() > AT_REST:
            return False
        try:
            check_takeover(config, bound, q, dq, self.motion.vector, 0.0)
        except StartError:
            return False
        return True


class RunningReference:
    """The reference of a controller, and the time of its law.

    Attributes:
        start_stamp: stamp of t = 0 [ns]; -1 before the first start.
        last_stamp: stamp of the law's last sample [ns].
        settled: end of the approach or of the blend into a trajectory [s].
        turned: how the configured reference is shifted by whole turns; empty if it is not.
        resumable: whether the next start may continue along it.
    """

    def __init__(self, controller: Controller) -> None:
        self.start_stamp = self.last_stamp = -1
        self.settled = 0.0
        self.turned = ''
        self.resumable = False
        self._controller = controller
        self._prepared: PreparedStart | None = None

    def time_of(self, stamp: int) -> float:
        """Return the time of a stamp [ns] since the start [s]."""
        return (stamp - self.start_stamp) * NANOSECOND

    @property
    def time(self) -> float:
        """Time of the last sample of the law [s]."""
        return self.time_of(self.last_stamp)

    def prepare(self, config: ControllerConfig, positions: Vector) -> None:
        """Plan the start from rest at `positions` (n,) [rad], before the first state.

        Raises:
            StartError: the law cannot take over there.
            MotionError: no approach from there keeps the limits.
        """
        bound = self._controller.bound_at(0.0)
        motion = plan_start(config, bound, positions, np.zeros(positions.size))
        self._prepared = PreparedStart(positions.copy(), motion)

    def drop_prepared(self) -> None:
        """Plan the next start by the configuration that is in force then."""
        self._prepared = None

    def plan_start(
        self, config: ControllerConfig, reading: Reading, *, again: bool
    ) -> BlendedReference:
        """Return the reference from a state on, at t = 0.

        It is the one of `prepare`, once, if the arm rests there.  `again`: it is not the
        first one of this controller.  Raises as `prepare` does.
        """
        prepared = self._prepared
        self._prepared = None
        bound, q, dq = self._controller.bound_at(0.0), reading.q, reading.dq
        if prepared is not None and prepared.fits(config, bound, q, dq):
            return prepared.motion
        return plan_start(config, bound, q, dq, again=again)

    def way_back(
        self, config: ControllerConfig, reading: Reading, *, as_planned: bool = False
    ) -> BlendedReference | None:
        """Return the way back to the reference, None if the arm is too far from it.

        `as_planned`: it is the reference as it is.
        """
        if reading.stamp <= self.last_stamp:
            return None
        t = self.time_of(reading.stamp)
        bound, vector = self._controller.bound_at(t), self._controller.reference_vector
        at = config, bound, reading.q, reading.dq, vector, t
        try:
            if not as_planned:
                return plan_resumption(*at)
            check_takeover(*at)
        except (StartError, MotionError):
            return None
        return BlendedReference(vector, self.settled)

    def start_at(self, stamp: int, config: ControllerConfig, q: Vector) -> None:
        """Let the time begin at a stamp [ns], at which the arm is at q (n,) [rad]."""
        self.start_stamp = stamp
        _, self.turned = reference_near(config, q)

    def follow_from_start(self, motion: BlendedReference) -> None:
        """Follow the motion of a start, or of the way back."""
        self._controller.reference_vector = motion.vector
        self.settled = motion.settled

    def follow(self, vector: Vector) -> None:
        """Follow a packed reference that continues the one in force."""
        self._controller.reference_vector = remaining(vector, self.time)
        self.settled = min(self.settled, self.time)

    def brake(self, config: ControllerConfig) -> float:
        """Bring the reference to rest within the limits; return when it rests [s]."""
        before = self._controller.reference_vector
        motion = plan_stop(before, self.time, config)
        self.follow(motion.vector)
        return motion.end
