# SPDX-License-Identifier: Apache-2.0
"""How much of the damping of a stop a joint bears whose motor is not the assumed one.

    python -m benchmark stop-damping

A motor B and a link M with a spring K and 3 % of damping between, no friction, and the torque
-D v at the motor, 5.5 ms late (Pade, third order), of the velocity of either through the low
pass of a stop.  D / (M + the assumed B) is the preset's rate at 1 kHz.  Each cell is the least
share of D up to which the joint is stable, over links of 0.1 to 3 times the assumed motor, and
antiresonances sqrt(K/M) of 8 to 60 Hz.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterator

import numpy as np

from benchmark.harness import print_table
from blf_dsc_controller.law.sensor import FILTER

DELAY = 5.5e-3  # s
RATE = 31.0  # 1/s
DAMPING_RATIO = 0.03
MOTORS = 0.2, 0.5, 1.0, 2.0, 7.0  # over the assumed one
LINKS = 0.1, 0.3, 1.0, 3.0  # likewise
ANTIRESONANCES = 8.0, 15.0, 30.0, 60.0  # Hz
SHARES = np.geomspace(0.01, 10.0, 40)
LOOPS = 0.0, 4.0  # gains of a torque loop, which divides the motor by one more
_SLOWEST = 1e-3  # 1/s, growth that counts


def system(
    motor: float, link: float, spring: float, damping: float, *, at_link: bool
) -> np.ndarray:
    """Return A (8, 8) of [motor, its rate, link, its rate, v, states of the delay]."""
    A = np.zeros((8, 8))
    A[0, 1] = A[2, 3] = 1.0
    loss = 2.0 * DAMPING_RATIO * np.sqrt(spring * motor * link / (motor + link))
    give = np.array([-spring, -loss, spring, loss])
    A[1, :4], A[3, :4] = give / motor, -give / link
    A[4, 3 if at_link else 1], A[4, 4] = 1.0 / FILTER, -1.0 / FILTER
    # e^(-sT) = -1 + 2 (12 (sT)^2 + 120) / ((sT)^3 + 12 (sT)^2 + 60 sT + 120)
    late = slice(5, 8)
    A[late, late] = np.array([[0, 1, 0], [0, 0, 1], [-120, -60, -12]]) / DELAY
    A[7, 4] = 1.0 / DELAY
    A[1, 4] += damping / motor
    A[1, late] -= damping / motor * 2.0 * np.array([120.0, 0.0, 12.0])
    return A


def borne(factor: float, loop: float, *, at_link: bool) -> float:
    """Return the least share of the damping with which a motor is stable."""
    least = np.inf
    for link, f in itertools.product(LINKS, ANTIRESONANCES):
        spring = link * (2.0 * np.pi * f) ** 2
        motor = factor / (1.0 + loop)
        share = 0.0
        for trial in SHARES:
            damping = trial * RATE * (1.0 + link)
            A = system(motor, link, spring, damping, at_link=at_link)
            if np.linalg.eigvals(A).real.max() > _SLOWEST:
                break
            share = trial
        least = min(least, share)
    return least


def rows() -> Iterator[list[str]]:
    """Compute the rows: encoders and drives."""
    for loop, at_link in itertools.product(LOOPS, (True, False)):
        shares = (borne(each, loop, at_link=at_link) for each in MOTORS)
        side = 'link' if at_link else 'motor'
        yield [side, 'yes' if loop else 'no', *(f'{each:.2g}' for each in shares)]


def main(_options: argparse.Namespace) -> None:
    """Print the table."""
    print_table(('encoders', 'torque loop', *(f'{each:g}' for each in MOTORS)), rows())
