# SPDX-License-Identifier: Apache-2.0
"""Offline loop against C, numpy, MuJoCo and pinocchio; growth with joints and unknowns.

The C reference is compiled on demand and called through ctypes. The peers run the
recommended configuration: all hold the torque over the sample and apply the
disturbance, only the integration of the arm differs.
"""

from __future__ import annotations

import ctypes
import itertools
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from plain_law import PlainLaw, dynamics
from scipy.integrate import RK45

from benchmark.harness import FULL, Ratio, interleaved, ratio
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import PLANT, load_loop
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.factory.controller import begin, controller_of
from blf_dsc_controller.factory.settings import settings_of_config
from blf_dsc_controller.reference.approach import reference_of
from blf_dsc_controller.reference.terms import sampled
from blf_dsc_controller.simulation.loop import simulate

_ROOT = Path(__file__).parents[1]
PACKAGE = 'blf_dsc_controller'
C = 'C -O3'
_TWO_LINKS = 'two-link arm, p = 5'
_LONG = 60.0  # s
_SHORT = 8.0  # s, long enough for learning to begin
_AGREEMENT = 10.0  # s
_ROUNDS = 5
_GROWTH_ROUNDS = 9
_UPDATES = 2000
SOURCE = Path(__file__).with_name('reference.c')
# The package's kernels are compiled for the native processor too; contraction would
# change the numbers that are compared.
FLAGS = ('-O3', '-march=native', '-ffp-contract=off')
# parameters, columns of a row: xi1, torque, theta
_P = 3
_COLUMNS = 9
Step = Callable[[float, np.ndarray], None]
State = Callable[[], tuple[np.ndarray, np.ndarray]]
LAW, ARM = ControllerConfig(), PlantConfig()  # as in the paper
T = ARM.sample_time


@cache
def _reference() -> Callable[..., int]:
    """Compile the reference; needs a C compiler named cc."""
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder, 'reference.so')
        command = [
            'cc',
            *FLAGS,
            '-shared',
            '-fPIC',
            '-o',
            str(library),
            str(SOURCE),
            '-lm',
        ]
        subprocess.run(command, check=True)
        run = ctypes.CDLL(str(library)).run
    run.argtypes = (ctypes.c_void_p, ctypes.c_long, ctypes.c_void_p)
    return run


def reference_rows(duration: float) -> np.ndarray:
    """Return rows (samples, 9) of a run in C, without the sample at `duration`.

    Raises MemoryError if the C program gets none.
    """
    settings = _settings()
    rows = np.zeros((round(duration / T), _COLUMNS))
    if _reference()(settings.ctypes.data, len(rows), rows.ctypes.data) != 0:
        raise MemoryError
    return rows


def _settings() -> np.ndarray:
    """Lay out `struct settings` of the C file: the same fields in order, integers as long."""
    law = settings_of_config(LAW)
    arm = ARM.arm
    torque = ARM.disturbance
    reference = LAW.reference
    values: dict[str, Any] = {
        **{name: getattr(arm, name) for name in ('l1', 'l2', 'm1', 'm2', 'gravity')},
        **{
            name: getattr(torque, name)
            for name in ('constant', 'amplitude', 'frequency', 'phase')
        },
        **{
            name: getattr(torque, name)
            for name in ('viscous', 'coulomb', 'coulomb_velocity')
        },
        'q0': ARM.initial.position,
        'dq0': ARM.initial.velocity,
        'offset': reference.offset,
        'swing': reference.amplitude,
        'tone': reference.frequency[0],
        **{
            name: getattr(law.barrier, name)
            for name in ('bound', 'weight', 'slope_limit', 'knee')
        },
        **{
            name: getattr(law.surface, name) for name in ('gain', 'mu', 'time_constant')
        },
        'Kp': law.feedback.gain,
        'gamma': law.disturbance.gain,
        'limit': law.torque.limit,
        'P0': law.initial_estimate[:_P],
        'Gamma': law.adaptation.adaptation_gain,
        'kappa': law.adaptation.weight,
        'rho': law.window.regularization,
        'sigma': law.excitation.excitation_threshold,
        'learning_start': law.excitation.learning_start,
        'pole': law.row.filter_pole,
        'radius': law.adaptation.radius,
        'T': T,
        'window': law.window.length,
        'interval': law.window.interval,
    }
    kinds = [
        (name, np.int64 if isinstance(value, int) else np.float64, np.shape(value))
        for name, value in values.items()
    ]
    return np.array([tuple(values.values())], np.dtype(kinds))


