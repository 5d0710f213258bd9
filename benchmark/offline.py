# SPDX-License-Identifier: Apache-2.0
"""Offline loop and study against the same in C, numpy, MuJoCo, pinocchio; replay against a reader.

The C reference is compiled on demand and called through ctypes. The peers run the recommended
configuration: all hold the torque over the sample and apply the disturbance, only the integration
of the arm differs.

In a study both sides run the same drawn plants, with friction, noise and delay, and keep the
largest and the rms error of each run. The package also draws the plants and keeps the other figures
of a study; the reference gets its settings already laid out. Neither writes anything.
"""

from __future__ import annotations

import ctypes
import importlib.util
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from harness import Ratio, interleaved, ratio
from mcap.reader import make_reader
from scipy.integrate import RK45

from blf_dsc_controller.bags.content import read_content
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import locate
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.law.factory import controller_of, settings_of_config
from blf_dsc_controller.replay.verify import verify
from blf_dsc_controller.simulation.bag import write_bag
from blf_dsc_controller.simulation.loop import simulate
from blf_dsc_controller.studies import runs
from blf_dsc_controller.studies.monte_carlo import (
    Study,
    load_study,
    origin_of,
    plant_with,
    random_numbers,
)
from blf_dsc_controller.studies.runs import Span, run_chunk, warm_up
from sim_plant.sensors import generator

sys.path.append(str(Path(__file__).parents[1] / 'test'))
from plain_law import PlainLaw, dynamics

PACKAGE = 'blf_dsc_controller'
C = 'C -O3'
_LONG = 60.0  # s
_SHORT = 8.0  # s, long enough for learning to begin
_AGREEMENT = 10.0  # s
_ROUNDS = 5
_DURATION = 10.0  # s
_RUNS = 50  # per round against C
_CHUNKS = 50  # per round on processes
_CHUNK = 4  # runs; few, so that the first to finish waits for at most one chunk
_C_LOOP = 'C -O3, in a loop'
_CHUNKED = 'run_chunk'
_READER = 'mcap reader, messages as bytes'
_ERRORS = ('max_error_ratio', 'rms_error_rad')
SOURCE = Path(__file__).with_name('reference.c')
# The package's kernels are compiled for the native processor too; contraction would change the
# numbers that are compared.
FLAGS = ('-O3', '-march=native', '-ffp-contract=off')
_N, _P, _COLUMNS = 2, 3, 9  # joints, parameters, columns of a row: xi1, torque, theta
Step = Callable[[float, np.ndarray], None]
State = Callable[[], tuple[np.ndarray, np.ndarray]]
CONTROLLER = ControllerConfig()
PLANT = PlantConfig()
T = PLANT.sample_time
_ARM = PLANT.arm


