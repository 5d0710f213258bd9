# SPDX-License-Identifier: Apache-2.0
"""Whether to trust a joint state, and whether to trust the torque that answers it.

The supervisor is told everything and reads no clock, so the same calls lead to the same verdicts.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller import Safety
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.sample import Sample
from blf_dsc_controller.law.settings import LINEAR, Settings
from blf_dsc_controller.law.state import Signals
from blf_dsc_controller.supervision.checks import state_is_sound
from blf_dsc_controller.supervision.reasons import Phase, Reason
from blf_dsc_controller.supervision.watchdogs import Overruns, Saturation

Vector = NDArray[np.float64]
_NANO = 1e-9


class Trust(Enum):
    """What to do with a joint state."""

    USE = 'answer it'
    SKIP = 'as if it had not come'
    STOP = 'answer with the safe torque'


class Supervisor:
    """Phase of the controller and the reason of its last stop.

    Args:
        joints: names of the n joints, for the messages.
        sample_time: T [s].

    Attributes:
        phase: what the controller is doing.
        reason: why it stopped; `NONE` while it has not.
        text: the same in a sentence with the figures.
        saturation: torques at their limit.
        overruns: states missed.
        repeated: states passed over because their stamp was there before.
        stops: stops since the start.
        turns: times that phase, reason or text have been set.
    """

    def __init__(self, joints: Sequence[str], sample_time: float) -> None:
        self._joints = tuple(joints)
        self._sample_time = sample_time
        self.phase = Phase.INACTIVE
        self.reason = Reason.NONE
        self.text = ''
        self.repeated = 0
        self.stops = 0
        self.turns = 0
        self.saturation = Saturation()
        self.overruns = Overruns()
        self._last_stamp = -1
        self._repeats = 0
        self._one_sample = (0.5e9 * sample_time, 1.5e9 * sample_time)  # ns

    @property
    def running(self) -> bool:
        """Whether the law is in command."""
        return self.phase in (Phase.TRACKING, Phase.APPROACHING)

    def enter(self, phase: Phase) -> None:
        """Begin a phase that is no stop; earlier reasons are forgotten."""
        self.phase, self.reason, self.text = phase, Reason.NONE, ''
        self.turns += 1
        if phase in (Phase.STARTING, Phase.INACTIVE):
            self._last_stamp = -1
            self._repeats = 0
            self.saturation = Saturation()
            self.overruns = Overruns()

    def stop(self, reason: Reason, text: str) -> bool:
        """Enter the safe stop; False if there is nothing to stop, or it has been entered before."""
        if self.phase in (Phase.SAFE_STOP, Phase.INACTIVE):
            return False
        self.phase, self.reason, self.text = Phase.SAFE_STOP, reason, text
        self.turns += 1
        self.stops += 1
        return True

    def inspect(
        self, safety: Safety, stamp: int, q: Vector, dq: Vector, effort: Vector | None = None
    ) -> Trust:
        """Judge a state before the law sees it; what is wrong with it leads to the safe stop.

        Args:
            safety: the limits.
            stamp: of the state [ns].
            q: positions (n,) [rad].
            dq: velocities (n,) [rad/s].
            effort: applied torques (n,) [N m] where they are learned from.
        """
        if self.phase in (Phase.SAFE_STOP, Phase.INACTIVE):
            return Trust.STOP
        trust = Trust.USE if self._is_next(stamp) else self._inspect_stamp(safety, stamp)
        if trust is Trust.USE and not state_is_sound(q, dq, safety.velocity_limit):
            trust = self._distrust(safety, q, dq)
        if trust is Trust.USE and effort is not None and not np.isfinite(effort).all():
            trust = self._halt(Reason.NOT_FINITE, f'the efforts learned from are {effort}')
        if trust is Trust.USE:
            self._last_stamp = stamp
        return trust

    def _is_next(self, stamp: int) -> bool:
        """Whether a stamp follows the last as it should, so that there is nothing to count."""
        shortest, longest = self._one_sample
        step = stamp - self._last_stamp
        return (
            shortest < step < longest
            and self._last_stamp > 0
            and self._repeats == 0
            and self.overruns.fraction == 0.0
        )

    def _inspect_stamp(self, safety: Safety, stamp: int) -> Trust:
        if stamp <= 0:
            return self._halt(
                Reason.STAMP_MISSING, f'a joint state is stamped {stamp} ns, which is no time'
            )
        if self._last_stamp < 0:
            return Trust.USE
        step = (stamp - self._last_stamp) * _NANO
        if step == 0.0:
            return self._repeat(safety)
        self._repeats = 0
        if step < 0.0:
            text = f'a joint state is stamped {-step:.6g} s before the last one'
            return self._halt(Reason.STAMP_BACKWARD, text)
        if step > self._sample_time + safety.state_timeout:
            text = (
                f'a joint state is stamped {step:.6g} s after the last one: '
                f'{self._sample_time:g} s is the sample time, and it may be late by '
                f'{safety.state_timeout:g} s (safety.state_timeout)'
            )
            return self._halt(Reason.STAMP_JUMP, text)
        return self._count_missed(safety, step)

    def _repeat(self, safety: Safety) -> Trust:
        self.repeated += 1
        self._repeats += 1
        if self._repeats <= safety.repeated_states:
            return Trust.SKIP
        text = f'{self._repeats} joint states in a row repeat the stamp of the one before them'
        return self._halt(Reason.STAMP_REPEATED, text)

    def _count_missed(self, safety: Safety, step: float) -> Trust:
        samples = max(1, round(step / self._sample_time))
        self.overruns.take(samples, safety.overrun_window / self._sample_time)
        if self.overruns.fraction <= safety.overrun_fraction:
            return Trust.USE
        text = (
            f'{100.0 * self.overruns.fraction:.0f} % of the joint states were missed: more than '
            f'safety.overrun_fraction allows over {safety.overrun_window:g} s'
        )
        return self._halt(Reason.OVERRUN, text)

    def _distrust(self, safety: Safety, q: Vector, dq: Vector) -> Trust:
        if not (np.isfinite(q).all() and np.isfinite(dq).all()):
            text = f'the joint state is not finite: positions {q}, velocities {dq}'
            return self._halt(Reason.NOT_FINITE, text)
        worst = int(np.argmax(np.abs(dq)))
        text = (
            f'joint {self._joints[worst]!r} is said to move at {dq[worst]:+.6g} rad/s: more '
            f'than safety.velocity_limit, {safety.velocity_limit:g} rad/s'
        )
        return self._halt(Reason.VELOCITY, text)

    def accept(self) -> None:
        """Take note of an answer that there is nothing to say against."""
        self.saturation.lasted = 0.0

    def judge(self, safety: Safety, controller: Controller, dt: float) -> bool:
        """Judge what the law made of a state; False stops, and its torque must not be used.

        Args:
            safety: the limits.
            controller: the law, just updated.
            dt: time since the last sample [s].
        """
        state, signals, told = controller.state, controller.signals, controller.sample
        if not (np.isfinite(state.estimate).all() and np.isfinite(state.disturbance).all()):
            text = f'an estimate is not finite: {state.estimate}, disturbance {state.disturbance}'
            self._halt(Reason.ESTIMATE, text)
        # The limit makes a finite torque of a demand that is none.
        elif not (np.isfinite(signals.demand).all() and np.isfinite(told.torque).all()):
            text = f'the law asked for a torque that is not finite: {signals.demand}'
            self._halt(Reason.TORQUE, text)
        else:
            self._judge_error(safety, controller.settings, told)
            self._judge_torque(safety, controller.settings, signals, dt)
        return self.running

    def _judge_error(self, safety: Safety, settings: Settings, told: Sample) -> None:
        if settings.surface == LINEAR or safety.error_ratio == 0.0:
            return
        ratio = np.abs(told.xi1) / told.bound
        worst = int(np.argmax(ratio))
        if ratio[worst] < safety.error_ratio:
            return
        text = (
            f'joint {self._joints[worst]!r} is {told.xi1[worst]:+.6g} rad from its reference: '
            f'past {safety.error_ratio:g} times its bound of {told.bound[worst]:.6g} rad'
        )
        self._halt(Reason.OUTSIDE_BOUND, text)

    def _judge_torque(
        self, safety: Safety, settings: Settings, signals: Signals, dt: float
    ) -> None:
        excess = np.abs(signals.demand) - settings.torque_limit
        worst = int(np.argmax(excess))
        self.saturation.take(dt, saturated=bool(excess[worst] > 0.0))
        if self.saturation.lasted <= safety.saturation_time:
            return
        text = (
            f'joint {self._joints[worst]!r} needs {signals.demand[worst]:+.4g} N m and has had '
            f'only its limit of {settings.torque_limit[worst]:g} N m for '
            f'{self.saturation.lasted:.4g} s'
        )
        self._halt(Reason.SATURATED, text)

    def _halt(self, reason: Reason, text: str) -> Trust:
        self.stop(reason, text)
        return Trust.STOP
