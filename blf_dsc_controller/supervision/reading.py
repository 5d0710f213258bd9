# SPDX-License-Identifier: Apache-2.0
"""Joint states as they arrive: turns counted on, velocities differenced, trusted or in doubt.

A state is trusted if it comes from the last one: newer, within reach of an arm, and not the
same reading although that says that the arm moves.  No other state ever enters a torque: not
one of a second sender on the same topic, of a reader that hangs, or one that arrives twice.

Velocities of arms that measure none, and those that contradict the positions once, are the
differences of positions.
"""

from __future__ import annotations

from enum import Enum
from math import inf, nan
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.controller_groups import Safety
from blf_dsc_controller.law.repeats import BRIDGED
from blf_dsc_controller.law.sensor import State as Sensor
from blf_dsc_controller.law.sensor import restart
from blf_dsc_controller.run import NANOSECOND
from blf_dsc_controller.supervision.comparison import (
    ALONE,
    FAR,
    LEAPS,
    MOVES,
    NEW,
    NOT_FINITE,
    OUT_OF_REACH,
    compare_state,
)
from blf_dsc_controller.supervision.last_state import LastState
from blf_dsc_controller.supervision.recent_motion import is_gap
from blf_dsc_controller.supervision.supervisor import Fault
from blf_dsc_controller.supervision.wraps import Wraps

Vector = NDArray[np.float64]

# of a sample time: of two states in less, one is a copy, or of another sender, and their
# difference shows no acceleration
_AT_ONCE = 0.5
_REPEAT_MOTION = 3e-4  # rad in a sample: three counts of an encoder of 16 bits
# ns without states, after which the arm is at rest, as at the start
_PAUSE_NS = 1_000_000_000


class Doubt(Enum):
    """Why a state is not trusted."""

    NOT_FINITE = 'positions are not finite'
    COPY = 'the stamp of the last one, or hardly a later one'
    REPEATED = 'the same values, although they say that the arm moves'
    OUT_OF_REACH = 'positions that an arm does not reach from the last ones'