def disturbance(t: float) -> np.ndarray:
    """Return tau_dist (2,) [N m]."""
    d = ARM.disturbance
    wave = np.sin(np.multiply(d.frequency, t) + d.phase)
    return np.add(d.constant, np.multiply(d.amplitude, wave))


def run(duration: float, state: State, step: Step) -> np.ndarray:
    """Return the errors (samples, 2) [rad] of the numpy law in a loop with a simulator."""
    law = PlainLaw(settings_of_config(LAW))
    times = T * np.arange(round(duration / T))
    errors = np.zeros((times.size, 2))
    for k, (qr, dqr, ddqr) in enumerate(sampled(reference_of(LAW), times)):
        q, dq = state()
        law.tau = law.update(
            times[k], T, qr, dqr, ddqr, np.concatenate((q, dq, law.tau))
        )
        errors[k] = q - qr
        step(times[k], law.tau)
    return errors


def pinocchio_loop(duration: float) -> np.ndarray:
    """Run our URDF by pinocchio's articulated-body algorithm, a DP5 step in numpy.

    Return the errors (samples, 2) [rad].
    """
    import pinocchio

    model = pinocchio.buildModelFromUrdf(str(_ROOT / 'config/two_link.urdf'))
    model.gravity.linear = np.array([0.0, 0.0, -ARM.arm.gravity])
    data = model.createData()

    def acceleration(q: np.ndarray, dq: np.ndarray, torque: np.ndarray) -> np.ndarray:
        return np.asarray(pinocchio.aba(model, data, q, dq, torque))

    return _integrated(acceleration, duration)


def mujoco_loop(duration: float) -> np.ndarray:
    """Run the arm of the example by MuJoCo's RK4 at the sample time, with the disturbance held."""
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(_ROOT / 'benchmark/two_link.xml'))
    data = mujoco.MjData(model)
    data.qpos[:] = ARM.initial.position
    data.qvel[:] = ARM.initial.velocity

    def step(t: float, torque: np.ndarray) -> None:
        data.qfrc_applied[:] = torque - disturbance(t + 0.5 * T)
        mujoco.mj_step(model, data)

    return run(duration, lambda: (data.qpos.copy(), data.qvel.copy()), step)


def _integrated(acceleration: Callable[..., np.ndarray], duration: float) -> np.ndarray:
    """Run an arm and a Dormand-Prince step in numpy."""
    x = np.concatenate((ARM.initial.position, ARM.initial.velocity))
    k = np.zeros((6, 4))

    def step(t: float, torque: np.ndarray) -> None:
        for stage, (a, c) in enumerate(zip(RK45.A, RK45.C, strict=True)):
            y = x + T * (a[:stage] @ k[:stage])
            net = torque - disturbance(t + c * T)
            k[stage, :2] = y[2:]
            k[stage, 2:] = acceleration(y[:2], y[2:], net)
        x[:] += T * (RK45.B @ k)

    return run(duration, lambda: (x[:2].copy(), x[2:].copy()), step)


def _numpy_acceleration(
    q: np.ndarray, dq: np.ndarray, torque: np.ndarray
) -> np.ndarray:
    arm = ARM.arm
    P = ((arm.m1 + arm.m2) * arm.l1**2, arm.m2 * arm.l2**2, arm.m2 * arm.l1 * arm.l2)
    M, C, G = dynamics(P, arm.gravity / arm.l1, q, dq)
    return np.linalg.solve(M, torque - C @ dq - G)


