# SPDX-License-Identifier: Apache-2.0
"""Would notch filters let gains grow more than lags?  By measured responses of random arms.

    python -m benchmark notches [ARMS] [STUDY ...]

The arms are those of `commissioning`, measured by simulated runs.  From the gains without a filter
on, the damping of one joint after the other may pass a lag, one of `choice.LAGS`, or a notch,

    N(s) = (s^2 + 2 a d w s + w^2) / (s^2 + 2 d w s + w^2)

at one of the `FREQUENCIES`: each time the filter with which the gains of all joints together grow
most, until that is less than 20 %.  A joint has one of each kind at most.  The modulus margin stays
0.5, of the measured arm and of a rigid one of the measured inertias and lags; what is above the
fastest line of the motion limits nothing, unlike in `choice`.

    lags       of each joint [ms], if there are no notches, and how many times the gains grow
    notches    joint@frequency [Hz], if there are no lags, likewise
    mean       of the gains, over the joints (geometric), by lags, by notches and by both
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmark.commissioning import STUDIES, measured_of, of_arms
from benchmark.harness import print_table
from blf_dsc_controller.arms.joint_gains import JointGains, linear
from blf_dsc_controller.arms.known_gears import MARGIN
from blf_dsc_controller.arms.linear_loop import (
    SLOWEST,
    Joints,
    Timing,
    arm_response,
    law_response,
)
from blf_dsc_controller.commissioning.choice import LAGS
from blf_dsc_controller.commissioning.commissioned import Commissioned, commissioned
from blf_dsc_controller.commissioning.margin import Loops, Margin, singular_values

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

FREQUENCIES = (15.0, 20.0, 25.0, 30.0, 36.0, 43.0, 52.0, 62.0, 75.0, 90.0)  # Hz
DAMPING, SHARE = 0.7, 1.0 / 7.0
"""d and a: wide, since the frequency of a joint changes with posture and load."""

STEP = 1.1  # of the gains
PAYS = 1.2  # times all gains together


class Filters(NamedTuple):
    """Lag [s] and frequency of the notch [Hz] (n,) in the damping of each joint; 0: none."""

    lag: Floats
    notch: Floats

    def passed(self, s: Complex) -> Complex:
        """Return what passes the notches at s = i omega (f,): (f, n, 1)."""
        w = 2.0 * np.pi * self.notch
        wide = s[:, None] ** 2 + 2.0 * DAMPING * w * s[:, None] + w**2
        missing = 2.0 * (1.0 - SHARE) * DAMPING * w * s[:, None] / wide
        return np.asarray(1.0 - missing)[..., None]

    def others(
        self, lags: Sequence[float], notches: Sequence[float]
    ) -> Iterator[Filters]:
        """Yield these with one filter more, or with a longer lag."""
        for j in range(self.lag.size):
            for lag in lags:
                if lag > self.lag[j]:
                    yield self._replace(lag=replaced(self.lag, j, lag))
            if self.notch[j] == 0.0:
                for frequency in notches:
                    yield self._replace(notch=replaced(self.notch, j, frequency))


def replaced(values: Floats, j: int, value: float) -> Floats:
    """Return values (n,) with another one of joint j."""
    return np.where(np.arange(values.size) == j, value, values)


class Filtered(NamedTuple):
    """A commissioned arm whose damping passes filters."""

    loops: Loops
    inertia: Floats  # (n,) kg m^2, the least of each joint that was measured
    timing: Timing
    filters: Filters

    def has_margin(self, gains: JointGains) -> bool:
        """Whether the measured arm and the rigid one have the modulus margin."""
        gains = gains._replace(damping_lag=self.filters.lag)
        return self.measured(gains) >= MARGIN and self.rigid(gains) >= MARGIN

    def measured(self, gains: JointGains) -> float:
        """Return the modulus margin of the measured arm, in all postures."""
        return min(self._margins(gains)).value

    def _margins(self, gains: JointGains) -> Iterator[Margin]:
        for k, response in enumerate(self.loops.responses):
            s: Complex = np.asarray(2j * np.pi * response.frequency, complex)
            passed = self.filters.passed(s)
            C_y, C_v = (passed * C for C in self.loops.law(response, gains))
            L = C_y @ response.position + C_v @ response.velocity
            position, velocity = response.deviations()
            dL = np.abs(C_y) @ position + np.abs(C_v) @ velocity
            counts = response.seen & (response.frequency >= SLOWEST)
            values = singular_values(L, dL, response.shared)
            yield values.margin(response.frequency, counts, k)

    def rigid(self, gains: JointGains) -> float:
        """Return the modulus margin of rigid joints without friction, the others held."""
        s: Complex = np.asarray(
            2j * np.pi * np.geomspace(SLOWEST, 0.48 / self.timing.period, 120), complex
        )
        n = len(self.inertia)
        joints = Joints(motors=np.zeros(n), viscous=np.zeros(n))
        G = arm_response(np.diag(self.inertia)[None], joints, self.timing, s)
        law = linear(gains, self.loops.inertia, 1)
        C = self.filters.passed(s) * law_response(law, self.timing, s)
        own = np.diagonal(G @ C, axis1=2, axis2=3)
        return float(np.abs(1.0 + own).min())


def arm_of(found: Commissioned, sample_time: float) -> Filtered:
    """Return a commissioned arm without a filter."""
    least = np.where(np.isnan(found.findings.inertias), np.inf, found.findings.inertias)
    inertia = np.minimum(least.min(axis=0), found.loops.inertia)
    timing = found.findings.timing(sample_time, found.lag)
    none = np.zeros(inertia.size)
    return Filtered(found.loops, inertia, timing, Filters(none, none))


def grown(arm: Filtered, gains: JointGains) -> Floats:
    """Return by how much the gains of each joint (n,) may grow, all together and then each."""
    factors = np.ones(len(arm.inertia))
    while arm.has_margin(gains.scaled(STEP * factors)):
        factors *= STEP
    grows = np.ones(factors.size, bool)
    while grows.any():
        for j in np.flatnonzero(grows):
            more = factors.copy()
            more[j] *= STEP
            grows[j] = arm.has_margin(gains.scaled(more))
            if grows[j]:
                factors = more
    return factors


def with_filters(
    arm: Filtered, gains: JointGains, lags: Sequence[float], notches: Sequence[float]
) -> tuple[Filters, Floats]:
    """Return the filters that pay, and by how much the gains (n,) grow."""
    factors = without = grown(arm, gains)
    while True:
        tried = (
            (each, factors * grown(each, gains.scaled(factors)))
            for filters in arm.filters.others(lags, notches)
            if (each := arm._replace(filters=filters)).has_margin(gains.scaled(factors))
        )
        best, more = max(
            tried, key=lambda each: float(np.prod(each[1])), default=(arm, factors)
        )
        if np.prod(more / factors) < PAYS:
            return arm.filters, factors / without
        arm, factors = best, more


def row(name: str, number: int) -> list[str]:
    """Return the row of an arm."""
    config, measured, _ = measured_of(name, number)
    found = commissioned(config, measured, MARGIN, lags=())
    arm, gains = arm_of(found, config.sample_time), found.choice.gains
    lags, by_lags = with_filters(arm, gains, LAGS, ())
    notches, by_notches = with_filters(arm, gains, (), FREQUENCIES)
    _, by_both = with_filters(arm, gains, LAGS, FREQUENCIES)
    means = (np.exp(np.log(each).mean()) for each in (by_lags, by_notches, by_both))
    at = (f'{j + 1}@{f:g}' for j, f in enumerate(notches.notch) if f > 0.0)
    return [
        name.rpartition('_')[2],
        f'{number}',
        f'{listed(1e3 * lags.lag)}: {listed(by_lags)}',
        f'{" ".join(at) or "-"}: {listed(by_notches)}',
        ', '.join(f'{each:.2f}' for each in means),
    ]


def listed(values: Floats) -> str:
    """Return values (n,) in a line."""
    return ', '.join(f'{each:.2g}' for each in values)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument('words', nargs='*', metavar='WORD', help='see above')


def main(options: argparse.Namespace) -> None:
    """Print a table."""
    many, *given = options.words or ['2']
    rows = of_arms(row, tuple(given) or STUDIES, int(many))
    print_table(['arm', 'number', 'lags', 'notches', 'mean'], rows)
