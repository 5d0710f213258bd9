# SPDX-License-Identifier: Apache-2.0
"""What the controller is doing, why it stops, and the checks that find a reason to stop.

Those of joint states, of samples of the law and of silence each return a fault, or none. All but
that of silence read no clock, so the same states always have the same faults.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import Enum
from math import inf
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller import ControllerConfig, Safety
from blf_dsc_controller.law.checks import NO_EFFECT, OUTSIDE, SUSPECT
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.state import LINEAR
from blf_dsc_controller.messages.journal import OUTSIDE_BOUND

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
    NO_EFFECT = 'commands without effect'
    SATURATED = 'torque saturated'
    OVERRUN = 'loop overrun'
    ESTIMATE = 'estimate not finite'
    TORQUE = 'torque not finite'
    FAILED = 'failed'


class Fault(NamedTuple):
    """Why the controller must stop: the reason, and a sentence with the values."""

    reason: Reason
    text: str


class Supervisor:
    """Phase of the controller and the reason of its last stop.

    Attributes:
        phase: what the controller is doing.
        reason, text: why it stopped; `NONE` and empty if it did not.
        stops: number of stops since the controller was configured.
        revision: how often phase, reason or text have been set.
        running: whether the law is in command.
        uses_states: whether the law uses joint states: it runs or is about to start.
    """

    def __init__(self) -> None:
        self.stops = self.revision = 0
        self.enter(Phase.INACTIVE)

    def enter(self, phase: Phase) -> None:
        """Begin a phase other than the safe stop, and clear the reason."""
        self._set(phase, Reason.NONE, '')

    def stop(self, reason: Reason, text: str) -> bool:
        """Enter the safe stop; return False if already stopped or inactive."""
        if not self.uses_states:
            return False
        self._set(Phase.SAFE_STOP, reason, text)
        self.stops += 1
        return True

    def add(self, text: str) -> None:
        """Add to the text, without changing phase or reason."""
        self._set(self.phase, self.reason, '; '.join(filter(None, (self.text, text))))

    def _set(self, phase: Phase, reason: Reason, text: str) -> None:
        self.phase, self.reason, self.text = phase, reason, text
        self.running = phase in (Phase.TRACKING, Phase.APPROACHING)
        self.uses_states = self.running or phase is Phase.STARTING
        self.revision += 1


SKIP = Fault(Reason.NONE, '')
"""Returned for a state to ignore."""


def rate_mismatch(period: float, sample_time: float) -> str:
    """Return what to do about joint states that come every `period` [s]."""
    return (
        f'joint states come every {period:.3g} s, but sample_time is {sample_time:g} s: set '
        f'update_rate of controller_manager (100 Hz by default) to {1.0 / sample_time:.6g}, or '
        'sample_time to the period of the topic'
    )


_REPEATS = 3  # states in a row with the stamp of the one before that are ignored
_AVERAGED = 1.0  # s, over which missed states are


class StateCheck:
    """Checks joint states, one after the other.

    Attributes:
        repeated: states ignored because their stamp was repeated.
        missed: states missing between consecutive stamps, since the start.
        missed_fraction: fraction of missed states, averaged exponentially over a second; by their
            stamps, so a slow computer in lock-step misses none.
    """

    def __init__(self, joints: Sequence[str], sample_time: float) -> None:
        """`sample_time` is T [s]."""
        self._joints = tuple(joints)
        self._sample_time = sample_time
        self.repeated = 0
        self.restart()

    def restart(self) -> None:
        """Start with the next state, whatever its stamp."""
        self.missed = 0
        self.missed_fraction = 0.0
        self._last_stamp = -1
        self._repeats = 0

    def advance(self, stamp: int) -> None:
        """Mark all states up to a stamp [ns] as checked."""
        self._last_stamp = stamp

    def check(self, safety: Safety, stamp: int) -> Fault | None:
        """Return why the controller must stop, SKIP to ignore the state, or None to use it.

        The stamp is in ns; the values are checked by the law (`law.checks.is_valid_state`).
        """
        if stamp <= 0:
            text = f'a joint state has the stamp {stamp} ns, which is not a valid time'
            return Fault(Reason.STAMP_MISSING, text)
        is_first = self._last_stamp < 0
        step = self._sample_time if is_first else (stamp - self._last_stamp) * _NANO
        if step == 0.0:
            return self._check_repeats()
        self._repeats = 0
        if step < 0.0:
            text = f'the stamp of a joint state is {-step:.6g} s before the last one'
            return Fault(Reason.STAMP_BACKWARD, text)
        if step > self._sample_time + safety.state_timeout:
            text = (
                f'the stamp of a joint state is {step:.6g} s after the last one: '
                f'{self._sample_time:g} s is the sample time, and it may be late by '
                f'{safety.state_timeout:g} s (safety.state_timeout)'
            )
            return Fault(Reason.STAMP_JUMP, text)
        self._last_stamp = stamp
        return self._count_missed(safety, max(1, round(step / self._sample_time)) - 1)

    def _check_repeats(self) -> Fault:
        self.repeated += 1
        self._repeats += 1
        if self._repeats <= _REPEATS:
            return SKIP
        text = f'{self._repeats} joint states in a row repeat the stamp of the one before them'
        return Fault(Reason.STAMP_REPEATED, text)

    def _count_missed(self, safety: Safety, missed: int) -> Fault | None:
        keep = 1.0 - min(1.0, self._sample_time / _AVERAGED)
        self.missed += missed
        self.missed_fraction *= keep
        if missed:
            self.missed_fraction = 1.0 - (1.0 - self.missed_fraction) * keep**missed
        if self.missed_fraction <= safety.overrun_fraction:
            return None
        text = (
            f'{100.0 * self.missed_fraction:.0f} % of the joint states were missed: more than '
            'safety.overrun_fraction allows, or the arm sends them less often than every '
            f'{self._sample_time:g} s (sample_time)'
        )
        return Fault(Reason.OVERRUN, text)

    def invalid(self, safety: Safety, measurement: Vector) -> Fault:
        """Return the fault of an invalid [q (n,) rad, dq (n,) rad/s, effort (n,) N m]."""
        q, dq, _ = measurement.reshape(3, -1)
        if not np.isfinite(q).all():
            return Fault(Reason.NOT_FINITE, f'the positions are not finite: {q}')
        if not np.isfinite(dq).all():
            text = f'velocities are missing or not finite: {dq}'
            remedy = 'if the hardware measures none, set safety.velocity to estimated'
            return Fault(Reason.NOT_FINITE, f'{text}; {remedy}')
        worst = int(np.argmax(np.abs(dq)))
        text = (
            f'the velocity of joint {self._joints[worst]!r} is {dq[worst]:+.6g} rad/s: more '
            f'than safety.velocity_limit, {safety.velocity_limit:g} rad/s'
        )
        return Fault(Reason.VELOCITY, text)


_LIGHT = 0.5  # of the assumed inertia: less is worth saying
_RELIEF = 4  # s without saturation that make up for one with it: more than a fifth adds up


class SampleCheck:
    """Checks each sample of a controller, and keeps the estimates of the last valid one.

    Attributes:
        ratio: largest |xi1| / k_c of each joint since the start (n,).
        outside: samples past the bound since the start.
        saturated: samples with a torque at its limit since the start.
    """

    def __init__(self, config: ControllerConfig, controller: Controller) -> None:
        """Enable the checks of the controller."""
        controller.checks.sample_time[0] = config.sample_time
        controller.checks.compares[0] = float(config.robot.effort in ('whole', 'commanded'))
        self._joints = config.joints
        self._controller = controller
        self.ratio = controller.checks.ratio
        self._kept = controller.checks.kept
        self._saturation = 0  # ns, times _RELIEF
        self.set_limits(config.safety)
        self.keep()
        self.restart()

    def set_limits(self, safety: Safety) -> None:
        """Apply these limits to the next samples."""
        self._safety, checks = safety, self._controller.checks
        checks.velocity_limit[0], checks.error_ratio[0] = safety.velocity_limit, safety.error_ratio

    def restart(self) -> None:
        """Reset the counts, starting with the next sample."""
        self.ratio[:] = 0.0
        self.outside = self.saturated = 0
        self.relax()

    @property
    def saturated_time(self) -> float:
        """Time at a torque limit [s], less a quarter of the time without since then."""
        return self._saturation * 1e-9 / _RELIEF

    def relax(self, duration: float = inf) -> None:
        """Account for some time without saturation [s]."""
        # Whole nanoseconds: many samples at once leave what they leave one by one.
        left = self._saturation - round(duration * 1e9) if duration < inf else 0
        self._saturation = max(0, left)

    @property
    def estimate(self) -> Vector:
        """The kept estimate (m,)."""
        return self._kept[: self._controller.settings.m]

    @property
    def disturbance(self) -> Vector:
        """The kept disturbance estimate d^3 (n,) [N m]."""
        return self._kept[self._controller.settings.m :]

    def keep(self) -> None:
        """Keep the current estimates."""
        state = self._controller.state
        np.concatenate((state.estimate, state.disturbance), out=self._kept)

    def restore(self) -> None:
        """Reset the controller, but set its estimates to the kept ones."""
        self._controller.reset()
        state = self._controller.state
        state.estimate[:], state.disturbance[:] = self.estimate, self.disturbance

    def check(self, dt: float) -> Fault | None:
        """Return why the torque of a sample, `dt` [s] after the one before, must not be used."""
        flags = self._controller.flags
        if flags & OUTSIDE:
            self.outside += 1
        if not flags & SUSPECT:
            self.relax(dt)
            return None
        if flags & NO_EFFECT:
            return self._without_effect()
        fault = self._not_finite() or self._outside() or self._saturated(dt)
        if fault is None:
            self.keep()
        return fault

    def _not_finite(self) -> Fault | None:
        state, demand = self._controller.state, self._controller.signals.demand
        if not (np.isfinite(state.estimate).all() and np.isfinite(state.disturbance).all()):
            text = f'an estimate is not finite: {state.estimate}, disturbance {state.disturbance}'
            return Fault(Reason.ESTIMATE, text)
        # Saturation turns an infinite demand into a finite torque.
        if not (np.isfinite(demand).all() and np.isfinite(self._controller.sample.torque).all()):
            return Fault(Reason.TORQUE, f'the demanded torque is not finite: {demand}')
        return None

    def _without_effect(self) -> Fault:
        """Return to the estimates from before the commands had no effect."""
        checks, limit = self._controller.checks, self._controller.settings.torque_limit
        self._kept[:] = checks.moved
        if checks.lacking[0] > 0.0:
            lack = checks.lack - checks.known
            worst = int(np.argmax(np.abs(lack) / limit))
            text = (
                f'the effort of joint {self._joints[worst]!r} lacks {lack[worst]:+.4g} N m of '
                'what is commanded: release the brakes, and activate the effort controller; if the '
                'effort is not a torque in N m, set robot.effort to current or unknown'
            )
            return Fault(Reason.NO_EFFECT, text)
        change = checks.recent - checks.before
        worst = int(np.argmax(np.abs(change) / limit))
        text = (
            f'the torque of joint {self._joints[worst]!r} has changed by {change[worst]:+.4g} N m, '
            'but no joint has moved: release the brakes, and activate the effort controller'
        )
        return Fault(Reason.NO_EFFECT, text)

    def _outside(self) -> Fault | None:
        safety = self._safety
        if safety.error_ratio == 0.0 or self._controller.settings.surface == LINEAR:
            return None
        xi1, bound = self._controller.sample.xi1, self._controller.sample.bound
        ratio = np.abs(xi1) / bound
        worst = int(np.argmax(ratio))
        if ratio[worst] < safety.error_ratio:
            return None
        share = '' if safety.error_ratio == 1.0 else f'{safety.error_ratio:g} times '
        text = (
            f'joint {self._joints[worst]!r} is {xi1[worst]:+.6g} rad from its reference: '
            f'past {share}its bound of {bound[worst]:.6g} rad'
        )
        return Fault(Reason.OUTSIDE_BOUND, text + self._lightness(worst))

    def _lightness(self, joint: int) -> str:
        """Return what was found if the inertia of a joint's drive is far below the assumed."""
        settings, state = self._controller.settings, self._controller.state
        if state.gain_scale[joint] > _LIGHT:
            return ''
        assumed, error = settings.unsure_rotor[joint], state.rotor_error[joint]
        return (
            f'; its drive seems to have {assumed + error:.2g} kg m^2 instead of the {assumed:.2g} '
            f'assumed, too little for these gains to hold: give robot.rotor_inertia, or a wider '
            f'bound'
        )

    def _saturated(self, dt: float) -> Fault | None:
        """Count a sample in which a torque is at its limit: what else is suspect has stopped."""
        signals, limit = self._controller.signals, self._controller.settings.torque_limit
        needed = np.maximum(np.abs(signals.demand), np.abs(signals.demand - signals.added))
        self.saturated += 1
        self._saturation += _RELIEF * round(dt * 1e9)
        if self.saturated_time <= self._safety.saturation_time:
            return None
        worst = int(np.argmax(needed - limit))
        text = (
            f'joint {self._joints[worst]!r} needs {needed[worst]:.4g} N m and has been at '
            f'its limit of {limit[worst]:g} N m for {self.saturated_time:.4g} s (less a quarter '
            'of the time in between)'
        )
        return Fault(Reason.SATURATED, text)


