# SPDX-License-Identifier: Apache-2.0
"""The offline closed loop against the same in C, numpy and third-party simulators."""

from __future__ import annotations

import importlib.util
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np
from c_reference import Reference
from harness import Ratio, interleaved, ratio
from peers import loops

from blf_dsc_controller.simulation.loop import simulate

GROUP = 'closed loop offline'
PACKAGE = 'blf_dsc_controller'
C = 'C -O3'
_LONG = 60.0  # s
_SHORT = 8.0  # s, long enough for learning to begin
_AGREEMENT = 10.0  # s
_ROUNDS = 5

_PEERS = {
    'numpy': ('numpy', loops.numpy_loop, 'law, arm and DP5 in numpy'),
    'scipy solve_ivp': (
        'scipy',
        loops.scipy_loop,
        'adaptive steps of a continuous problem between samples, law in numpy',
    ),
    'MuJoCo': ('mujoco', loops.mujoco_loop, 'its RK4, law in numpy'),
    'Drake': ('pydrake', loops.drake_loop, 'MultibodyPlant, fixed RK3, law in numpy'),
    'pinocchio': ('pinocchio', loops.pinocchio_loop, 'aba, DP5 and law in numpy'),
}


def measure() -> Iterator[Ratio]:
    """Measure the time per simulated millisecond against C and, where installed, the peers."""
    yield from _beside_c()
    yield from _beside_peers()


def disagreement() -> float:
    """Return the largest difference to C over 10 s in errors [rad], torques and estimates."""
    plant = replace(loops.PLANT, duration=_AGREEMENT)
    rows = Reference().rows(loops.CONTROLLER, plant)
    record = simulate(loops.CONTROLLER, plant, supervised=False)
    samples = [record.sample(k) for k in range(len(rows))]
    mine = np.array([np.concatenate((s.xi1, s.torque, s.estimate)) for s in samples])
    return float(np.abs(mine - rows).max())


def _package(duration: float) -> Callable[[], int]:
    plant = replace(loops.PLANT, duration=duration)
    return lambda: simulate(loops.CONTROLLER, plant, supervised=False).stamps.size


def _peer(loop: Callable[[float], np.ndarray]) -> int:
    return len(loop(_SHORT))


def _beside_c() -> Iterator[Ratio]:
    reference = Reference()
    plant = replace(loops.PLANT, duration=_LONG)
    contestants = {
        PACKAGE: _package(_LONG),
        C: lambda: len(reference.rows(loops.CONTROLLER, plant)),
    }
    times = interleaved(contestants, 4 * _ROUNDS)
    yield ratio(
        GROUP, PACKAGE, C, times[PACKAGE], times[C], f'largest difference {disagreement():.0e}'
    )


def _beside_peers() -> Iterator[Ratio]:
    contestants = {PACKAGE: _package(_SHORT)}
    notes = {}
    for name, (module, loop, note) in _PEERS.items():
        if importlib.util.find_spec(module) is not None:
            contestants[name] = partial(_peer, loop)
            notes[name] = note
    if shutil.which('octave'):
        contestants['Octave'] = lambda: loops.octave_loop(_SHORT)
        notes['Octave'] = 'the whole loop in Octave, the stand-in for MATLAB; with its start-up'
    times = interleaved(contestants, _ROUNDS)
    for name, note in notes.items():
        yield ratio(GROUP, name, PACKAGE, times[name], times[PACKAGE], note)