class Reference:
    """The compiled reference.

    Raises:
        FileNotFoundError: there is no C compiler named cc.
        subprocess.CalledProcessError: compilation fails.
    """

    def __init__(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            library = Path(folder, 'reference.so')
            command = ['cc', *FLAGS, '-shared', '-fPIC', '-o', str(library), str(SOURCE), '-lm']
            subprocess.run(command, check=True)
            self._run = ctypes.CDLL(str(library)).run
        vectors = [ctypes.c_void_p] * 3
        self._run.argtypes = (ctypes.c_void_p, ctypes.c_long, ctypes.c_long, *vectors)

    def rows(self, controller: ControllerConfig, plant: PlantConfig) -> np.ndarray:
        """Return rows (samples, 9) of a noise-free run, without the sample at `duration`."""
        settings = _settings(controller, plant)
        rows = np.zeros((round(plant.duration / plant.sample_time), _COLUMNS))
        self._call(settings, len(rows), 0, None, rows, None)
        return rows

    def study(
        self, controller: ControllerConfig, plants: Sequence[PlantConfig], settled_after: float
    ) -> Callable[[], np.ndarray]:
        """Return a function that runs many plants for `duration` and returns figures (plants, 4).

        These are the largest abs(xi1)/k_c and the rms of xi1 [rad] from `settled_after` [s] on, of
        both joints. The settings are laid out here; a call draws the noise with numpy and runs.
        """
        laid_out = [(_settings(controller, plant), plant) for plant in plants]

        def run_all() -> np.ndarray:
            figures = np.zeros((len(laid_out), 2 * _N))
            for (settings, plant), row in zip(laid_out, figures, strict=True):
                samples = round(plant.duration / plant.sample_time) + 1
                noise = None
                if plant.sensor.position_noise > 0.0 or plant.sensor.velocity_noise > 0.0:
                    noise = generator(plant.seed).standard_normal((samples, 2 * _N))
                settled = round(settled_after / plant.sample_time)
                self._call(settings, samples, settled, noise, None, row)
            return figures

        return run_all

    def _call(
        self, settings: ctypes.Structure, samples: int, settled: int, *vectors: np.ndarray | None
    ) -> None:
        addresses = (None if vector is None else vector.ctypes.data for vector in vectors)
        if self._run(ctypes.byref(settings), samples, settled, *addresses) != 0:
            raise MemoryError


def _settings(controller: ControllerConfig, plant: PlantConfig) -> ctypes.Structure:
    """Lay out `struct settings` of the C file: the same fields in order, integers as long."""
    law = settings_of_config(controller)
    arm, torque, reference = plant.arm, plant.disturbance, controller.reference
    values: dict[str, Any] = {
        **{name: getattr(arm, name) for name in ('l1', 'l2', 'm1', 'm2', 'gravity')},
        **{name: getattr(torque, name) for name in ('constant', 'amplitude', 'frequency', 'phase')},
        **{name: getattr(torque, name) for name in ('viscous', 'coulomb', 'coulomb_velocity')},
        'q0': plant.initial.position,
        'dq0': plant.initial.velocity,
        'position_noise': plant.sensor.position_noise,
        'velocity_noise': plant.sensor.velocity_noise,
        'offset': reference.offset,
        'swing': reference.amplitude,
        'tone': reference.frequency[0],
        **{name: getattr(law, name) for name in ('bound', 'weight', 'slope_limit', 'knee')},
        **{name: getattr(law, name) for name in ('K', 'mu', 'time_constant', 'Kp', 'gamma')},
        'limit': law.torque_limit,
        'P0': law.initial_estimate[:_P],
        **{name: getattr(law, name) for name in ('Gamma', 'kappa', 'rho', 'sigma')},
        **{name: getattr(law, name) for name in ('learning_start', 'pole', 'radius')},
        'T': plant.sample_time,
        'window': law.window,
        'interval': law.interval,
        'differenced': int(plant.sensor.velocity == 'differenced'),
        'delay': plant.actuator.delay,
    }
    fields = {
        name: ctypes.c_long if isinstance(value, int) else ctypes.c_double
        for name, value in values.items()
    }
    sizes = {name: len(value) for name, value in values.items() if np.ndim(value)}
    kinds = [(name, kind * sizes[name] if name in sizes else kind) for name, kind in fields.items()]
    settings: ctypes.Structure = type('Settings', (ctypes.Structure,), {'_fields_': kinds})(
        *(tuple(value) if np.ndim(value) else value for value in values.values())
    )
    return settings


def disturbance(t: float) -> np.ndarray:
    """Return tau_dist (2,) [N m]."""
    d = PLANT.disturbance
    wave = np.sin(np.multiply(d.frequency, t) + d.phase)
    return np.add(d.constant, np.multiply(d.amplitude, wave))


def run(duration: float, state: State, step: Step) -> np.ndarray:
    """Close the loop around a simulator with the numpy law."""
    law = PlainLaw(settings_of_config(CONTROLLER))
    reference = CONTROLLER.reference
    offset, swing = np.array(reference.offset), np.array(reference.amplitude)
    w = reference.frequency[0]
    errors = np.zeros((round(duration / T), 2))
    for k in range(len(errors)):
        t = k * T
        q, dq = state()
        qr = offset + swing * np.cos(w * t)
        dqr = -w * swing * np.sin(w * t)
        ddqr = -w * w * swing * np.cos(w * t)
        law.tau = law.update(t, T, qr, dqr, ddqr, np.concatenate((q, dq, law.tau)))
        errors[k] = q - qr
        step(t, law.tau)
    return errors


def numpy_loop(duration: float) -> np.ndarray:
    """Run the arm and a Dormand-Prince step in numpy, too."""
    return _integrated(duration, _numpy_acceleration)


def pinocchio_loop(duration: float) -> np.ndarray:
    """Run the arm by pinocchio's articulated-body algorithm, a Dormand-Prince step in numpy."""
    import pinocchio

    model = pinocchio.Model()
    parent = 0
    offset = 0.0
    for name, length, mass in (('joint1', _ARM.l1, _ARM.m1), ('joint2', _ARM.l2, _ARM.m2)):
        placement = pinocchio.SE3(np.eye(3), np.array([offset, 0.0, 0.0]))
        parent = model.addJoint(parent, pinocchio.JointModelRZ(), placement, name)
        tip = np.array([length, 0.0, 0.0])
        inertia = pinocchio.Inertia(mass, tip, np.zeros((3, 3)))
        model.appendBodyToJoint(parent, inertia, pinocchio.SE3.Identity())
        offset = length
    model.gravity.linear = np.array([0.0, -_ARM.gravity, 0.0])
    data = model.createData()

    def acceleration(q: np.ndarray, dq: np.ndarray, torque: np.ndarray) -> np.ndarray:
        return np.asarray(pinocchio.aba(model, data, q, dq, torque))

    return _integrated(duration, acceleration)


def mujoco_loop(duration: float) -> np.ndarray:
    """Run the arm by MuJoCo's RK4 at the sample time, with the disturbance held over it."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="{T}" integrator="RK4" gravity="0 {-_ARM.gravity} 0"/>
        <worldbody><body><joint axis="0 0 1"/><geom type="sphere" size="0.01" mass="{_ARM.m1}"
        pos="{_ARM.l1} 0 0" contype="0" conaffinity="0"/><body pos="{_ARM.l1} 0 0"><joint
        axis="0 0 1"/><geom type="sphere" size="0.01" mass="{_ARM.m2}" pos="{_ARM.l2} 0 0"
        contype="0" conaffinity="0"/></body></body></worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    data.qpos[:] = PLANT.initial.position
    data.qvel[:] = PLANT.initial.velocity

    def step(t: float, torque: np.ndarray) -> None:
        data.qfrc_applied[:] = torque - disturbance(t + 0.5 * T)
        mujoco.mj_step(model, data)

    return run(duration, lambda: (data.qpos.copy(), data.qvel.copy()), step)


def _integrated(
    duration: float, acceleration: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
) -> np.ndarray:
    x = np.concatenate((PLANT.initial.position, PLANT.initial.velocity))
    k = np.zeros((6, 4))

    def step(t: float, torque: np.ndarray) -> None:
        for stage, (a, c) in enumerate(zip(RK45.A, RK45.C, strict=True)):
            y = x + T * (a[:stage] @ k[:stage])
            net = torque - disturbance(t + c * T)
            k[stage, :2] = y[2:]
            k[stage, 2:] = acceleration(y[:2], y[2:], net)
        x[:] += T * (RK45.B @ k)

    return run(duration, lambda: (x[:2].copy(), x[2:].copy()), step)


def _numpy_acceleration(q: np.ndarray, dq: np.ndarray, torque: np.ndarray) -> np.ndarray:
    arm = PLANT.arm
    P = ((arm.m1 + arm.m2) * arm.l1**2, arm.m2 * arm.l2**2, arm.m2 * arm.l1 * arm.l2)
    M, C, G = dynamics(P, arm.gravity / arm.l1, q, dq)
    return np.linalg.solve(M, torque - C @ dq - G)


_PEERS = {
    'numpy': ('numpy', numpy_loop, 'law, arm and DP5 in numpy'),
    'MuJoCo': ('mujoco', mujoco_loop, 'its RK4, law in numpy'),
    'pinocchio': ('pinocchio', pinocchio_loop, 'aba, DP5 and law in numpy'),
}


def measure() -> Iterator[Ratio]:
    """Measure the time per simulated millisecond against C and, where installed, the peers."""
    yield from _beside_c()
    yield from _beside_peers()


def disagreement() -> float:
    """Return the largest difference to C over 10 s in errors [rad], torques and estimates."""
    plant = replace(PLANT, duration=_AGREEMENT)
    rows = Reference().rows(CONTROLLER, plant)
    record = simulate(CONTROLLER, plant, supervised=False)
    samples = [record.sample(k) for k in range(len(rows))]
    mine = np.array([np.concatenate((s.xi1, s.torque, s.estimate)) for s in samples])
    return float(np.abs(mine - rows).max())


def _package(duration: float) -> Callable[[], int]:
    plant = replace(PLANT, duration=duration)
    return lambda: simulate(CONTROLLER, plant, supervised=False).stamps.size


def _beside_c() -> Iterator[Ratio]:
    reference = Reference()
    plant = replace(PLANT, duration=_LONG)
    contestants = {
        PACKAGE: _package(_LONG),
        C: lambda: len(reference.rows(CONTROLLER, plant)),
    }
    times = interleaved(contestants, 4 * _ROUNDS)  # short rounds
    yield ratio(
        'closed loop offline',
        PACKAGE,
        C,
        times[PACKAGE],
        times[C],
        f'largest difference {disagreement():.0e}',
    )


def _beside_peers() -> Iterator[Ratio]:
    contestants = {PACKAGE: _package(_SHORT)}
    notes = {}
    for name, (module, loop, note) in _PEERS.items():
        if importlib.util.find_spec(module) is not None:
            contestants[name] = partial(lambda loop: len(loop(_SHORT)), loop)
            notes[name] = note
    times = interleaved(contestants, _ROUNDS)
    for name, note in notes.items():
        yield ratio('closed loop offline', name, PACKAGE, times[name], times[PACKAGE], note)


def measure_study() -> Iterator[Ratio]:
    """Measure runs per second relative to C, and to one process."""
    study = preset()
    warm_up(study)
    yield from _study_beside_c(study)
    yield from _processes(study)


def preset() -> Study:
    """Return the preset with this benchmark's duration, settled in its last fifth."""
    study = load_study(locate('monte_carlo'))
    plant = replace(study.plant, duration=_DURATION)
    settings = replace(study.settings, settled_after=0.8 * _DURATION, moments=())
    learning = replace(study.controller.learning, change_detection=False)  # the reference has none
    controller = replace(study.controller, learning=learning)
    return replace(study, controller=controller, plant=plant, settings=settings)


def study_disagreement(study: Study) -> float:
    """Return the largest relative difference in largest and rms errors between package and C."""
    theirs = _reference_of(study)()
    columns = run_chunk(study, 0, _RUNS)
    names = [f'{of}.{joint}' for of in _ERRORS for joint in study.plant.joints]
    mine = np.transpose([columns[name] for name in names])
    return float(np.abs(mine / theirs - 1.0).max())


def _reference_of(study: Study) -> Callable[[], np.ndarray]:
    origin = origin_of(controller_of(study.controller))
    plants = [plant_with(study, random_numbers(study, run), origin) for run in range(_RUNS)]
    return Reference().study(study.controller, plants, study.settings.settled_after)


def _study_beside_c(study: Study) -> Iterator[Ratio]:
    reference = _reference_of(study)
    contestants = {
        _CHUNKED: lambda: run_chunk(study, 0, _RUNS)['run'].size,
        _C_LOOP: lambda: len(reference()),
    }
    rates = {name: 1.0 / times for name, times in interleaved(contestants, _ROUNDS).items()}
    note = (
        f'{np.median(rates[_CHUNKED]):.0f} runs of {_DURATION:g} s a second here; '
        f'errors differ by at most {study_disagreement(study):.0e} of themselves'
    )
    what = f'{_CHUNKED}: runs a second, of a core'
    yield ratio('monte carlo', what, _C_LOOP, rates[_CHUNKED], rates[_C_LOOP], note)


def _processes(study: Study) -> Iterator[Ratio]:
    with runs.processes(1) as one_process, runs.processes(2) as two_processes:
        contestants = {
            'one': partial(_computed, study, one_process),
            'two': partial(_computed, study, two_processes),
        }
        single, double = interleaved(contestants, _ROUNDS).values()
    note = f'{np.median(1.0 / double):.0f} runs a second here; the pools were started before'
    what = 'two processes: runs a second'
    yield ratio('monte carlo', what, 'one process', 1.0 / double, 1.0 / single, note)


def _computed(study: Study, executor: Executor) -> int:
    spans = [Span(k * _CHUNK, _CHUNK) for k in range(_CHUNKS)]
    runs.compute(study, spans, executor, 6, lambda *_: None)
    return _CHUNK * _CHUNKS


def measure_replay() -> Iterator[Ratio]:
    """Measure messages per second relative to the mcap reader alone, on a bag of all topics."""
    plant = replace(PLANT, duration=_LONG)
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder, 'bag')
        write_bag(bag, simulate(CONTROLLER, plant), CONTROLLER, 'none', plant)
        messages = _iterated(bag)

        def replayed() -> int:
            found = verify(bag)
            if found.difference is not None:
                raise ValueError(f'{bag}: {found.difference}')
            return messages

        contestants = {
            _READER: lambda: _iterated(bag),
            'messages read and decoded': lambda: sum(read_content(bag).message_counts.values()),
            'bag replayed through the law and compared': replayed,
        }
        times = interleaved(contestants, _ROUNDS)
    for name in [*contestants][1:]:
        note = f'{1e-3 / np.median(times[name]):.0f} thousand messages a second here'
        what = f'{name}: messages a second'
        yield ratio('replay', what, _READER, 1.0 / times[name], 1.0 / times[_READER], note)


def _iterated(bag: Path) -> int:
    """Iterate over the messages of a bag of one file and return their number."""
    (file,) = bag.glob('*.mcap')
    with file.open('rb') as stream:
        return sum(1 for _ in make_reader(stream).iter_messages(log_time_order=False))
