# SPDX-License-Identifier: Apache-2.0
"""Stiffness of the gears, if a recording has the positions of motors and of links.

The twist of a joint, theta - q, is its compliance c = 1 / K times the torque that it
transmits.  What is measured may be the torque u of the motor, which its inertia and
friction take a part of, so these have columns of their own, and so has whatever else
moves the two encoders against each other:

    twist = c u + W b,   W: acceleration, friction (COLUMNS), rate of torque (delay, damping),
                            sin q, cos q (eccentric encoders),
                            sign of the rate (hysteresis), sign of the torque (play)

Noise of u would make c too small.  So the torque that the identified links need
replaces u as the instrument (instrumental variables: Soederstroem and Stoica, 1983),
and has the rate and the signs.  The two signs are no more than like hysteresis and
play: what they change of c is a deviation of c.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blf_dsc_controller.identification.prior import Prior
from blf_dsc_controller.identification.recording import Indices
from blf_dsc_controller.identification.regression import Fit, correlation_length
from blf_dsc_controller.identification.values import parts
from blf_dsc_controller.identification.windows import Rows
from blf_dsc_controller.numerics.intervals import TWO_SIDED
from blf_dsc_controller.run import Floats

LARGEST_TWIST = 0.1
"""Largest deviation of a twist from its median that may be one [rad or m]."""

_SIGN = 0.1  # of the rms, within which a sign is not certain
_SIGNS = 2  # columns, the last ones
_COMPUTED = 1e-4  # of the twist, residual of a position that is computed from the other
# F statistic, below which an instrument is weak (Staiger and Stock, 1997)
_WEAK = 10.0
_TINY = 1e-12


class Compliance(NamedTuple):
    """Compliances of n joints [rad/(N m) or m/N]."""

    value: Floats  # (n,)
    deviation: Floats  # (n,) infinite: the motion shows nothing
    left: Floats  # (n,) share of the twist that they do not explain
    largest: Floats  # (n,) deviation of the twist from its median, rad or m

    @property
    def stiffness(self) -> Floats:
        """Stiffness (n,), and the ends of its 95 % interval, (3, n); infinite: not shown."""
        half = TWO_SIDED * self.deviation
        ends = np.stack((self.value, self.value + half, self.value - half))
        with np.errstate(divide='ignore'):
            return np.where(ends > 0.0, 1.0 / ends, np.inf)

    @property
    def is_twist(self) -> bool:
        """Whether positions differ by no more than gears can."""
        return bool((self.largest < LARGEST_TWIST).all())

    @property
    def is_known(self) -> np.ndarray:
        """Whether intervals (n,) are of finite stiffness."""
        return self.value > TWO_SIDED * self.deviation

    @property
    def is_negative(self) -> np.ndarray:
        """Whether joints (n,) twist against their torque."""
        return self.value < -TWO_SIDED * self.deviation

    @property
    def is_computed(self) -> np.ndarray:
        """Whether twists (n,) fit the torque so exactly that they must be computed from it."""
        return self.is_known & (self.left < _COMPUTED)


def compliance_of(
    rows: Rows, twist: Floats, windows: Indices, fit: Fit, prior: Prior
) -> Compliance:
    """Return the compliances by the twist (N, n) in some windows, for the values of a fit."""
    links = fit.values.copy()
    parts(links).terms[:] = 0.0
    parts(links).coupling[:] = 0.0
    twists = rows.over_windows(lambda at: twist[at])[windows]
    u = rows.u(fit.values[-1])[windows]
    needed = rows.torques(windows, prior.G @ links)
    rate = np.gradient(needed, rows.time[windows], axis=0)
    others = np.stack((
        *np.moveaxis(rows.friction(windows), 1, 0),
        rows.over_windows(lambda at: rows.dq[at], rows.slope)[windows],
        rate,
        rows.over_windows(lambda at: np.sin(rows.q[at]))[windows],
        rows.over_windows(lambda at: np.cos(rows.q[at]))[windows],
        _sign(rate),
        _sign(needed),
    ))  # fmt: skip
    weight = rows.weight[windows] * ~rows.clipped[windows]
    found = [
        _of_joint(weight[:, i], twists[:, i], u[:, i], needed[:, i], others[:, :, i].T)
        for i in range(u.shape[1])
    ]
    off = np.abs(twists - np.median(twists, axis=0)).max(axis=0)
    value, deviation, left = np.transpose(found)
    return Compliance(value, deviation, left, off)


def _sign(values: Floats) -> Floats:
    """Return signs (R, n) that are soft near zero."""
    rms = np.sqrt(np.mean(values**2, axis=0))
    return np.asarray(np.tanh(values / (_SIGN * rms + _TINY)))


def _of_joint(
    weight: Floats, twist: Floats, u: Floats, instrument: Floats, others: Floats
) -> tuple[float, float, float]:
    """Return the compliance, its deviation, and the share of the twist that it leaves."""
    W = weight[:, None] * others
    columns = weight[:, None] * np.column_stack((twist, u, instrument))
    left = _without(W, columns)
    twist, u, instrument = left.T
    product = float(instrument @ u)
    square = float(instrument @ instrument)
    counted = max(float(np.sum(weight**2)) - W.shape[1] - 1.0, 1.0)
    noise = _variance(u - product / (square + _TINY) * instrument, counted)
    if product <= 0.0 or product**2 < _WEAK * noise * square:
        return 0.0, np.inf, 1.0
    c = float(instrument @ twist) / product
    residual = twist - c * u
    variance = _variance(residual, counted) * square / product**2
    twist, u, instrument = _without(W[:, :-_SIGNS], columns).T
    by_signs = c - float(instrument @ twist) / float(instrument @ u)
    whole = float(np.linalg.norm(columns[:, 0] - columns[:, 0].mean()))
    share = float(np.linalg.norm(residual)) / (whole + _TINY)
    return c, float(np.hypot(np.sqrt(variance), by_signs)), share


def _variance(residual: Floats, counted: float) -> float:
    """Return the variance of a residual (R,), of which one in a correlation length counts."""
    return correlation_length(residual) * float(residual @ residual) / counted


def _without(W: Floats, columns: Floats) -> Floats:
    """Return columns (R, k) without what W (R, m) explains of them."""
    W = W / (np.linalg.norm(W, axis=0) + _TINY)
    return columns - W @ np.linalg.lstsq(W, columns, rcond=None)[0]