_MOVING = 3e-4  # rad in a sample: three counts of an encoder of 16 bits
_PAUSE = 1_000_000_000  # ns without states, after which the arm is at rest, as at the start


class Velocity:
    """Replaces velocities with finite differences of positions.

    An arm in motion whose positions do not change for a sample has sent its last reading once more,
    with a new stamp: it is continued at its velocity.
    """

    def __init__(self, n: int) -> None:
        self._stamp = self._seen = -1  # ns, of the last new reading and of the last state
        self._q = np.zeros(n)
        self._dq = np.zeros(n)
        self._repeated = False

    def replace(self, stamp: int, measurement: Vector) -> None:
        """Overwrite dq in [q (n,) rad, dq (n,) rad/s, torque (n,)] with a stamp [ns]."""
        q, dq, _ = measurement.reshape(3, -1)
        if self._stamp < 0 or not 0 <= stamp - self._stamp < _PAUSE:
            self._dq[:] = 0.0
        elif stamp > self._seen:
            step, self._seen = (stamp - self._stamp) * 1e-9, stamp
            is_moving = float(np.abs(self._dq).max()) * step > _MOVING
            self._repeated = is_moving and not self._repeated and bool((q == self._q).all())
            if self._repeated:
                q += step * self._dq
                dq[:] = self._dq
                return
            self._dq[:] = (q - self._q) / step
        self._stamp = self._seen = stamp
        self._q[:] = q
        dq[:] = self._dq


