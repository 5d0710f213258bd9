# SPDX-License-Identifier: Apache-2.0
"""The reference that a law follows, from its start on the arm: what is planned, and when."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.errors import StartError
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.reference.approach import (
    BlendedReference,
    MotionError,
    plan_resumption,
    plan_start,
)
from blf_dsc_controller.reference.retargeting import plan_stop
from blf_dsc_controller.reference.terms import remaining
from blf_dsc_controller.reference.turns import reference_near
from blf_dsc_controller.run import NANOSECOND
from blf_dsc_controller.supervision.start import (
    PreparedStart,
    can_take_over,
    prepared_start,
)

Vector = NDArray[np.float64]


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
        self._prepared = prepared_start(config, bound, positions)

    def drop_prepared(self) -> None:
        """Plan the next start by the configuration that is in force then."""
        self._prepared = None

    def plan_start(
        self, config: ControllerConfig, q: Vector, dq: Vector, *, again: bool
    ) -> BlendedReference:
        """Return the reference from q (n,) [rad] and dq (n,) [rad/s] on, at t = 0.

        It is the one of `prepare`, once, if the arm rests there.  `again`: it is not the
        first one of this controller.  Raises as `prepare` does.
        """
        prepared = self._prepared
        self._prepared = None
        bound = self._controller.bound_at(0.0)
        if prepared is not None and prepared.fits(config, bound, q, dq):
            return prepared.motion
        return plan_start(config, bound, q, dq, again=again)

    def plan_resumption(
        self, config: ControllerConfig, stamp: int, q: Vector, dq: Vector
    ) -> BlendedReference | None:
        """Return the way back to the reference, None if the arm is too far from it.

        `stamp` [ns] is that of q (n,) [rad] and dq (n,) [rad/s].
        """
        if stamp <= self.last_stamp:
            return None
        t = self.time_of(stamp)
        bound = self._controller.bound_at(t)
        vector = self._controller.reference_vector
        try:
            return plan_resumption(config, bound, q, dq, vector, t)
        except (StartError, MotionError):
            return None

    def as_planned(
        self, config: ControllerConfig, stamp: int, q: Vector, dq: Vector
    ) -> BlendedReference | None:
        """Return the reference as it is, None if the arm is too far from it.

        The arguments are those of `plan_resumption`.
        """
        t = self.time_of(stamp)
        bound = self._controller.bound_at(t)
        vector = self._controller.reference_vector
        if stamp <= self.last_stamp:
            return None
        if not can_take_over(config, bound, q, dq, vector, t):
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