class Reading(NamedTuple):
    """A joint state, and what the ones before it say about it."""

    stamp: int  # ns
    measurement: Vector  # [q, dq, effort] (3 n,); the next state overwrites it
    gap: float  # s, since the last state that was not in doubt
    is_after_gap: bool  # whether this time is too long to compare the two
    continues: bool  # whether it comes from the last trusted state
    doubt: Doubt | None  # why it is not trusted; None: it is
    wrapped: Fault | None  # of positions that wrap

    @property
    def q(self) -> Vector:
        """Positions (n,) [rad]."""
        return self.measurement[: self.measurement.size // 3]

    @property
    def dq(self) -> Vector:
        """Velocities (n,) [rad/s]."""
        n = self.measurement.size // 3
        return self.measurement[n : 2 * n]

    @property
    def effort(self) -> Vector:
        """Efforts (n,) [N m]."""
        n = self.measurement.size // 3
        return self.measurement[2 * n :]


class Velocity:
    """Replaces velocities with finite differences of positions.

    An arm in motion whose positions do not change for a sample has sent its last
    reading once more, with a new stamp: it is continued at its velocity.
    """

    def __init__(self, n: int) -> None:
        # ns, of the last new reading and of the last state
        self._stamp = self._seen = -1
        self._q = np.zeros(n)
        self._dq = np.zeros(n)
        self._repeated = False

    def begin(self, stamp: int, q: Vector) -> None:
        """Difference the next positions from q (n,) [rad] with its stamp [ns]."""
        self._stamp = self._seen = stamp
        self._q[:] = q

    def replace(self, stamp: int, measurement: Vector) -> None:
        """Overwrite dq in [q, dq, torque] (3n,) with a stamp [ns]."""
        q, dq, _ = measurement.reshape(3, -1)
        if self._stamp < 0 or not 0 <= stamp - self._stamp < _PAUSE_NS:
            self._dq[:] = 0.0
        elif stamp > self._seen:
            step = (stamp - self._stamp) * 1e-9
            self._seen = stamp
            is_moving = float(np.abs(self._dq).max()) * step > _REPEAT_MOTION
            self._repeated = (
                is_moving and not self._repeated and bool((q == self._q).all())
            )
            if self._repeated:
                q += step * self._dq
                dq[:] = self._dq
                return
            self._dq[:] = (q - self._q) / step
        self._stamp = self._seen = stamp
        self._q[:] = q
        dq[:] = self._dq


class Readings:
    """Reads the joint states of an arm, one after the other.

    Attributes:
        last: the last trusted state.
        sensor: what the readings show of their sensor, as `law.sensor` finds it.
        fastest: largest speed of each joint (n,) [rad/s].
    """

    def __init__(self, config: ControllerConfig, sensor: Sensor) -> None:
        """Read states of the joints of a configuration, with the noise of a `sensor`."""
        n = len(config.joints)
        self.sensor = sensor
        self.last = LastState(n)
        self._sample_time = config.sample_time
        self._wraps = Wraps(config)
        self._velocity: Velocity | None = None
        if config.safety.velocity == 'estimated':
            self._velocity = Velocity(n)
        self._seen = self._before = 0  # ns, of the last trusted state, and before it
        # ns and rad, of the last state, trusted or not, that showed where the arm was; since when
        # each has followed from the one before; and whether it was faster than it may be
        self._arrived = self._alone_since = 0
        self._runs = False
        self._at = np.zeros(n)
        # stamps of a start elsewhere and of the last trusted state before it, and its measurement
        self._home: tuple[int, int, Vector] | None = None
        self._read = np.full(2 * n, nan)  # q and dq as last read
        self._new_at = -1  # ns, stamp of the first state with these
        self.set_limits(config.safety)
        self._says(0, np.zeros(3 * n))  # compiled before the first state

    def set_limits(self, safety: Safety) -> None:
        """Take these for the largest speeds of the joints from the next state on."""
        self.fastest = np.array(safety.velocity_limit, dtype=np.float64)

    def count_turns_anew(self, config: ControllerConfig) -> None:
        """Count turns from the next state on, of joints that a configuration describes."""
        self._wraps = Wraps(config)

    def take(self, stamp: int, measurement: Vector, *, begins: bool = False) -> Reading:
        """Return the next state, of a stamp [ns], with [q, dq, effort] (3 n,) as measured.

        `begins`: the law waits for a state to start from, which may repeat the last.
        """
        gap = (stamp - self._seen) * NANOSECOND
        is_after_gap = is_gap(gap, self._sample_time)
        if gap < 0.0 or is_after_gap:
            restart(self.sensor)
        counted, wrapped = self._wraps.count(measurement, gap, self.fastest)
        found = self._says(stamp, counted)
        doubt = self._doubt(stamp, found)
        # neither of the others shows where the arm is by now
        if doubt not in (Doubt.NOT_FINITE, Doubt.REPEATED):
            self._at[:] = counted[: self._at.size]
            self._arrived = stamp
        if begins and doubt is Doubt.OUT_OF_REACH and self.return_home():
            doubt = self._doubt(stamp, self._says(stamp, counted))
        continues = doubt is None
        if begins and doubt in (Doubt.COPY, Doubt.REPEATED):
            doubt = None
        if doubt is None:
            self._trust(stamp, counted, is_new=bool(found & NEW))
        if begins and wrapped is not None:
            self._wraps.restart()
        return Reading(stamp, counted, gap, is_after_gap, continues, doubt, wrapped)

    def follow(self, reading: Reading) -> None:
        """Let a trusted reading beside the law be the last one."""
        age = (reading.stamp - self._new_at) * NANOSECOND
        self.last.follow(
            reading.stamp,
            reading.measurement,
            self.fastest,
            self._sample_time,
            continues=reading.continues,
            is_new=not 0.0 < age < BRIDGED * self._sample_time,
            is_measured=self._velocity is None,
        )

    def begin(self, reading: Reading) -> None:
        """Let a reading that the law starts from be the last one, also if it is elsewhere."""
        if reading.doubt is not None:
            self._leave_home(reading.stamp)
            self._trust(reading.stamp, reading.measurement, is_new=True)
        self.use(reading)

    def use(self, reading: Reading) -> None:
        """Let a reading that the law uses be the last one."""
        self.last.measure_gap(reading.stamp, self._sample_time)
        fastest = self.fastest
        slow = np.minimum(np.maximum(self.velocity, -fastest), fastest)
        self.last.take(reading.stamp, reading.measurement, slow)

    def difference_velocities(self, reading: Reading) -> None:
        """Difference all velocities from the positions, from this reading on."""
        n = reading.q.size
        self._velocity = Velocity(n)
        self._velocity.begin(self._before, self.sensor.read_before[:n])
        self._velocity.replace(reading.stamp, reading.measurement)
        restart(self.sensor)

    def restart(self) -> None:
        """Begin with the next state, for a new start."""
        if not self._wraps.restart():
            return
        # to positions that differ from those before
        restart(self.sensor)
        if self._velocity is not None:
            self._velocity = Velocity(self.last.q.size)

    @property
    def velocity(self) -> Vector:
        """Velocity (n,) [rad/s] that the positions show, behind a low pass."""
        return self.sensor.derived

    @property
    def speed(self) -> float:
        """Largest speed of a joint [rad/s], as the positions show it."""
        return float(np.abs(self.velocity).max())

    def return_home(self) -> bool:
        """Trust what was trusted before a start elsewhere, if that was short ago.

        It was no other episode of a simulation then, but met a state of another sender: call it
        if states leap, or the law cannot start there.  Return whether it was short ago.
        """
        home = self._recent_home
        if home is None:
            return False
        self._home = None
        _, stamp, measurement = home
        q, dq, _ = measurement.reshape(3, -1)
        self.last.take(stamp, measurement, dq)
        self._wraps.trust(q)
        restart(self.sensor)
        if self._velocity is not None:
            self._velocity.begin(stamp, q)
        return True

    def _leave_home(self, stamp: int) -> None:
        """Let the law begin elsewhere, by a state with a stamp [ns]."""
        restart(self.sensor)
        self._home = stamp, self.last.stamp, self.last.measurement.copy()

    @property
    def _recent_home(self) -> tuple[int, int, Vector] | None:
        """What was trusted before a start elsewhere, if that was short ago; else None."""
        home = self._home
        is_recent = (
            home is not None and 0 <= (self._arrived - home[0]) * NANOSECOND < ALONE
        )
        return home if is_recent else None

    def _trust(self, stamp: int, measurement: Vector, *, is_new: bool) -> None:
        self._before, self._seen = self._seen, stamp
        self._wraps.trust(measurement[: self._at.size])
        if self._velocity is not None:
            self._velocity.replace(stamp, measurement)
            is_new = not (measurement[: self._read.size] == self._read).all()
        if is_new:
            self._read[:] = measurement[: self._read.size]
            self._new_at = stamp

    def _says(self, stamp: int, measurement: Vector) -> int:
        """Return what a state says beside the ones before it: see `compare_state`.

        Stamps jitter, and clocks are set back: a sample time counts as one at least.
        """
        T = self._sample_time
        step = max(T, (stamp - self._arrived) * NANOSECOND)
        elapsed = max(T, (stamp - self.last.stamp) * NANOSECOND)
        age = (stamp - self._new_at) * NANOSECOND
        return compare_state(
            measurement,
            self._read,
            self._at,
            self.last.q,
            self.last.speed,
            self.fastest,
            self.sensor.resolution,
            step,
            elapsed,
            age,
        )

    def _doubt(self, stamp: int, found: int) -> Doubt | None:
        """Return why a state is not trusted; None: it comes from the last one.

        Since the last trusted state, a joint may have gone on twice as fast as it was then, or
        have sped up, and since the last of all states twice as fast as its limit.  So of two
        senders whose states alternate, the one that was trusted is, however rare its states are.
        Once all states have followed from each other for ALONE, they are trusted again, also
        those of an arm that is faster than it may be, as its velocities say.
        """
        last, T = self.last, self._sample_time
        if found & NOT_FINITE:
            return Doubt.NOT_FINITE
        if found & LEAPS or (found & FAR and not self._runs):
            self._alone_since = stamp
        self._runs = bool(found & FAR)
        if last.age == inf:
            return None
        elapsed = (stamp - last.stamp) * NANOSECOND
        if elapsed == 0.0:
            return Doubt.COPY
        age = (stamp - self._new_at) * NANOSECOND
        if age >= BRIDGED * T and found & MOVES and not found & NEW:
            return Doubt.REPEATED
        is_alone = (stamp - self._alone_since) * NANOSECOND >= ALONE
        if found & OUT_OF_REACH and not is_alone:
            return Doubt.OUT_OF_REACH
        return Doubt.COPY if 0.0 < elapsed < _AT_ONCE * T else None
