# SPDX-License-Identifier: Apache-2.0
"""Identification and weighing, of simulated arms and of real recordings, each in one table.

    .venv/bin/python benchmark/identification.py arms --runs 100
    .venv/bin/python benchmark/identification.py weighing --runs 100
    .venv/bin/python benchmark/identification.py recordings FOLDER... [--urdf ur10.urdf]

arms        Panda, UR5e and random chains of six joints, with links, centres of mass, rotors and
            friction drawn at random, identified from positions and efforts alone: encoders of 20
            bits and 1 % noise of torque, for half a minute at 1 kHz and at 100 Hz.
weighing    What arms hold, weighed while they move. Each run has links up to 30 % heavier or
            lighter than the URDF's, centres of mass 1 cm off, drives and friction of its own, and a
            random motion of three tones that does not repeat. 2 kg are picked up after 10 to 14 s.
            The drives of `fr3` compensate gravity and friction by a wrong model.
recordings  Of real robots, which others have published. Folders are copies of the repositories
            named in `_SOURCES`, whose text files are turned into bags, or any with bags and a URDF.
            The errors are those of `blf_dsc identify`: of the torque on the last fifth of the
            motion, which no model has seen, in % of its root mean square.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
sys.path.append(str(Path(__file__).parents[1] / 'test'))

import re
import tempfile
import time
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
import random_arm
from harness import print_table
from numpy.typing import NDArray
from random_arm import PERIOD, is_covered, measured, recording_of, reference_of, shake, truth_of

from blf_dsc_controller.arms.urdf import pseudo_inertia
from blf_dsc_controller.configuration.nodes import CONTROLLER, PLANT, LoopConfig, load_loop
from blf_dsc_controller.configuration.robot import Robot, parameters_of
from blf_dsc_controller.identification.identify import (
    Identified,
    identify_arm,
    regression,
    windows_of,
)
from blf_dsc_controller.identification.prior import base_matrix, prior_of, solve
from blf_dsc_controller.identification.recording import (
    Recording,
    Rows,
    joined,
    read_recording,
    rows_of,
)
from blf_dsc_controller.law.telemetry import sample_columns
from blf_dsc_controller.reference.approach import MotionError
from blf_dsc_controller.run import Floats
from blf_dsc_controller.simulation.loop import simulate

_DURATION, _UNSEEN = 30.0, 10.0  # s
_EVERY = (1, 10)  # samples of 1 ms from state to state
_LOAD = 2.0  # kg
_AFTER = (1.0, 2.0, 3.0)  # s, from the pick-up to a reading
PANDA = tuple(f'panda_joint{i}' for i in range(1, 8))
UR = (
    *('shoulder_pan_joint', 'shoulder_lift_joint', 'elbow_joint'),
    *('wrist_1_joint', 'wrist_2_joint', 'wrist_3_joint'),
)
_WEAK = 100.0  # times the prior's deviations: semidefinite least squares with hardly any prior
# N m/A: UR10e's own target torque over its target current at rest, from the recordings.
_UR10E_GAINS = np.array((11.976, 11.976, 9.838, 10.763, 10.763, 10.763))
# Of the Panda, by Gaz et al. (2019): friction a / (1 + exp(-b (v + c))) - a / (1 + exp(-b c)).
_PANDA_FRICTION = np.array(
    (
        (0.54615, 0.87224, 0.64068, 1.2794, 0.83904, 0.30301, 0.56489),
        (5.1181, 9.0657, 10.136, 5.5903, 8.3469, 17.133, 10.336),
        (0.039533, 0.025882, -0.04607, 0.036194, 0.026226, -0.021047, 0.0035526),
    )
)
_HEADS = {
    'arms': ('rate', 'torque error on unseen motion: URDF', 'identified', '95 % intervals', 'time'),
    'weighing': (
        *('arm', 'nothing held [g]', *(f'2 kg after {t:g} s [g]' for t in _AFTER)),
        *('centre after 3 s [mm]', 'within 95 % intervals: mass', 'centre'),
    ),
    'recordings': (
        *('recording', 'URDF', 'published', 'least squares', 'semidefinite', 'identify'),
        *('its URDF', 'physical', 'friction found'),
    ),
}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('what', choices=_HEADS)
    parser.add_argument('folders', nargs='*', type=Path, metavar='FOLDER')
    parser.add_argument('--config', nargs='+', default=['panda', 'ur5e', 'fr3'])
    parser.add_argument('--runs', type=int, default=100, help='arms, or runs of each arm')
    parser.add_argument('--urdf', default='', help='of bags in folders without a URDF')
    options = parser.parse_args()
    weighed: list[str] = []
    with tempfile.TemporaryDirectory() as bags:
        rows: Iterable[tuple[str, ...]] = (_weighed(name, options.runs) for name in options.config)
        if options.what == 'arms':
            rows = _identified(options.runs)
        elif options.what == 'recordings':
            rows = _recorded(options.folders, options.urdf, Path(bags), weighed)
        print_table(_HEADS[options.what], rows)
    print('\n'.join(['', *weighed]))


def _identified(arms: int) -> list[tuple[str, ...]]:
    results = np.array([_of_arm(seed) for seed in range(arms)])  # (arms, rates, columns)
    print(f'{arms} arms, {np.sum(results[:, :, 4] == 0.0)} results with unphysical bodies')
    return [
        (
            f'{1.0 / (every * PERIOD):.0f} Hz',
            *(f'{np.median(e):.2f} % (95 of 100: {np.percentile(e, 95):.2f})' for e in rate[:2]),
            f'{100.0 * rate[2].mean():.1f} % hold the truth',
            f'{np.median(rate[3]):.2f} s',
        )
        for every, rate in zip(_EVERY, np.transpose(results, (1, 2, 0)), strict=True)
    ]


def _robot(seed: int) -> Robot:
    if seed % 3 == 2:
        return Robot(urdf=random_arm.random_urdf(6, seed)[0], tip='tip', payload=1.0)
    file, tip = (('panda.urdf', 'panda_hand_tcp'), ('ur5e.urdf', 'tool0'))[seed % 3]
    return Robot(urdf=(random_arm.CONFIG / file).read_text(), tip=tip)


def _of_arm(seed: int) -> list[tuple[float, ...]]:
    """Return for each rate the errors [%] before and after, coverage, time and whether physical."""
    robot = _robot(seed)
    chain = robot.chain(())
    joints, truth = tuple(joint.name for joint in chain.joints), truth_of(chain, seed)
    motion = measured(shake(chain, truth, reference_of(chain, 2 * seed), _DURATION), seed)
    unseen = shake(chain, truth, reference_of(chain, 2 * seed + 1), _UNSEEN)
    rows: list[tuple[float, ...]] = []
    for every in _EVERY:
        begin = time.perf_counter()
        found = identify_arm(recording_of(motion[::every], joints, every * PERIOD), robot)
        seconds = time.perf_counter() - begin
        errors = _errors(found, recording_of(unseen, joints))
        covered = float(np.mean(is_covered(found, truth)))
        rows.append((*errors, covered, seconds, float(_is_physical(found))))
    return rows


def _is_physical(found: Identified) -> bool:
    return all(np.linalg.eigvalsh(pseudo_inertia(body))[0] > 0.0 for body in found.parts.bodies)


def _errors(found: Identified, unseen: Recording) -> tuple[float, float]:
    rows = rows_of(unseen, found.parameters.model)
    G = base_matrix(found.parameters, len(unseen.joints))
    u = rows.u(0.5 * PERIOD)  # torques are held for a period
    errors = []
    for values in (found.prior, found.values):
        rows.set_load((G @ values)[: found.parameters.model.p])
        left = rows.X @ (G @ values)[:-1] - u
        errors.append(100.0 * float(np.linalg.norm(left) / np.linalg.norm(u)))
    return errors[0], errors[1]


def _weighed(name: str, runs: int) -> tuple[str, ...]:
    """Return the row of an arm."""
    loads = np.array([_weigh(name, seed) for seed in range(runs)])  # (runs, readings, 8)
    off = loads[:, :, 0] - (0.0, *(_LOAD,) * len(_AFTER))
    known = np.isfinite(off)
    cells = []
    for k, is_known in enumerate(known.T):
        errors = 1e3 * np.percentile(np.abs(off[is_known, k]), (50.0, 95.0, 100.0))
        unknown = f', {np.sum(~is_known)} unknown' if not is_known.all() else ''
        half = 1e3 * np.median(loads[is_known, k, 4])
        cells.append(f'{", ".join(f"{each:.0f}" for each in errors)} (± {half:.0f}{unknown})')
    centre, interval = loads[known[:, -1], -1, 1:4], loads[known[:, -1], -1, 5:]
    middle, half = 1e3 * np.median(np.abs(centre)), 1e3 * np.median(interval)
    cells.append(f'{middle:.1f} (± {half:.1f})')
    inside = np.abs(off[known]) < loads[:, :, 4][known], np.abs(centre) < interval
    return name, *cells, *(f'{100.0 * np.mean(part):.1f} %' for part in inside)


def _weigh(name: str, seed: int) -> Floats:
    """Return what is held (readings, 8) before the pick-up and after it."""
    random = np.random.default_rng(seed)
    begin, record = round(random.uniform(10.0, 14.0), 3), None
    while record is None:
        config = _random_loop(name, seed, begin, random)
        with suppress(MotionError):  # no approach keeps the limits: another motion
            record = simulate(config.controller, config.plant, supervised=False)
    load = sample_columns(record.samples, record.controller.settings).load
    times = np.array((begin, *(begin + t for t in _AFTER)))
    return np.asarray(load[np.round(times / config.controller.sample_time).astype(int)])


def _random_loop(name: str, seed: int, begin: float, random: np.random.Generator) -> LoopConfig:
    preset = load_loop(name)
    friction, reference = preset.plant.disturbance, preset.controller.reference
    n = len(preset.controller.joints)
    tones = len(reference.frequency)

    def varied(values: tuple[float, ...], least: float, most: float) -> list[float]:
        return [float(v) for v in np.array(values) * random.uniform(least, most, len(values))]

    amplitude = np.array(reference.amplitude).reshape(n, tones)
    amplitude = np.array([random.permutation(row) for row in amplitude])
    plant: dict[str, Any] = {
        'duration': begin + _AFTER[-1] + 0.1,
        'seed': seed,
        'truth.seed': int(random.integers(100_000)),
        'truth.mass_deviation': 0.3,
        'truth.centre_deviation': 0.01,
        'truth.rotor_factor': float(random.uniform(0.5, 1.3)),
        'disturbance.viscous': varied(friction.viscous, 0.5, 1.5),
        'disturbance.coulomb': varied(friction.coulomb, 0.5, 1.5),
        'sensor.incomplete_states': 0,
        'events.begin': [begin],
        'events.duration': [60.0],
        'events.payload': [_LOAD],
    }
    if name == 'fr3':
        plant['drive.seed'] = int(random.integers(100_000))
    controller = {
        'reference.amplitude': varied(tuple(amplitude.ravel()), -1.0, 1.0),
        'reference.frequency': varied(reference.frequency, 0.6, 1.2),
        'reference.phase': random.uniform(0.0, 6.0, tones).tolist(),
    }
    return load_loop(name, {PLANT: plant, CONTROLLER: controller})


Published = Callable[[Rows, Robot], Floats]


class Taken(NamedTuple):
    """A recording, and what its authors publish about the robot."""

    name: str
    robot: Robot
    bag: Path
    joints: tuple[str, ...] = ()
    published: Published | None = None  # torque (R, n) in all windows
    loaded: tuple[Path, float] | None = None  # bag with a load, and its mass [kg]


def _recorded(
    folders: list[Path], urdf: str, bags: Path, weighed: list[str]
) -> Iterator[tuple[str, ...]]:
    for folder in folders:
        read = next((read for file, read in _SOURCES.items() if (folder / file).exists()), None)
        for taken in read(folder, bags) if read else _bags(folder, urdf):
            recording = read_recording(taken.bag, taken.robot.text, taken.joints)
            yield _row(taken, recording)
            if taken.loaded:
                weighed.append(_weigh_loaded(taken, recording, *taken.loaded))


def _row(taken: Taken, recording: Recording) -> tuple[str, ...]:
    found = identify_arm(recording, taken.robot)
    errors = [_percent(e, found.torque) for e in found.errors]
    rows, test, baselines = _baselines(taken, recording)
    published = '-'
    if taken.published:
        u = rows.u(found.values[-1])[test]
        error = np.sqrt(np.mean((taken.published(rows, taken.robot)[test] - u) ** 2, axis=0))
        published = _percent(error, found.torque)
    cells = (taken.name, errors[0], published, *baselines, errors[2], errors[1])
    return *cells, 'yes' if _is_physical(found) else 'no', _terms(found)


def _terms(found: Identified) -> str:
    load, stribeck, quadratic = (np.flatnonzero(found.parts.terms[k]) + 1 for k in (3, 5, 6))
    texts = [
        f'{name} {", ".join(map(str, joints))}'
        for name, joints in (('load', load), ('Stribeck', stribeck), ('quadratic', quadratic))
        if joints.size
    ]
    return '; '.join([*texts, *(['coupled wrist'] if found.parts.coupling.any() else [])]) or '-'


def _baselines(taken: Taken, recording: Recording) -> tuple[Rows, NDArray[np.intp], list[str]]:
    """Return the rows, those held back, and the errors of plain and semidefinite least squares.

    Both have rotors, viscous and Coulomb friction, offsets and a delay, and joints weighted by
    their residuals; the first has no bounds and no prior.
    """
    robot = taken.robot
    chain = robot.chain(recording.joints)
    n = len(chain.joints)
    parameters = parameters_of(robot, chain)
    p = parameters.model.p
    rows = rows_of(recording, parameters.model)
    _, fit, test = windows_of(rows, n)
    used = [*range(p + 2 * n), *range(p + 3 * n, p + 4 * n)]
    deviation, delay = np.ones(n), 0.0
    for _ in range(8):
        rate, X = rows.rate(delay)[fit][:, :, None], rows.X[fit][:, :, used]
        A = np.concatenate((X, -rate), axis=2) / deviation[:, None]
        b = (rows.u(delay)[fit] - delay * rate[:, :, 0]) / deviation
        theta = np.linalg.lstsq(A.reshape(-1, A.shape[2]), b.ravel(), rcond=1e-12)[0]
        deviation = deviation * np.sqrt(np.mean((A @ theta - b) ** 2, axis=0))
        delay = float(theta[-1])
    u = rows.u(delay)[test]
    plain = rows.X[test][:, :, used] @ theta[:-1] - u
    largest = np.abs(recording.torque).max(axis=0)
    prior = prior_of(robot, chain, largest, np.maximum(rows.speed, 0.02), load=False)
    prior = prior.only([])
    cones = [cone._replace(E=_WEAK * cone.E) for cone in prior.cones]
    prior = prior._replace(D=_WEAK * prior.D, cones=cones, start=prior.start / _WEAK)
    G = base_matrix(parameters, n)
    found = regression(rows, fit, G, prior)
    values = prior.mean + prior.D @ solve(found.A, found.b, prior.cones, prior.start)
    w = rows.u(values[-1])[test]
    bounded = rows.X[test] @ (G @ values)[:-1] - w
    return rows, test, [_percent(plain, u), _percent(bounded, w)]


def _weigh_loaded(taken: Taken, empty: Recording, bag: Path, mass: float) -> str:
    together, boundary = joined(empty, read_recording(bag, taken.robot.text, taken.joints))
    texts = []
    for told in (boundary, float('nan')):
        found = identify_arm(together, taken.robot, picked_up=told)
        (m, *_), (s, *_) = found.load
        texts.append(f'{m:.3f} +- {1.96 * s:.2g} kg from {found.picked_up:.1f} s on')
    return f'{taken.name} with {mass:.3f} kg: {texts[0]}; as one bag: {texts[1]}'


def _percent(error: Floats, torque: Floats) -> str:
    return f'{100.0 * np.linalg.norm(error) / np.linalg.norm(torque):.2f}'


def _bag(path: Path, joints: tuple[str, ...], time: Floats, q: Floats, effort: Floats) -> Path:
    stamps = [1_000_000_000 + round(1e9 * t) for t in time]
    states = np.stack((q, np.zeros_like(q), effort), axis=1)  # no velocity is read
    return Path(random_arm.write_states(path, joints, states, stamps=stamps))


def _panda(folder: Path, bags: Path) -> Iterator[Taken]:
    log = folder / 'matlab/data/Exciting_Traj/Trajectory_1/rbt_log'
    time, q, torque = (
        np.loadtxt(log / f'exciting_traj_{name}.txt') for name in ('time', 'positions', 'torques')
    )
    text = (Path(__file__).parents[1] / 'config/panda.urdf').read_text(encoding='utf-8')
    for part in ('hand', 'hand_tcp', 'leftfinger', 'rightfinger'):  # it was recorded without
        text = re.sub(rf'<link name="panda_{part}"(?: ?/>|>.*?</link>)', '', text, flags=re.DOTALL)
    names = 'hand_joint|hand_tcp_joint|finger_joint1|finger_joint2'
    text = re.sub(rf'<joint name="panda_(?:{names})".*?</joint>', '', text, flags=re.DOTALL)
    bag = _bag(bags / 'panda', PANDA, time, q.reshape(-1, 7), torque.reshape(-1, 7))
    yield Taken('Panda', Robot(urdf=text, tip='panda_link8'), bag, PANDA, _of_panda)


def _of_panda(rows: Rows, robot: Robot) -> Floats:
    """Return the torque of the inertias of Gaz et al., which are the URDF's, with their friction.

    The speed is that of the viscous column, which is filtered; friction is smooth.
    """
    chain = robot.chain(PANDA)
    parameters = parameters_of(robot, chain)
    p = parameters.model.p
    joints = np.arange(7)
    v = rows.X[:, joints, p + joints]
    a, b, c = _PANDA_FRICTION
    friction = a / (1.0 + np.exp(-b * (v + c))) - a / (1.0 + np.exp(-b * c))
    rotors = np.zeros(7)
    return np.asarray(rows.X[:, :, :p] @ parameters.of(chain.inertias, rotors) + friction)


def _ur10e(folder: Path, bags: Path) -> Iterator[Taken]:
    robot = Robot(urdf=str(folder / 'URe/urdf/ur10e.urdf'), tip='tool0')
    loads = {'20_02_19_14harm50sec': 'Load', '20_01_31-unload': 'load'}
    names = ('20_02_12-50sec_12harm', '20_02_12-40sec_12harm', '20_02_19_15harm50sec', *loads)
    gains, P, friction = _of_ur10e(folder, robot)

    def published(rows: Rows, _: Robot) -> Floats:
        p = P.size
        n = len(UR)
        columns = [*range(p + 2 * n), *range(p + 3 * n, p + 4 * n)]
        return np.asarray(rows.X[:, :, columns] @ np.append(P, friction) * _UR10E_GAINS / gains)

    def bag(name: str) -> Path:
        file = folder / f'dataset_ur10e/identification_data/ur-{name}.csv'
        table = np.loadtxt(file, delimiter=',')
        time, q, current = table[:, 0] - table[0, 0], table[:, 1:7], table[:, 13:19]
        return _bag(bags / name, UR, time, q, current * _UR10E_GAINS)

    for name in names:
        loaded = None
        if name in loads:
            other = name.replace('unload', '') + loads[name]
            loaded = bag(other), 2.805
        yield Taken(f'UR10e {name}', robot, bag(name), UR, published, loaded)


def _of_ur10e(folder: Path, robot: Robot) -> tuple[Floats, Floats, Floats]:
    """Return gains, base parameters and friction that the authors publish for their robot."""
    text = (folder / 'UR10E_parameters.txt').read_text(encoding='utf-8')
    lists = {
        name: np.array(values.split(), dtype=float)
        for name, values in re.findall(r'(\w+) = \[([^\]]*)\]', text)
    }
    chain = robot.chain(UR)
    # Theirs: Ixx, Ixy, Ixz, Iyy, Iyz, Izz, hx, hy, hz, m
    inertias = lists['pi_rgd'].reshape(-1, 10)[:, [9, 6, 7, 8, 0, 1, 3, 2, 4, 5]]
    P = parameters_of(robot, chain).of(inertias, lists['pi_drvs'])
    return lists['drvGains'], P, lists['pi_frcn'].reshape(-1, 3).T.ravel()


def _tx40(folder: Path, bags: Path) -> Iterator[Taken]:
    data = folder / 'examples/staubli_TX40/data'
    motor, current = (
        np.loadtxt(data / f'{name}.csv', delimiter=',', skiprows=1)
        for name in ('pos_read_data', 'curr_data')
    )
    # Motors' torques and angles; the sixth motor is driven along by joint 5.
    ratios = np.diag((32.0, 32.0, 45.0, -48.0, 45.0, 32.0))
    ratios[5, 4] = 32.0
    q: Floats = motor @ np.linalg.inv(ratios).T + np.pi / 2.0 * np.array((0, -1, 1, 0, 0, 0))
    urdf = folder / 'examples/staubli_TX40/urdf/tx40_mdh_modified.urdf'
    joints = tuple(f'joint_{i}' for i in range(1, 7))
    bag = _bag(
        bags / 'tx40', joints, np.linspace(0.0, 2e-4 * (len(q) - 1), len(q)), q, current @ ratios
    )
    yield Taken('TX40', Robot(urdf=str(urdf), tip='link_6'), bag, joints)


def _bags(folder: Path, urdf: str) -> Iterator[Taken]:
    given = next(folder.glob('*.urdf'), urdf)
    for bag in sorted([*folder.glob('*exciting*.db3'), *folder.glob('**/metadata.yaml')]):
        name = bag.stem if bag.suffix == '.db3' else bag.parent.name
        yield Taken(name, Robot(urdf=str(given)), bag if bag.suffix == '.db3' else bag.parent)


_SOURCES: dict[str, Callable[[Path, Path], Iterator[Taken]]] = {
    'matlab/data/Exciting_Traj': _panda,  # marcocognetti/FrankaEmikaPandaDynModel
    'dataset_ur10e': _ur10e,  # shamilmamedov/dynamic_calibration
    'examples/staubli_TX40': _tx40,  # thanhndv212/figaroh-examples
}

if __name__ == '__main__':
    main()
