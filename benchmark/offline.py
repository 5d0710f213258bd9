# SPDX-License-Identifier: Apache-2.0
"""Offline loop and study against C, numpy, MuJoCo, pinocchio; growth; replay against a reader.

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
import itertools
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
from blf_dsc_controller.configuration.nodes import load_loop, locate
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.law.factory import controller_of, settings_of_config
from blf_dsc_controller.reference.approach import reference_of
from blf_dsc_controller.reference.terms import sampled
from blf_dsc_controller.replay.verify import verify
from blf_dsc_controller.simulation.bag import write_bag
from blf_dsc_controller.simulation.loop import simulate
from blf_dsc_controller.studies import runs
from blf_dsc_controller.studies.monte_carlo import Study, draw, load_study, plant_with
from blf_dsc_controller.studies.runs import run_chunk, warm_up
from sim_plant.sensors import generator

sys.path.append(str(Path(__file__).parents[1] / 'test'))
from plain_law import PlainLaw, dynamics

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
_NOISE = (1e-4, 0.05)  # rad, rad/s, added to the reference to excite every column
_ANY_EXCITATION = 1e-12  # a threshold that every window passes, short ones and of many columns
_DURATION = 10.0  # s
_RUNS = 50  # per round against C
_CHUNKS = 50  # per round on processes
_CHUNK = 4  # runs; few, so that the first to finish waits for at most one chunk
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
        vector, integer = ctypes.c_void_p, ctypes.c_long
        self._run.argtypes = (vector, integer, integer, vector, vector, vector)

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
        self, settings: np.ndarray, samples: int, settled: int, *vectors: np.ndarray | None
    ) -> None:
        addresses = (None if vector is None else vector.ctypes.data for vector in vectors)
        if self._run(settings.ctypes.data, samples, settled, *addresses) != 0:
            raise MemoryError


def _settings(controller: ControllerConfig, plant: PlantConfig) -> np.ndarray:
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
    kinds = [
        (name, np.int64 if isinstance(value, int) else np.float64, np.shape(value))
        for name, value in values.items()
    ]
    return np.array([tuple(values.values())], np.dtype(kinds))


def disturbance(t: float) -> np.ndarray:
    """Return tau_dist (2,) [N m]."""
    d = PLANT.disturbance
    wave = np.sin(np.multiply(d.frequency, t) + d.phase)
    return np.add(d.constant, np.multiply(d.amplitude, wave))


def run(duration: float, state: State, step: Step) -> np.ndarray:
    """Close the loop around a simulator with the numpy law."""
    law = PlainLaw(settings_of_config(CONTROLLER))
    times = T * np.arange(round(duration / T))
    errors = np.zeros((times.size, 2))
    for k, (qr, dqr, ddqr) in enumerate(sampled(reference_of(CONTROLLER), times)):
        q, dq = state()
        law.tau = law.update(times[k], T, qr, dqr, ddqr, np.concatenate((q, dq, law.tau)))
        errors[k] = q - qr
        step(times[k], law.tau)
    return errors


def numpy_loop(duration: float) -> np.ndarray:
    """Run the arm and a Dormand-Prince step in numpy, too."""
    return _integrated(duration, _numpy_acceleration)


def pinocchio_loop(duration: float) -> np.ndarray:
    """Run the arm of our URDF by pinocchio's articulated-body algorithm, a DP5 step in numpy."""
    import pinocchio

    model = pinocchio.buildModelFromUrdf(str(_ROOT / 'config/two_link.urdf'))
    model.gravity.linear = np.array([0.0, 0.0, -PLANT.arm.gravity])
    data = model.createData()

    def acceleration(q: np.ndarray, dq: np.ndarray, torque: np.ndarray) -> np.ndarray:
        return np.asarray(pinocchio.aba(model, data, q, dq, torque))

    return _integrated(duration, acceleration)


def mujoco_loop(duration: float) -> np.ndarray:
    """Run the arm of the example by MuJoCo's RK4 at the sample time, with the disturbance held."""
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(_ROOT / 'examples/mujoco_plant/arm.xml'))
    data = mujoco.MjData(model)
    data.qpos[:] = PLANT.initial.position
    data.qvel[:] = PLANT.initial.velocity

    def step(t: float, torque: np.ndarray) -> None:
        data.qfrc_applied[:] = torque - disturbance(t + 0.5 * T)
        mujoco.mj_step(model, data)

    return run(duration, lambda: (data.qpos.copy(), data.qvel.copy()), step)


def _integrated(duration: float, acceleration: Callable[..., np.ndarray]) -> np.ndarray:
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
    reference, plant = Reference(), replace(PLANT, duration=_LONG)
    contestants = {PACKAGE: _package(_LONG), C: lambda: len(reference.rows(CONTROLLER, plant))}
    times = interleaved(contestants, 4 * _ROUNDS)  # short rounds
    note = f'largest difference {disagreement():.0e}'
    yield ratio('closed loop offline', PACKAGE, C, times[PACKAGE], times[C], note)

    contestants = {PACKAGE: _package(_SHORT)}
    for name, (module, loop, _) in _PEERS.items():
        if importlib.util.find_spec(module) is not None:
            contestants[name] = partial(lambda loop: len(loop(_SHORT)), loop)
    times = interleaved(contestants, _ROUNDS)
    for name in [*contestants][1:]:
        note = _PEERS[name][2]
        yield ratio('closed loop offline', name, PACKAGE, times[name], times[PACKAGE], note)


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


