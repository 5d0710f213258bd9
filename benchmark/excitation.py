# SPDX-License-Identifier: Apache-2.0
"""The search of `blf_dsc excite` against random finite Fourier series, in the same time.

    .venv/bin/python benchmark/excitation.py --starts 2

Both have the same harmonics, limits of joints and torque, and clearance. A random series is scaled
down by 10 % up to 20 times, until it keeps them; the best of all is kept.
"""

from __future__ import annotations

import argparse
import os

os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import time

import numpy as np

from blf_dsc_controller.cli.identify import clearance_of, guess_of
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import CONTROLLER, load, locate
from blf_dsc_controller.identification.exciting_reference import ExcitationProblem, search

_HARMONICS, _TORQUE, _SPEED, _RADIUS = 3, 0.8, 0.95, 0.07
_SHRINK, _SHRINKS = 0.9, 20  # to an eighth


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--config', nargs='+', default=['recommended', 'panda', 'ur5e'])
    parser.add_argument('--starts', type=int, default=2)
    options = parser.parse_args()
    print('| arm | time | log-determinant (smallest eigenvalue): excite | random | series tried |')
    print('| --- | --- | --- | --- | --- |')
    for name in options.config:
        config = load(locate(name), CONTROLLER, ControllerConfig)
        problem = ExcitationProblem(
            config,
            guess_of(config, None),
            _TORQUE,
            _HARMONICS,
            clearance_of(config, _RADIUS, 0.0),
            _SPEED,
        )
        problem.evaluate(problem.parameters(problem.start(np.random.default_rng(0))))  # compiles
        begin = time.perf_counter()
        best = problem.evaluate(problem.parameters(search(problem, 0, options.starts))).gain
        seconds = time.perf_counter() - begin
        other, tried = _random(problem, seconds)
        print(f'| {name} | {seconds:.0f} s | {best:.4g} | {other:.4g} | {tried} |', flush=True)


def _random(problem: ExcitationProblem, seconds: float) -> tuple[float, int]:
    """Return the best gain within the time [s], and the number of series."""
    random = np.random.default_rng(0)
    best, tried = -np.inf, 0
    end = time.perf_counter() + seconds
    while time.perf_counter() < end:
        x = problem.start(random)
        tried += 1
        for _ in range(_SHRINKS):
            reached = problem.evaluate(problem.parameters(x))
            if reached.is_allowed:
                best = max(best, reached.gain)
                break
            x[problem.n :] *= _SHRINK
    return best, tried


if __name__ == '__main__':
    main()
