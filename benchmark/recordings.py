# SPDX-License-Identifier: Apache-2.0
"""Recordings of real robots, which others have published, as bags.

Folders are copies of the repositories named in `SOURCES`, whose text files are turned into bags, or
any with bags and a URDF.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import random_arm

from blf_dsc_controller.configuration.robot import Robot, parameters_of
from blf_dsc_controller.identification.windows import Rows
from blf_dsc_controller.run import Floats

PANDA = tuple(f'panda_joint{i}' for i in range(1, 8))
UR = (
    *('shoulder_pan_joint', 'shoulder_lift_joint', 'elbow_joint'),
    *('wrist_1_joint', 'wrist_2_joint', 'wrist_3_joint'),
)
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


def _bag(
    path: Path, joints: tuple[str, ...], time: Floats, q: Floats, effort: Floats
) -> Path:
    stamps = [1_000_000_000 + round(1e9 * t) for t in time]
    states = np.stack((q, np.zeros_like(q), effort), axis=1)  # no velocity is read
    return Path(random_arm.write_states(path, joints, states, stamps=stamps))


def _panda(folder: Path, bags: Path) -> Iterator[Taken]:
    log = folder / 'matlab/data/Exciting_Traj/Trajectory_1/rbt_log'
    time, q, torque = (
        np.loadtxt(log / f'exciting_traj_{name}.txt')
        for name in ('time', 'positions', 'torques')
    )
    text = (Path(__file__).parents[1] / 'config/panda.urdf').read_text(encoding='utf-8')
    # it was recorded without
    for part in ('hand', 'hand_tcp', 'leftfinger', 'rightfinger'):
        text = re.sub(
            rf'<link name="panda_{part}"(?: ?/>|>.*?</link>)', '', text, flags=re.DOTALL
        )
    names = 'hand_joint|hand_tcp_joint|finger_joint1|finger_joint2'
    text = re.sub(
        rf'<joint name="panda_(?:{names})".*?</joint>', '', text, flags=re.DOTALL
    )
    bag = _bag(bags / 'panda', PANDA, time, q.reshape(-1, 7), torque.reshape(-1, 7))
    yield Taken('Panda', Robot(urdf=text, tip='panda_link8'), bag, PANDA, _of_panda)


def _of_panda(rows: Rows, robot: Robot) -> Floats:
    """Return the torque of the inertias of Gaz et al., which are the URDF's, with their friction.

    The speed is that of the viscous column, which is filtered; friction is smooth.
    """
    chain = robot.chain(PANDA)
    parameters = parameters_of(robot, chain)
    p = parameters.model.p
    v = rows.columns['viscous']
    a, b, c = _PANDA_FRICTION
    friction = a / (1.0 + np.exp(-b * (v + c))) - a / (1.0 + np.exp(-b * c))
    rotors = np.zeros(7)
    return np.asarray(
        rows.matrix()[:, :, :p] @ parameters.of(chain.inertias, rotors) + friction
    )


def _ur10e(folder: Path, bags: Path) -> Iterator[Taken]:
    robot = Robot(urdf=str(folder / 'URe/urdf/ur10e.urdf'), tip='tool0')
    loads = {'20_02_19_14harm50sec': 'Load', '20_01_31-unload': 'load'}
    names = (
        '20_02_12-50sec_12harm',
        '20_02_12-40sec_12harm',
        '20_02_19_15harm50sec',
        *loads,
    )
    gains, P, friction = _of_ur10e(folder, robot)

    def published(rows: Rows, _: Robot) -> Floats:
        p = P.size
        n = len(UR)
        columns = [*range(p + 2 * n), *range(p + 3 * n, p + 4 * n)]
        return np.asarray(
            rows.matrix()[:, :, columns] @ np.append(P, friction) * _UR10E_GAINS / gains
        )

    def bag(name: str) -> Path:
        file = folder / f'dataset_ur10e/identification_data/ur-{name}.csv'
        table = np.loadtxt(file, delimiter=',')
        time = table[:, 0] - table[0, 0]
        q = table[:, 1:7]
        current = table[:, 13:19]
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
    q: Floats = motor @ np.linalg.inv(ratios).T + np.pi / 2.0 * np.array(
        (0, -1, 1, 0, 0, 0)
    )
    urdf = folder / 'examples/staubli_TX40/urdf/tx40_mdh_modified.urdf'
    joints = tuple(f'joint_{i}' for i in range(1, 7))
    bag = _bag(
        bags / 'tx40',
        joints,
        np.linspace(0.0, 2e-4 * (len(q) - 1), len(q)),
        q,
        current @ ratios,
    )
    yield Taken('TX40', Robot(urdf=str(urdf), tip='link_6'), bag, joints)


def bags_in(folder: Path, urdf: str) -> Iterator[Taken]:
    """Yield the bags of a folder, with the URDF in it, or else this one."""
    given = next(folder.glob('*.urdf'), urdf)
    for bag in sorted(
        [*folder.glob('*exciting*.db3'), *folder.glob('**/metadata.yaml')]
    ):
        name = bag.stem if bag.suffix == '.db3' else bag.parent.name
        yield Taken(
            name, Robot(urdf=str(given)), bag if bag.suffix == '.db3' else bag.parent
        )


# TIAGo's ratios times N m/A, by figaroh-examples; its torso has a torque sensor without its weight.
_TIAGO_GAINS = (1.0, *(13.6,) * 2, *(-8.7,) * 2, *(-20.5968,) * 3)


def _med7(folder: Path, bags: Path) -> Iterator[Taken]:
    """KUKA LBR Med7: 100 Hz, torques of the opposite sign, which `identify` finds."""
    table = np.loadtxt(folder / 'src/test/measurements.csv', delimiter=',', skiprows=1)
    joints = tuple(f'A{i}' for i in range(1, 8))
    time = np.asarray(0.01 * np.arange(len(table)), dtype=np.float64)
    bag = _bag(bags / 'med7', joints, time, table[:, :7], table[:, 7:14])
    urdf = folder / 'urdf/med/med7dock.urdf'
    yield Taken('LBR Med7', Robot(urdf=str(urdf)), bag, joints)


def _rokae(folder: Path, bags: Path) -> Iterator[Taken]:
    """Rokae xMate: 1 kHz, torque sensors of the joints; the URDF is put into the folder."""
    urdf = next(folder.glob('*.urdf'), None)
    if urdf is None:
        sys.exit(
            f'{folder}: put the URDF of its arm there, gazebo_xMatePro3.urdf or '
            'gazebo_xMatePro7.urdf of RokaeRobot/rokae_ros2'
        )
    data = folder / 'filtering/data/excit'
    q, torque = (
        np.loadtxt(data / f'excit_{name}_record.txt') for name in ('ang', 'torque')
    )
    joints = tuple(f'joint{i}' for i in range(1, 8))
    time = np.asarray(0.001 * np.arange(len(q)), dtype=np.float64)
    name = urdf.stem.removeprefix('gazebo_')
    bag = _bag(bags / name, joints, time, q, torque)
    yield Taken(f'Rokae {name}', Robot(urdf=str(urdf)), bag, joints)


def _figaroh(folder: Path, bags: Path) -> Iterator[Taken]:
    yield from _tx40(folder, bags)
    yield from _tiago(folder, bags)


def _tiago(folder: Path, bags: Path) -> Iterator[Taken]:
    examples = folder / 'examples/tiago'
    position, effort = (
        np.loadtxt(
            examples / f'data/identification/dynamic/tiago_{name}.csv',
            delimiter=',',
            skiprows=1,
        )
        for name in ('position', 'effort')
    )
    joints = ('torso_lift_joint', *(f'arm_{i}_joint' for i in range(1, 8)))
    robot = Robot(urdf=str(examples / 'urdf/tiago_48_schunk.urdf'))
    torque = effort[:, 1:] * np.array(_TIAGO_GAINS)
    torque[:, 0] += 9.81 * robot.chain(joints).inertias[:, 0].sum()
    bag = _bag(bags / 'tiago', joints, position[:, 0], position[:, 1:], torque)
    yield Taken('TIAGo', robot, bag, joints)


SOURCES: dict[str, Callable[[Path, Path], Iterator[Taken]]] = {
    'matlab/data/Exciting_Traj': _panda,  # marcocognetti/FrankaEmikaPandaDynModel
    'dataset_ur10e': _ur10e,  # shamilmamedov/dynamic_calibration
    'examples/staubli_TX40': _figaroh,  # thanhndv212/figaroh-examples
    'src/test/measurements.csv': _med7,  # lbr-stack/dynamic_parameter_identification
    # YanjunLIU-ac and NEUer02/Dynamic_Parameter_Identification_for_Rokae_xMate
    'filtering/data/excit/excit_torque_record.txt': _rokae,
}
"""Readers by a file that their folder has."""