PERIOD = 0.008
"""Time [s] between two checks of the steady clock."""

SAME_CLOCK = 60.0
"""Time [s] that a live stamp may differ from this computer's clock."""

_IN_TRANSIT = 0.001  # s past the limit, for a state on its way


class Watchdog:
    """Measures the silence since the last joint state.

    A check that is itself late proves nothing, since states may be waiting in the queue; the next
    check decides.

    Attributes:
        on: whether a silence leads to a stop.
        why_off: why it is off although safety.watchdog is `auto`; else empty.
        torques: number commanded in the current silence.
    """

    def __init__(self, steady: Callable[[], int], wall: Callable[[], int]) -> None:
        """`steady` and `wall` are the clocks [ns]."""
        self.on = False
        self.why_off = ''
        self.torques = 0
        self._steady, self._wall = steady, wall
        self._last_state = -1
        self._last_check = -1

    def switch(self, mode: str, stamp: int) -> None:
        """Switch on or off; `auto`: on if the stamps [ns] are close to the `wall` clock."""
        self.why_off = ''
        behind = (self._wall() - stamp) * _NANO
        if mode == 'auto' and abs(behind) >= SAME_CLOCK:
            where = f'{abs(behind):.4g} s {"behind" if behind > 0.0 else "ahead of"}'
            self.why_off = (
                f"the stamps of the joint states are {where} this computer's clock: a silence is "
                'not detected; set safety.watchdog to on for an arm, or to off for a simulation'
            )
        self.on = mode != 'off' and not self.why_off

    def restart(self) -> None:
        """Measure the silence from now on."""
        self._last_state = self._steady()

    def wait(self) -> None:
        """Measure the silence from the next state on."""
        self._last_state = -1

    def silence(self, limit: float) -> float:
        """Return the length of a silence [s] if it exceeds `limit` [s], else 0."""
        now = self._steady()
        is_late = (now - self._last_check) * _NANO > 2.0 * PERIOD
        self._last_check = now
        silent = (now - self._last_state) * _NANO if self._last_state >= 0 else 0.0
        return silent if silent > limit + _IN_TRANSIT and not is_late else 0.0