def measure_study() -> Iterator[Ratio]:
    """Measure runs per second relative to C, and to one process."""
    study = preset()
    warm_up(study)
    reference = _reference_of(study)
    with runs.processes(1) as single, runs.processes(2) as double:
        pairs: dict[str, dict[str, Callable[[], int]]] = {
            f'{_CHUNKED}: runs a second, of a core': {
                _CHUNKED: lambda: run_chunk(study, 0, _RUNS)['run'].size,
                'C -O3, in a loop': lambda: len(reference()),
            },
            'two processes: runs a second': {
                'two': partial(_computed, study, double),
                'one process': partial(_computed, study, single),
            },
        }
        for what, contestants in pairs.items():
            mine, theirs = (1.0 / times for times in interleaved(contestants, _ROUNDS).values())
            note = f'{np.median(mine):.0f} runs of {_DURATION:g} s a second here'
            if _CHUNKED in what:
                note += f'; errors differ by at most {study_disagreement(study):.0e} of themselves'
            yield ratio('monte carlo', what, [*contestants][1], mine, theirs, note)


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
    plants = [plant_with(study, draw(study, run)) for run in range(_RUNS)]
    return Reference().study(study.controller, plants, study.settings.settled_after)


def _computed(study: Study, executor: Executor) -> int:
    chunks = [range(k * _CHUNK, (k + 1) * _CHUNK) for k in range(_CHUNKS)]
    runs.compute(study, chunks, executor, 6, lambda *_: None)
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
        rates = {name: 1.0 / times for name, times in interleaved(contestants, _ROUNDS).items()}
    for name in [*contestants][1:]:
        note = f'{1e-3 * np.median(rates[name]):.0f} thousand messages a second here'
        what = f'{name}: messages a second'
        yield ratio('replay', what, _READER, rates[name], rates[_READER], note)


def _iterated(bag: Path) -> int:
    """Iterate over the messages of a bag of one file and return their number."""
    (file,) = bag.glob('*.mcap')
    with file.open('rb') as stream:
        return sum(1 for _ in make_reader(stream).iter_messages(log_time_order=False))


def learning(name: str, **changes: Any) -> ControllerConfig:
    """Return the controller of a preset, which learns from any window."""
    values = {
        'learning.excitation_threshold': _ANY_EXCITATION,
        'learning.change_detection': False,  # the states are noise, which no arm explains
    }
    return change(load_loop(name).controller, values | changes)


def label(config: ControllerConfig) -> str:
    """Describe the size of the problem; its p counts all estimates, the m of the law."""
    law = controller_of(config).settings
    columns = f'{law.p} of the arm + {law.m - law.p} of disturbances'
    return f'n = {law.n} joints, p = {law.m} unknowns ({columns})'


def updates(config: ControllerConfig) -> Callable[[], int]:
    """Return a function that does some thousand updates along the reference with a full window.

    Raises RuntimeError if nothing is learned from that window.
    """
    controller = controller_of(config)
    law = controller.settings
    full = round(law.learning_start / T) + law.window + law.interval
    ahead = full + (_GROWTH_ROUNDS + 1) * _UPDATES
    reference = sampled(controller.reference_vector, T * np.arange(ahead + 1))
    noise = np.random.default_rng(0).standard_normal((ahead + 1, 2, law.n))
    states = np.zeros((ahead + 1, 3, law.n))
    states[:, :2] = reference[:, :2] + noise * np.array(_NOISE)[:, np.newaxis]
    clock = itertools.count()

    def update(count: int) -> int:
        for k in itertools.islice(clock, count):
            controller.update(k * T, T, states[k].ravel())
        return count

    update(full)
    if not controller.sample.latched[0] or not np.isfinite(controller.state_vector).all():
        raise RuntimeError(f'{label(config)}: nothing is learned from the window')
    return lambda: update(_UPDATES)


def measure_growth() -> Iterator[Ratio]:
    """Measure the time per update relative to the two-link arm's, once the window is full."""
    tones = {'learning.viscous': True, 'learning.frequencies': [1.0, 2.0]}
    arms = {'two links': learning('recommended', **tones)}
    arms |= {name: learning(name) for name in ('panda', 'ur5e')}
    groups = {
        'joints and unknowns': {f'{name}: {label(law)}': law for name, law in arms.items()},
        'window': {
            f'window of {n} samples': learning('recommended', **{'learning.window': n * T})
            for n in (100, 100_000)
        },
    }
    for group, configs in groups.items():
        contestants = {_TWO_LINKS: updates(learning('recommended'))}
        contestants |= {name: updates(config) for name, config in configs.items()}
        times = interleaved(contestants, _GROWTH_ROUNDS)
        for name, config in configs.items():
            memory = controller_of(config).state_vector.nbytes / 1e6
            update = 1e6 * np.median(times[name])
            note = f'{update:.1f} us an update here, {memory:.1f} MB of state'
            yield ratio(
                f'growth with {group}', name, _TWO_LINKS, times[name], times[_TWO_LINKS], note
            )
