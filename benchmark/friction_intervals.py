# SPDX-License-Identifier: Apache-2.0
"""Whether 95 % intervals of friction hold where its law is another one than that of the fit.

    .venv/bin/python benchmark/friction_intervals.py --runs 50

The arms are those of `identification.py arms`, at 100 Hz.  Each recording is made with
several laws, whose parameters are random for each joint: `test/friction_laws.py`.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import identification
import numpy as np
from friction_laws import LAWS, with_friction
from harness import print_table
from random_arm import is_covered, measured, recording_of, reference_of, shake, truth_of

from blf_dsc_controller.identification.identified import Identified
from blf_dsc_controller.identification.identify import identify_arm
from blf_dsc_controller.identification.values import COULOMB, VISCOUS
from blf_dsc_controller.run import Floats

_EVERY = 10  # samples of 1 ms
_PERIOD = 0.01  # s
_HEAD = (
    *('law', 'base parameters', 'viscous', 'Coulomb friction'),
    *('interval of viscous', 'of Coulomb friction'),
)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--runs', type=int, default=50, help='arms')
    parser.add_argument('--seed', type=int, default=0, help='of the first arm')
    options = parser.parse_args()
    # (arms, laws, 5)
    seeds = range(options.seed, options.seed + options.runs)
    found = np.array([list(_of_arm(seed)) for seed in seeds])
    means = 100.0 * found[:, :, :3].mean(axis=0)
    halves = 100.0 * np.median(found[:, :, 3:], axis=0)
    rows = []
    for law, mean, half in zip(LAWS, means, halves, strict=True):
        covered = [f'{value:.1f} %' for value in mean]
        widths = [f'± {value:.1f} %' for value in half]
        rows.append((law, *covered, *widths))
    print_table(_HEAD, rows)


def _of_arm(seed: int) -> Iterator[Floats]:
    """Yield for each law the shares of intervals that hold the truth, and their median sizes."""
    robot = identification.random_robot(seed)
    chain = robot.chain(())
    joints = tuple(joint.name for joint in chain.joints)
    truth = truth_of(chain, seed)
    zero = np.zeros(len(joints))
    smooth = truth._replace(viscous=zero, coulomb=zero)
    motion = shake(
        chain, smooth, reference_of(chain, 2 * seed), identification.DURATION
    )
    for law in LAWS:
        states = with_friction(law, motion, truth.viscous, truth.coulomb, seed)
        seen = measured(states, seed)[::_EVERY]
        found = identify_arm(recording_of(seen, joints, _PERIOD), robot)
        covered = is_covered(found, truth)
        p = found.parameters.model.p
        base, viscous, coulomb = np.split(covered, (p, p + len(joints)))
        shares = [np.mean(part) for part in (base, viscous, coulomb)]
        sizes = [
            _size(found, VISCOUS, truth.viscous),
            _size(found, COULOMB, truth.coulomb),
        ]
        yield np.array([*shares, *sizes])


def _size(found: Identified, term: int, truth: Floats) -> float:
    """Return the median half interval of a term, relative to its truth."""
    return float(np.median(1.96 * found.deviations.terms[term] / truth))


if __name__ == '__main__':
    main()
