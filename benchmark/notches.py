# SPDX-License-Identifier: Apache-2.0
"""Would notch filters let gains grow?  By the measured responses of commissioned arms.

    python -m benchmark notches [ARMS] [STUDY ...]

The arms are those of `commissioning`, measured by simulated runs, with the gains and lags that
follow.  Then the feedback of one joint after the other may pass a notch,

    N(s) = (s^2 + 2 a d w s + w^2) / (s^2 + 2 d w s + w^2)

at one of the `FREQUENCIES`, of one of the `SHAPES` (d, a): each time the one with which the gains
grow most, until they grow by less than 20 % in all.  The modulus margin stays 0.5, of the
measured arm and of a rigid one of the measured inertias and lags.

    no lag     the notches of each joint [Hz], and how many times the gains grow by them, where no
               damping lags
    lags       the gains of `choice.LAGS` over those without a lag
    both       notches beside these lags, and how many times the gains grow by them
    mean       of the gains over those without lag and notch, over the joints (geometric), by
               notches, lags and both
"""

from __future__ import annotations

import argparse
import itertools
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
from blf_dsc_controller.commissioning.commissioning import Commissioned, commissioned
from blf_dsc_controller.commissioning.margin import Loops, Margin, singular_values

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

FREQUENCIES = (15.0, 20.0, 25.0, 30.0, 36.0, 43.0, 52.0, 62.0, 75.0, 90.0)  # Hz
SHAPES = ((0.7, 1.0 / 7.0), (0.4, 0.4))  # d, a
STEP = 1.1  # of the gains
PAYS = 1.2  # times all gains together


class Notch(NamedTuple):
    """A notch in the feedback of one joint."""

    joint: int
    frequency: float  # Hz
    damping: float  # d
    share: float  # a, what passes at the frequency

    def response(self, s: Complex) -> Complex:
        """Return N (f,) at s = i omega."""
        w = 2.0 * np.pi * self.frequency
        wide = s**2 + 2.0 * self.damping * w * s + w**2
        return np.asarray(1.0 - 2.0 * (1.0 - self.share) * self.damping * w * s / wide)


def through(notches: Sequence[Notch], n: int, s: Complex) -> Complex:
    """Return what passes the notches of each joint, (f, n, 1) at s (f,)."""
    passed = np.ones((s.size, n, 1), complex)
    for notch in notches:
        passed[:, notch.joint, 0] *= notch.response(s)
    return passed


class Notched(NamedTuple):
    """A commissioned arm whose feedback passes notches."""

    loops: Loops
    inertia: Floats  # (n,) kg m^2, the least of each joint that was measured
    timing: Timing
    notches: tuple[Notch, ...] = ()

    def has_margin(self, gains: JointGains) -> bool:
        """Whether the measured arm and the rigid one have the modulus margin."""
        return self.measured(gains) >= MARGIN and self.rigid(gains) >= MARGIN

    def measured(self, gains: JointGains) -> float:
        """Return the modulus margin of the measured arm, in all postures."""
        return min(self._margins(gains)).value

    def _margins(self, gains: JointGains) -> Iterator[Margin]:
        for k, response in enumerate(self.loops.responses):
            s: Complex = np.asarray(2j * np.pi * response.frequency, complex)
            passed = through(self.notches, len(self.inertia), s)
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
        C = through(self.notches, n, s) * law_response(law, self.timing, s)
        own = np.diagonal(G @ C, axis1=2, axis2=3)
        return float(np.abs(1.0 + own).min())


def arm_of(found: Commissioned, sample_time: float) -> Notched:
    """Return a commissioned arm without a notch."""
    least = np.where(np.isnan(found.findings.inertias), np.inf, found.findings.inertias)
    inertia = np.minimum(least.min(axis=0), found.loops.inertia)
    timing = found.findings.timing(sample_time, found.lag)
    return Notched(found.loops, inertia, timing)


def grown(arm: Notched, gains: JointGains) -> Floats:
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


def with_notches(arm: Notched, gains: JointGains) -> tuple[Notched, Floats]:
    """Return an arm with the notches that pay, and by how much its gains (n,) grow."""
    factors = grown(arm, gains)
    while True:
        notched = [
            arm._replace(notches=(*arm.notches, Notch(j, frequency, *shape)))
            for j, frequency, shape in itertools.product(
                range(len(arm.inertia)), FREQUENCIES, SHAPES
            )
        ]
        tried = (
            (each, factors * grown(each, gains.scaled(factors)))
            for each in notched
            if each.has_margin(gains.scaled(factors))
        )
        best, more = max(
            tried, key=lambda each: float(np.prod(each[1])), default=(arm, factors)
        )
        if np.prod(more / factors) < PAYS:
            return arm, factors
        arm, factors = best, more


def row(name: str, number: int) -> list[str]:
    """Return the row of an arm."""
    config, measured, _ = measured_of(name, number)
    plain, lagging = (
        commissioned(config, measured, MARGIN, lags) for lags in ((), LAGS)
    )
    found = [
        with_notches(arm_of(each, config.sample_time), each.choice.gains)
        for each in (plain, lagging)
    ]
    (_, alone), (_, both) = found
    lags = lagging.choice.factors / plain.choice.factors
    means = (np.exp(np.log(each).mean()) for each in (alone, lags, lags * both))
    return [
        name.rpartition('_')[2],
        f'{number}',
        f'{told(found[0][0])}: {listed(alone)}',
        listed(lags),
        f'{told(found[1][0])}: {listed(both)}',
        ', '.join(f'{each:.2f}' for each in means),
    ]


def told(arm: Notched) -> str:
    """Return the notches of an arm, as joint@frequency."""
    notches = sorted(arm.notches)
    return ' '.join(f'{each.joint + 1}@{each.frequency:g}' for each in notches) or '-'


def listed(factors: Floats) -> str:
    """Return factors (n,) in a line."""
    return ', '.join(f'{each:.2g}' for each in factors)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument('words', nargs='*', metavar='WORD', help='see above')


def main(options: argparse.Namespace) -> None:
    """Print a table."""
    many, *given = options.words or ['2']
    rows = of_arms(row, tuple(given) or STUDIES, int(many))
    print_table(['arm', 'number', 'no lag', 'lags', 'both', 'mean'], rows)
