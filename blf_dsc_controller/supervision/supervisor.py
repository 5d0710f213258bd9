# SPDX-License-Identifier: Apache-2.0
"""Checks of every joint state and of every torque of the law; a failed one leads to the safe stop.

The supervisor reads no clock: the same calls lead to the same stops.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller import Safety
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.settings import LINEAR
from blf_dsc_controller.messages.journal import OUTSIDE_BOUND
from blf_dsc_controller.supervision.checks import is_valid_state
from blf_dsc_controller.supervision.watchdogs import Overruns

Vector = NDArray[np.float64]
_NANO = 1e-9


class Phase(str, Enum):
    """What the controller is doing."""

    __str__ = str.__str__

    INACTIVE = 'inactive'  # not in command: the safe torque, or on the ramp to it
    STARTING = 'starting'  # waiting for the first joint state
    APPROACHING = 'approaching'  # on the way to the reference
    TRACKING = 'tracking'
    SAFE_STOP = 'safe stop'  # the safe torque until the next reset or activation


class Reason(str, Enum):
    """Why the controller stopped."""

    __str__ = str.__str__

    NONE = 'none'
    STATE_TIMEOUT = 'state timeout'
    STAMP_MISSING = 'stamp missing'
    STAMP_REPEATED = 'stamp repeated'
    STAMP_BACKWARD = 'stamp backward'
    STAMP_JUMP = 'stamp jump'
    BAD_MESSAGE = 'bad message'
    JOINT_MISSING = 'joint missing'
    JOINT_DUPLICATED = 'joint duplicated'
    FIELD_MISSING = 'field missing'
    NOT_FINITE = 'measurement not finite'
    VELOCITY = 'velocity not plausible'
    START_REJECTED = 'start rejected'
    OUTSIDE_BOUND = OUTSIDE_BOUND
    SATURATED = 'torque saturated'
    OVERRUN = 'loop overrun'
    ESTIMATE = 'estimate not finite'
    TORQUE = 'torque not finite'
    FAILED = 'failed'


class Verdict(Enum):
    """What to do with a joint state."""

    USE = 'update the law'
    SKIP = 'ignore it'
    STOP = 'command the safe torque'


class Supervisor:
    """Phase of the controller and the reason of its last stop.

    Attributes:
        phase: what the controller is doing.
        reason, text: why it stopped, the latter with the figures; `NONE` and empty if it did not.
        overruns: missed states since the start.
        saturated: samples with a torque at its limit since the start.
        saturated_time: time that they have lasted without a break [s].
        repeated: states skipped because their stamp was repeated.
        stops: since the controller was configured.
        revision: how often phase, reason or text have been set.
    """

    def __init__(
        self,
        joints: Sequence[str],
        sample_time: float,
        on_stop: Callable[[], None] = lambda: None,
    ) -> None:
        """Start inactive; `sample_time` is T [s], and each stop calls `on_stop`."""
        self._joints = tuple(joints)
        self._sample_time = sample_time
        self._on_stop = on_stop
        self.phase = Phase.INACTIVE
        self.reason = Reason.NONE
        self.text = ''
        self.repeated = 0
        self.stops = 0
        self.revision = 0
        self._clear()
        self._one_sample = (0.5e9 * sample_time, 1.5e9 * sample_time)  # ns

    @property
    def running(self) -> bool:
        """Whether the law is in command."""
        return self.phase in (Phase.TRACKING, Phase.APPROACHING)

    def enter(self, phase: Phase) -> None:
        """Begin a phase other than the safe stop, and clear the reason."""
        self.phase, self.reason, self.text = phase, Reason.NONE, ''
        self.revision += 1
        if phase in (Phase.STARTING, Phase.INACTIVE):
            self._clear()

    def _clear(self) -> None:
        self.overruns = Overruns()
        self.saturated = 0
        self.saturated_time = 0.0
        self._last_stamp = -1
        self._repeats = 0

    def stop(self, reason: Reason, text: str) -> Verdict:
        """Enter the safe stop, unless stopped already or inactive; always returns STOP."""
        if self.phase not in (Phase.SAFE_STOP, Phase.INACTIVE):
            self.phase, self.reason, self.text = Phase.SAFE_STOP, reason, text
            self.revision += 1
            self.stops += 1
            self._on_stop()
        return Verdict.STOP

    def check_state(
        self, safety: Safety, stamp: int, q: Vector, dq: Vector, effort: Vector | None = None
    ) -> Verdict:
        """Check a joint state (ns, rad, rad/s) before the law uses it; stop if it is not valid.

        `effort` are the applied torques (n,) [N m] if learning uses them.
        """
        if self.phase in (Phase.SAFE_STOP, Phase.INACTIVE):
            return Verdict.STOP
        verdict = Verdict.USE if self._is_next(stamp) else self._check_stamp(safety, stamp)
        if verdict is not Verdict.USE:
            return verdict
        if not is_valid_state(q, dq, safety.velocity_limit):
            return self._stop_by_values(safety, q, dq)
        if effort is not None and not np.isfinite(effort).all():
            return self.stop(Reason.NOT_FINITE, f'the efforts used for learning are {effort}')
        self._last_stamp = stamp
        return verdict

    def advance(self, stamp: int) -> None:
        """Take all states up to a stamp [ns] for checked, and their torques for below the limit."""
        self._last_stamp = stamp
        self.saturated_time = 0.0

    def _is_next(self, stamp: int) -> bool:
        """Whether a stamp is one sample after the last, with nothing to count."""
        shortest, longest = self._one_sample
        return (
            shortest < stamp - self._last_stamp < longest
            and self._last_stamp > 0
            and self._repeats == 0
            and self.overruns.fraction == 0.0
        )

    def _check_stamp(self, safety: Safety, stamp: int) -> Verdict:
        if stamp <= 0:
            return self.stop(
                Reason.STAMP_MISSING,
                f'a joint state has the stamp {stamp} ns, which is not a valid time',
            )
        if self._last_stamp < 0:
            return Verdict.USE
        step = (stamp - self._last_stamp) * _NANO
        if step == 0.0:
            return self._check_repeats(safety)
        self._repeats = 0
        if step < 0.0:
            text = f'the stamp of a joint state is {-step:.6g} s before the last one'
            return self.stop(Reason.STAMP_BACKWARD, text)
        if step > self._sample_time + safety.state_timeout:
            text = (
                f'the stamp of a joint state is {step:.6g} s after the last one: '
                f'{self._sample_time:g} s is the sample time, and it may be late by '
                f'{safety.state_timeout:g} s (safety.state_timeout)'
            )
            return self.stop(Reason.STAMP_JUMP, text)
        return self._count_missed(safety, step)

    def _check_repeats(self, safety: Safety) -> Verdict:
        self.repeated += 1
        self._repeats += 1
        if self._repeats <= safety.repeated_states:
            return Verdict.SKIP
        text = f'{self._repeats} joint states in a row repeat the stamp of the one before them'
        return self.stop(Reason.STAMP_REPEATED, text)

    def _count_missed(self, safety: Safety, step: float) -> Verdict:
        samples = max(1, round(step / self._sample_time))
        self.overruns.count_sample(samples, safety.overrun_window / self._sample_time)
        if self.overruns.fraction <= safety.overrun_fraction:
            return Verdict.USE
        text = (
            f'{100.0 * self.overruns.fraction:.0f} % of the joint states were missed: more than '
            f'safety.overrun_fraction allows over {safety.overrun_window:g} s'
        )
        return self.stop(Reason.OVERRUN, text)

    def _stop_by_values(self, safety: Safety, q: Vector, dq: Vector) -> Verdict:
        if not (np.isfinite(q).all() and np.isfinite(dq).all()):
            text = f'the joint state is not finite: positions {q}, velocities {dq}'
            return self.stop(Reason.NOT_FINITE, text)
        worst = int(np.argmax(np.abs(dq)))
        text = (
            f'the velocity of joint {self._joints[worst]!r} is {dq[worst]:+.6g} rad/s: more '
            f'than safety.velocity_limit, {safety.velocity_limit:g} rad/s'
        )
        return self.stop(Reason.VELOCITY, text)

    def check_sample(self, safety: Safety, controller: Controller, dt: float) -> bool:
        """Check a sample that `checks.check_sample` flagged, `dt` [s] after the one before.

        Returns False if its torque must not be used.
        """
        state, signals, sample = controller.state, controller.signals, controller.sample
        if not (np.isfinite(state.estimate).all() and np.isfinite(state.disturbance).all()):
            text = f'an estimate is not finite: {state.estimate}, disturbance {state.disturbance}'
            self.stop(Reason.ESTIMATE, text)
        # Saturation makes a finite torque of an infinite demand.
        elif not (np.isfinite(signals.demand).all() and np.isfinite(sample.torque).all()):
            self.stop(Reason.TORQUE, f'the demanded torque is not finite: {signals.demand}')
        else:
            if controller.settings.surface != LINEAR and safety.error_ratio > 0.0:
                self._check_error(safety, sample.xi1, sample.bound)
            self._check_saturation(safety, signals.demand, controller.settings.torque_limit, dt)
        return self.running

    def _check_error(self, safety: Safety, xi1: Vector, bound: Vector) -> None:
        ratio = np.abs(xi1) / bound
        worst = int(np.argmax(ratio))
        if ratio[worst] < safety.error_ratio:
            return
        share = '' if safety.error_ratio == 1.0 else f'{safety.error_ratio:g} times '
        text = (
            f'joint {self._joints[worst]!r} is {xi1[worst]:+.6g} rad from its reference: '
            f'past {share}its bound of {bound[worst]:.6g} rad'
        )
        self.stop(Reason.OUTSIDE_BOUND, text)

    def _check_saturation(self, safety: Safety, demand: Vector, limit: Vector, dt: float) -> None:
        worst = int(np.argmax(np.abs(demand) - limit))
        is_saturated = bool(np.abs(demand[worst]) > limit[worst])
        self.saturated += is_saturated
        self.saturated_time = self.saturated_time + dt if is_saturated else 0.0
        if self.saturated_time <= safety.saturation_time:
            return
        text = (
            f'joint {self._joints[worst]!r} needs {demand[worst]:+.4g} N m and has been at '
            f'its limit of {limit[worst]:g} N m for {self.saturated_time:.4g} s'
        )
        self.stop(Reason.SATURATED, text)
