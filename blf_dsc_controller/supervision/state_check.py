# SPDX-License-Identifier: Apache-2.0
"""Checks of joint states before the law uses them: stamps, missed and invalid states.

They read no clock, so the same states always have the same faults.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller_groups import Safety
from blf_dsc_controller.law.sensor import LONG_GAP
from blf_dsc_controller.run import NANOSECOND, JointUnits
from blf_dsc_controller.supervision.envelope import Motion
from blf_dsc_controller.supervision.reading import Doubt, Reading
from blf_dsc_controller.supervision.supervisor import Fault, Reason

Vector = NDArray[np.float64]
_PUBLISHER_PERIOD = 0.015  # s: joint_state_publisher has 10 Hz by default, Franka's 30
# states in a row with the stamp of the one before that are ignored
_IGNORED_REPEATS = 3
_CLOCK_MOTION = 0.02  # rad/s: a slower motion does not measure time
_CLOCK_RATIO = 0.5  # of the time by the stamps
_CLOCK_SPEED_RATIO = 0.5  # of the speed: an arm whose clock was set keeps its own
_MISSED_TIME = 1.0  # s, over which missed states are averaged
_MISSING = 0.4  # s of it, for which states may be missing

SKIP = Fault(Reason.NONE, '')
"""Returned for a state to ignore."""
_WRONG = 'a sensor is stuck or has the wrong sign, or the velocities are those of other joints'
_NO_VELOCITY = 'if the hardware measures none, set safety.velocity to estimated'


def rate_mismatch(period: float, sample_time: float) -> str:
    """Return what to do about joint states every `period` [s] instead of `sample_time` [s]."""
    received = f'joint states come every {period:.3g} s, but sample_time is {sample_time:g} s: '
    if period > _PUBLISHER_PERIOD and sample_time < _PUBLISHER_PERIOD:
        return (
            f'{received}this is the rate of a joint_state_publisher, not of an arm: subscribe to '
            'the topic of the joint_state_broadcaster itself (of franka_ros2: '
            '-r joint_states:=franka/joint_states), whose rate is update_rate of '
            'controller_manager'
        )
    return (
        f'{received}set update_rate of controller_manager (100 Hz by default) to '
        f'{1.0 / sample_time:.6g}, or '
        'sample_time to the period of the topic'
    )


def velocity_lag_remedy(lag: float) -> str:
    """Return what to do about velocities that come some time [s] after the positions."""
    return (
        f'velocities come about {1e3 * lag:.2g} ms after the positions: let the driver filter them '
        'less, set safety.velocity to estimated, or count that time in robot.lag and lower the '
        'gains'
    )


class StateCheck:
    """Checks joint states, one after the other.

    Attributes:
        repeated: states ignored because their stamp was repeated.
        missed: states missing between consecutive stamps, since the start.
        missed_fraction: fraction of missed states, averaged exponentially over a second; by their
            stamps, so a slow computer in lock-step misses none.
    """

    def __init__(
        self, joints: Sequence[str], units: Sequence[JointUnits], sample_time: float
    ) -> None:
        """`sample_time` is T [s]."""
        self._joints = tuple(joints)
        self._units = tuple(units)
        self._sample_time = sample_time
        self.repeated = 0
        self.restart()

    def restart(self) -> None:
        """Start with the next state, whatever its stamp."""
        self.missed = self._taken = 0
        self.missed_fraction = 0.0
        self._last_stamp = -1
        self._repeats = 0

    def check(self, safety: Safety, stamp: int) -> Fault | None:
        """Return why the controller must stop; SKIP: ignore the state; None: use it.

        The stamp is in ns; the values are checked by the law
        (`law.checks.is_valid_state`).
        """
        if stamp <= 0:
            text = f'a joint state has the stamp {stamp} ns, which is not a valid time'
            return Fault(Reason.STAMP_MISSING, text)
        is_first = self._last_stamp < 0
        step = (
            self._sample_time if is_first else (stamp - self._last_stamp) * NANOSECOND
        )
        if step == 0.0:
            return self._check_repeats()
        self._repeats = 0
        if step < 0.0:
            text = (
                f'the stamp of a joint state is {-step:.6g} s before the last one: the clock was '
                'set back, two nodes publish joint states, or the driver was restarted'
            )
            return Fault(Reason.STAMP_BACKWARD, text)
        if step > self._sample_time + safety.state_timeout:
            text = (
                f'the stamp of a joint state is {step:.6g} s after the last one: '
                f'{self._sample_time:g} s is the sample time, and it may be late by '
                f'{safety.state_timeout:g} s (safety.state_timeout). States were lost, or the '
                'clock was set'
            )
            return Fault(Reason.STAMP_JUMP, text)
        self._last_stamp = stamp
        self._taken += 1
        return self._count_missed(safety, max(1, round(step / self._sample_time)) - 1)

    @property
    def missed_per_state(self) -> float:
        """States missing between two that came, on average since the start."""
        return self.missed / max(self._taken - 1, 1)

    def ignores(self, *, is_copy: bool) -> bool:
        """Whether a state is one of a few with the stamp of the one before."""
        if not is_copy:
            self._repeats = 0
            return False
        self.repeated += 1
        self._repeats += 1
        return self._repeats <= _IGNORED_REPEATS

    def _check_repeats(self) -> Fault:
        """Return SKIP for one of a few states with the stamp of the one before, else the fault."""
        if self.ignores(is_copy=True):
            return SKIP
        text = (
            f'{self._repeats} joint states in a row repeat the stamp of the one before them: the '
            'driver has to stamp each'
        )
        return Fault(Reason.STAMP_REPEATED, text)

    def _count_missed(self, safety: Safety, missed: int) -> Fault | None:
        """Average the fraction of missed states; return the fault if it is too large."""
        retained = 1.0 - min(1.0, self._sample_time / _MISSED_TIME)
        self.missed += missed
        self.missed_fraction *= retained
        if missed:
            self.missed_fraction = 1.0 - (1.0 - self.missed_fraction) * retained**missed
        missing = self.missed_fraction * _MISSED_TIME
        tolerated = max(_MISSING, safety.state_timeout)
        if missing <= tolerated:
            return None
        text = (
            f'{100.0 * self.missed_fraction:.0f} % of the joint states were missed in the last '
            f'second, and {100.0 * tolerated:.0f} % may be: the computer is too slow, or the arm '
            'sends them less often than every '
            f'{self._sample_time:g} s (sample_time)'
        )
        return Fault(Reason.OVERRUN, text)

    def check_motion(self, reading: Reading, q: Vector, dq: Vector) -> Fault | None:
        """Return the fault of a reading that does not follow q and dq (n,) [rad, rad/s].

        Of one that comes after a gap, or is not finite, the law says what is wrong.
        """
        if reading.doubt is Doubt.OUT_OF_REACH and not reading.is_after_gap:
            return self._jumped(reading, q)
        if reading.doubt is Doubt.REPEATED:
            return self._hangs(reading)
        return self._clock_step(reading, q, dq)

    def _jumped(self, reading: Reading, before: Vector) -> Fault:
        """Return the fault of positions that no arm reaches from `before` (n,) [rad]."""
        step = reading.q - before
        worst = int(np.argmax(np.abs(step)))
        unit = self._units[worst].position
        text = (
            f'the position of joint {self._joints[worst]!r} jumps by {step[worst]:+.3g} {unit} in '
            f'{reading.gap:.3g} s, which no arm does: two nodes publish joint states, or a sensor '
            'is faulty'
        )
        return Fault(Reason.JUMPED, text)

    def _hangs(self, reading: Reading) -> Fault:
        """Return the fault of a reading that is repeated, with new stamps, of an arm in motion."""
        dq = reading.dq
        worst = int(np.argmax(np.abs(dq)))
        unit = self._units[worst].of('rad/s')
        text = (
            'joint states repeat the same positions and velocities, although joint '
            f'{self._joints[worst]!r} moves at {dq[worst]:+.3g} {unit}: the driver does not read '
            'its arm any more, or reads it less often than it stamps states'
        )
        return Fault(Reason.STAMP_REPEATED, text)

    def contradicted(
        self, derived: Vector, measured: Vector, lags: Sequence[float | None]
    ) -> Fault:
        """Return the fault of velocities (n,) [rad/s] that contradict the positions.

        Of each joint, `lags` has by how much they are late [s]; None: no lag explains it.
        """
        worst = int(np.argmax(np.abs(derived - measured)))
        lag = lags[worst]
        why = _WRONG if lag is None else velocity_lag_remedy(lag)
        unit = self._units[worst].of('rad/s')
        text = (
            f'the velocity of joint {self._joints[worst]!r} is {measured[worst]:+.3g} {unit}, but '
            f'its positions change by {derived[worst]:+.3g} {unit}: {why}; they are differenced '
            'from the positions from now on'
        )
        if measured[worst] == 0.0:  # a mean: it has always been 0
            text += f'; {_NO_VELOCITY}'
        return Fault(Reason.VELOCITY, text)

    def _clock_step(self, reading: Reading, q: Vector, dq: Vector) -> Fault | None:
        """Return a fault if the arm has moved from q (n,) [rad] for much less than the gap.

        One that has been braked or driven on since it moved at dq (n,) [rad/s] has had the time.
        """
        gap = reading.gap
        if gap < LONG_GAP * self._sample_time:
            return None
        mean = 0.5 * (reading.dq + dq)
        if np.abs(reading.dq - dq).max() > _CLOCK_SPEED_RATIO * np.abs(mean).max():
            return None
        speed = float(mean @ mean)
        if not speed >= _CLOCK_MOTION**2:
            return None  # also if it is not finite
        moved_for = float((reading.q - q) @ mean) / speed
        if not moved_for <= _CLOCK_RATIO * gap:
            return None
        text = (
            f'the stamp of a joint state is {gap:.4g} s after the last one, but the arm has moved '
            f'as far as in {max(0.0, moved_for):.2g} s, so the clock was set: let it be slewed '
            'instead (chrony: no makestep after the start)'
        )
        return Fault(Reason.STAMP_JUMP, text)

    def braked(self, asked: float, joint: int, motion: Motion, speeds: Vector) -> Fault:
        """Return the fault of a law that has asked for too much for so long [s].

        `joint` was braked most, in this `motion`; `speeds` (2, n) [rad/s] are the highest that are
        allowed downwards and upwards.
        """
        unit = self._units[joint].of('rad/s')
        down, up = speeds[:, joint]
        text = (
            f'joint {self._joints[joint]!r} moves at {motion.dq[joint]:+.3g} {unit}, '
            f'{motion.error[joint]:+.3g} {self._units[joint].position} from its reference, where '
            f'{-down:+.3g} to {up:+.3g} {unit} are allowed by safety.velocity_limit, the end of '
            'its range and, without a barrier, safety.error_ratio; for '
            f'{asked:.2g} s the law has asked for torques that make it faster: correct the law '
            'or its gains, or ask for a slower motion'
        )
        return Fault(Reason.VELOCITY, text)

    def invalid(self, safety: Safety, reading: Reading) -> Fault:
        """Return the fault of a reading that the law does not use."""
        q, dq = reading.q, reading.dq
        if not np.isfinite(q).all():
            return Fault(Reason.NOT_FINITE, f'the positions are not finite: {q}')
        if not np.isfinite(dq).all():
            text = f'velocities are missing or not finite: {dq}'
            return Fault(Reason.NOT_FINITE, f'{text}; {_NO_VELOCITY}')
        limit = safety.velocity_limit
        worst = int(np.argmax(np.abs(dq) / limit))
        unit = self._units[worst].of('rad/s')
        text = (
            f'the velocity of joint {self._joints[worst]!r} is {dq[worst]:+.6g} {unit}: more '
            f'than safety.velocity_limit, {limit[worst]:g} {unit}'
        )
        return Fault(Reason.VELOCITY, text)
