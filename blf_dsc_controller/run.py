# SPDX-License-Identifier: Apache-2.0
"""One run of the closed loop, as arrays over the samples of its joint states."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Stamps = NDArray[np.int64]

NANOSECOND = 1e-9
"""In seconds."""

LATEST = 9e9
"""Time [s] below which each stamp fits into 64 bits in ns: 2**63 ns are 9.22e9 s."""

FIRST_STAMP = 1_000_000_000
"""Stamp of the first sample [ns] where no clock gives it: in ROS, zero means 'not set'."""


@dataclass(frozen=True)
class Series:
    """Named values with their own stamps."""

    names: tuple[str, ...]
    stamp: Stamps  #: (m,) ns, increasing
    values: Floats  #: (m, number of names)

    def indices(self, names: Sequence[str]) -> NDArray[np.intp]:
        """Return the columns' numbers of these names."""
        return np.array([self.names.index(name) for name in names], np.intp)

    def select(self, names: Sequence[str]) -> Floats:
        """Return the columns of these names, (m, number of `names`)."""
        return self.values[:, self.indices(names)]

    def column(self, name: str) -> Floats:
        """Return the values of one name, (m,)."""
        return self.values[:, self.names.index(name)]

    def held(self, stamp: Stamps, names: Sequence[str]) -> Floats:
        """Return the last values of these names at or before each stamp, the first before any."""
        before = np.searchsorted(self.stamp, stamp, side='right') - 1
        rows = np.maximum(before, 0)
        found = np.empty((len(rows), len(names)))
        for column, j in zip(found.T, self.indices(names), strict=True):
            column[:] = self.values[rows, j]  # one at a time: it may be on disk
        return found


class Stop(NamedTuple):
    """A safe stop of the controller."""

    stamp: int  #: ns, of the last joint state before it
    reason: str  #: as `reason` on ~/state
    text: str  #: sentence with the numbers
    until: int | None = None
    """ns, of the last joint state before the next start, or None to the end of the run"""


class Contact(NamedTuple):
    """Something that touched the arm."""

    stamp: int  #: ns, of the joint state that showed it
    joint: str  #: that showed it most
    torque: float  #: N m, external torque on this joint
    interval: float  #: N m, which model error and noise explain at most
    text: str = ''  #: sentence with the numbers


class Oscillation(NamedTuple):
    """An oscillation of the arm that it was warned of."""

    stamp: int  #: ns, of the joint state that showed it
    joint: str  #: that showed it most
    frequency: float  #: Hz
    torque: float  #: N m, amplitude
    text: str  #: sentence with the numbers


ToolErrors = Callable[[Floats, Floats, Floats], Floats]
"""Returns errors and bounds at the tool (k, 4) for references, errors, bounds (k, n).

They are named `topics.TOOL`.
"""

Regressor = Callable[[Floats, Floats, Floats, Floats], Floats]
"""Returns H (k, n, p) for (q, dq, v, a), (k, n) each.

H P = M(q) a + C(q, dq) v + G(q) [N m].
"""


@dataclass(frozen=True, eq=False)
class LearnedArm:
    """Scales of the estimates of an arm, whose units are mixed (kg and kg m^2)."""

    units: Mapping[str, str]  # of each estimate by name
    # standard deviations of their prior, in these units
    deviations: Mapping[str, float]
    regressor: Regressor


class JointUnits(NamedTuple):
    """Units of a joint's position and torque; errors are in thousandths of the former."""

    position: str
    torque: str

    inertia: str

    def of(self, unit: str) -> str:
        """Return the unit of such a joint for that of a joint that turns."""
        for turning, own in zip(TURNING, self, strict=True):
            unit = unit.replace(turning, own)
        return unit


TURNING = JointUnits('rad', 'N m', 'kg m^2')
SLIDING = JointUnits('m', 'N', 'kg')


