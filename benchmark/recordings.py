# SPDX-License-Identifier: Apache-2.0
"""Identification on recordings of real robots, which others have published.

    .venv/bin/python benchmark/recordings.py FOLDER... [--urdf ur10.urdf]

Folders are copies of the repositories named in `_SOURCES`, or of any folder with bags and a URDF.
Their text files are turned into bags. The errors are those of `blf_dsc identify`: of the torque on
the last fifth of the motion, which no model has seen, in % of its root mean square.
"""

from __future__ import annotations

import argparse
import os

os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import re
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from harness import print_table
from numpy.typing import NDArray

from blf_dsc_controller.arms.inertia import pseudo_inertia
from blf_dsc_controller.bags.writer import BagWriter
from blf_dsc_controller.configuration.robot import Robot, parameters_of
from blf_dsc_controller.identification.identify import (
    Identified,
    identify_arm,
    regression,
    windows_of,
)
from blf_dsc_controller.identification.prior import Prior, base_matrix, prior_of, solve
from blf_dsc_controller.identification.recording import (
    Recording,
    Rows,
    joined,
    read_recording,
    rows_of,
)
from blf_dsc_controller.messages.codecs import JointStateEncoder
from blf_dsc_controller.messages.topics import JOINT_STATE
from blf_dsc_controller.run import Floats

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
Published = Callable[[Rows, Robot], Floats]


class Taken(NamedTuple):
    """A recording, and what its authors publish about the robot."""

    name: str
    robot: Robot
    bag: Path
    joints: tuple[str, ...] = ()
    published: Published | None = None  # torque (R, n) in all windows
    loaded: tuple[Path, float] | None = None  # bag with a load, and its mass [kg]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('folders', nargs='+', type=Path, metavar='FOLDER')
    parser.add_argument('--urdf', default='', help='of bags in folders without a URDF')
    options = parser.parse_args()
    heads = ('URDF', 'published', 'least squares', 'semidefinite', 'identify', 'its URDF')
    weighed: list[str] = []
    with tempfile.TemporaryDirectory() as bags:
        rows = _rows(options.folders, options.urdf, Path(bags), weighed)
        print_table(('recording', *heads, 'physical', 'friction found'), rows)
    print('\n'.join(['', *weighed]))


def _rows(
    folders: list[Path], urdf: str, bags: Path, weighed: list[str]
) -> Iterator[tuple[str, ...]]:
    for folder in folders:
        read = next((read for file, read in _SOURCES.items() if (folder / file).exists()), None)
        for taken in read(folder, bags) if read else _bags(folder, urdf):
            recording = read_recording(taken.bag, taken.robot.text, taken.joints)
            yield _row(taken, recording)
            if taken.loaded:
                weighed.append(_weigh(taken, recording))


def _row(taken: Taken, recording: Recording) -> tuple[str, ...]:
    found = identify_arm(recording, taken.robot)
    errors = [_percent(e, found.torque) for e in found.errors]
    rows, test, baselines = _baselines(taken, recording)
    published = '-'
    if taken.published:
        u = rows.u(found.values[-1])[test]
        error = np.sqrt(np.mean((taken.published(rows, taken.robot)[test] - u) ** 2, axis=0))
        published = _percent(error, found.torque)
    physical = min(np.linalg.eigvalsh(pseudo_inertia(body))[0] for body in found.parts.bodies) > 0.0
    cells = (taken.name, errors[0], published, *baselines, errors[2], errors[1])
    return *cells, 'yes' if physical else 'no', _terms(found)


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
    prior = _weakened(prior.only([]))
    G = base_matrix(parameters, n)
    found = regression(rows, fit, G, prior)
    values = prior.mean + prior.D @ solve(found.A, found.b, prior.cones, prior.start)
    w = rows.u(values[-1])[test]
    bounded = rows.X[test] @ (G @ values)[:-1] - w
    return rows, test, [_percent(plain, u), _percent(bounded, w)]


def _weakened(prior: Prior) -> Prior:
    cones = [cone._replace(E=_WEAK * cone.E) for cone in prior.cones]
    return prior._replace(D=_WEAK * prior.D, cones=cones, start=prior.start / _WEAK)


def _weigh(taken: Taken, empty: Recording) -> str:
    assert taken.loaded  # noqa: S101 - for the type checker
    bag, mass = taken.loaded
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
    encoder = JointStateEncoder(joints, ('position', 'effort'))
    with BagWriter(path, flush_interval=None) as bag:
        handle = bag.add_topic('/joint_states', JOINT_STATE, [])
        for t, at, u in zip(time, q, effort, strict=True):
            stamp = 1_000_000_000 + round(1e9 * t)
            bag.write(handle, bytes(encoder.encode(stamp, at, (), u)), stamp)
    return path


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