_PEERS = {
    'numpy': (partial(_integrated, _numpy_acceleration), 'law, arm and DP5 in numpy'),
    'MuJoCo': (mujoco_loop, 'its RK4, law in numpy'),
    'pinocchio': (pinocchio_loop, 'aba, DP5 and law in numpy'),
}


def measure() -> Iterator[Ratio]:
    """Measure the time per simulated millisecond against C and the peers."""
    group = 'closed loop offline'
    contestants = {PACKAGE: _package(_LONG), C: lambda: len(reference_rows(_LONG))}
    times = interleaved(contestants, 4 * _ROUNDS)  # short rounds
    note = f'largest difference {disagreement():.0e}'
    yield ratio(group, PACKAGE, C, times[PACKAGE], times[C], note)

    contestants = {PACKAGE: _package(_SHORT)}
    for name, (loop, _) in _PEERS.items():
        contestants[name] = partial(lambda loop: len(loop(_SHORT)), loop)
    times = interleaved(contestants, _ROUNDS)
    for name, (_, note) in _PEERS.items():
        yield ratio(group, name, PACKAGE, times[name], times[PACKAGE], note)


def disagreement() -> float:
    """Return the largest difference to C over 10 s in errors [rad], torques and estimates."""
    rows = reference_rows(_AGREEMENT)
    record = simulate(LAW, replace(ARM, duration=_AGREEMENT), supervised=False)
    samples = [record.sample(k) for k in range(len(rows))]
    mine = np.array([np.concatenate((s.xi1, s.torque, s.estimate)) for s in samples])
    return float(np.abs(mine - rows).max())


def _package(duration: float) -> Callable[[], int]:
    plant = replace(ARM, duration=duration)
    return lambda: simulate(LAW, plant, supervised=False).stamps.size


def updates(name: str) -> tuple[str, Callable[[], int], int]:
    """Return the size of a preset's problem, a function that does some updates, and its memory.

    They are those of a simulated run without events, once the window is full. The p of
    the size counts all estimates, the m of the law. Raises RuntimeError if the run
    learns nothing.
    """
    ahead = (_GROWTH_ROUNDS + 1) * _UPDATES
    quiet: dict[str, object] = {
        f'events.{each}': [] for each in ('begin', 'duration', 'payload')
    }
    duration = FULL + T * ahead
    loop = load_loop(name, {PLANT: {'duration': duration, **quiet}})
    record = simulate(loop.controller, loop.plant, supervised=False)
    rows = zip((1e-9 * record.stamps).tolist(), record.measurements, strict=True)
    controller = controller_of(loop.controller)
    begin(controller, loop.controller, *record.measurements[0].reshape(3, -1)[:2])

    def update(count: int) -> int:
        for t, measurement in itertools.islice(rows, count):
            controller.update(t, T, measurement)
        return count

    update(len(record.stamps) - ahead)
    law = controller.settings
    size = (
        f'n = {law.n} joints, p = {law.m} unknowns ({law.p} of the arm + {law.m - law.p} of '
        'disturbances)'
    )
    if not controller.sample.latched[0]:
        raise RuntimeError(f'{name}: {size}: nothing is learned in {FULL:g} s')
    return size, lambda: update(_UPDATES), controller.state_vector.nbytes


def measure_growth() -> Iterator[Ratio]:
    """Measure the time per update relative to the two-link arm's, once the window is full."""
    found = {name: updates(name) for name in ('recommended', 'panda', 'ur5e')}
    times = interleaved(
        {name: update for name, (_, update, _) in found.items()}, _GROWTH_ROUNDS
    )
    baseline = times.pop('recommended')
    for name, seconds in times.items():
        size, _, memory = found[name]
        note = f'{1e6 * np.median(seconds):.1f} us an update here, {1e-6 * memory:.1f} MB of state'
        group = 'growth with joints and unknowns'
        what = f'{name}: {size}'
        yield ratio(group, what, _TWO_LINKS, seconds, baseline, note)