def joint_units(kind: str) -> JointUnits:
    """Return the units of a kind of joint of a URDF."""
    return SLIDING if kind == 'prismatic' else TURNING


def unit_of_all(units: Iterable[JointUnits], unit: str) -> str:
    """Return the unit, or both units, of several joints for that of joints that turn."""
    return ' or '.join(dict.fromkeys(each.of(unit) for each in units))


@dataclass(frozen=True)
class Run:
    """N samples of n joints, simulated, recorded or replayed; None or NaN where unknown."""

    joints: tuple[str, ...]
    stamp: Stamps  #: (N,) ns, of the joint states
    received: Stamps  #: (N,) ns, when the recorder got them
    position: Floats  #: (N, n) rad, q as measured
    velocity: Floats  #: (N, n) rad/s, as measured
    torque: Floats  #: (N, n) N m, applied from this sample to the next
    reference: Floats | None  #: (N, n) rad, qr
    error: Floats | None  #: (N, n) rad, xi1 = q - qr
    bound: Floats | None  #: (N, n) rad, k_c
    torque_limit: Floats | None  #: (N, n) N m
    monitor: Series | None = None  #: estimates and what else the law says of its state
    truth: Series | None = None
    timing: Series | None = None
    external: Series | None = None  #: N m, external torque and `topics.INTERVAL`
    stops: tuple[Stop, ...] = ()
    contacts: tuple[Contact, ...] | None = None  #: None if not detected
    oscillations: tuple[Oscillation, ...] = ()
    arm: LearnedArm | None = None  #: from a URDF
    learns: bool = True  #: whether the law uses the prediction error
    effort: Floats | None = None  #: (N, n) N m, as measured
    reference_velocity: Floats | None = None  #: (N, n) rad/s
    xi2: Floats | None = None  #: (N, n) rad/s
    tool: ToolErrors | None = None  #: of an arm with a bound at its tool
    notes: tuple[str, ...] = ()  #: samples of a bag that are left out, and why
    #: joints that slide, where arrays have m and N instead of rad and N m
    sliding: tuple[str, ...] = ()
    #: of the controller, by dotted name; empty if they are unknown
    parameters: Mapping[str, Any] = field(default_factory=dict)

    def units(self, joint: str) -> JointUnits:
        """Return the units of a joint."""
        return SLIDING if joint in self.sliding else TURNING

    def column(self, name: str, i: int) -> Floats | None:
        """Return the values of one joint (N,) in an array by name; None if it is unknown."""
        values = getattr(self, name)
        return None if values is None else values[:, i]

    def known(self, name: str, i: int) -> Floats:
        """Return the values (N,) of one joint by name, NaN where unknown."""
        found = self.column(name, i)
        return np.full(self.stamp.size, np.nan) if found is None else found

    @property
    def time(self) -> Floats:
        """Time since the first sample (N,) [s]."""
        return self.time_of(self.stamp)

    @property
    def duration(self) -> float:
        """Time from the first sample to the last [s]."""
        return float(self.time[-1])

    def time_of(self, stamp: Stamps) -> Floats:
        """Return the times of any stamps since the first sample [s]."""
        return np.asarray((stamp - self.stamp[0]) * 1e-9, dtype=np.float64)

    @property
    def timed_stops(self) -> list[tuple[float, Stop]]:
        """Stops with their times [s]."""
        return [(self._seconds(stop.stamp), stop) for stop in self.stops]

    @property
    def timed_contacts(self) -> list[tuple[float, Contact]]:
        """Contacts with their times [s]."""
        return [(self._seconds(each.stamp), each) for each in self.contacts or ()]

    @property
    def timed_oscillations(self) -> list[tuple[float, Oscillation]]:
        """Oscillations with their times [s]."""
        return [(self._seconds(each.stamp), each) for each in self.oscillations]

    def _seconds(self, stamp: int) -> float:
        return (stamp - int(self.stamp[0])) * 1e-9
