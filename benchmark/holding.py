# SPDX-License-Identifier: Apache-2.0
"""What users report of arms with soft drives, and these arms under this law.

    python -m benchmark holding

Both are simulated in MuJoCo, 10 % off their description as the presets have it.  A
position loop (`kp`, `kd`) moves one joint to targets; where it is is read 6 s later.

    openarm   openarm_ros2 #72: with the driver's gains (kp 20, kd 2.75) and without
              gravity joint 1 reaches 62 % of each target
    widowx    positronic #772, which measured another arm of this size (YAM, of which
              there is no package): its gains over a gravity model that falls short
              (here by 10 %) leave joints 29 and 32 mrad low
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from benchmark.harness import print_table
from blf_dsc_controller.configuration.nodes import load_loop
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.reference.trajectory import Trajectory, TrajectoryPoint
from blf_dsc_controller.run import FIRST_STAMP
from blf_dsc_controller.supervision.guard import Guard
from blf_dsc_controller.supervision.model_torque import gravity_torque
from sim_plant.mujoco_plant import MujocoPlant

_MOVING = 3.0  # s, to each target
_HELD = 3.0  # s, until the arm is looked at

AS_CONFIGURED: Mapping[str, object] = {}
RIGID: Mapping[str, object] = {
    'joint.stiffness': [],
    'joint.backlash': [],
    'sensor.side': 'link',
}

Torques = Callable[[int, np.ndarray, np.ndarray], np.ndarray]
"""Of the number of a state, its measurement (3 n,) and the target (n,) [rad]."""


class Case(NamedTuple):
    """An arm with the position loop that its users have.

    `gravity` is the share of the described gravity that the loop adds.
    """

    preset: str
    joint: int
    rest: tuple[float, ...]  # rad
    targets: tuple[float, ...]  # rad, of that joint, from `rest`
    kp: tuple[float, ...]  # N m/rad
    kd: tuple[float, ...]  # N m s/rad
    gravity: float


OPENARM = Case(
    'openarm',
    0,
    (0.0, -0.1, 0.0, 0.1, 0.0, 0.0, 0.0),
    tuple(np.radians((-30.0, -45.0, -60.0, -75.0, -90.0))),
    (20.0,) * 7,
    (2.75,) * 7,
    0.0,
)
WIDOWX = Case(
    'widowx',
    1,
    (0.0, 0.5, 0.5, 0.0, 0.0, 0.0),
    (0.8, 1.1, 1.4, 1.7, 2.0),
    (80.0, 80.0, 80.0, 40.0, 10.0, 10.0),  # i2rt's, of a YAM
    (5.0, 5.0, 5.0, 1.5, 1.5, 1.5),
    0.9,
)


class Reached(NamedTuple):
    """Where the joint is, of one target, and the largest error of any joint."""

    target: float  # rad
    position: float  # rad
    error: float  # rad


def arm_of(
    case: Case, gears: Mapping[str, object] = AS_CONFIGURED
) -> tuple[Guard, MujocoPlant]:
    """Return controller and arm of a case, at rest."""
    loop = load_loop(case.preset)
    nothing_happens: dict[str, list[float]] = {
        f'events.{name}': [] for name in ('begin', 'duration', 'payload')
    }
    at_rest = {'initial.position': list(case.rest)}
    plant = change(loop.plant, {**at_rest, **nothing_happens, **gears})
    controller = change(loop.controller, {'reference.type': 'hold'})
    return Guard(controller, lambda: 0, lambda: 0), MujocoPlant(plant)


def with_position_loop(case: Case) -> list[Reached]:
    """Return what the position loop reaches with rigid gears: some are another arm's gains."""
    guard, arm = arm_of(case, RIGID)
    law = guard.controller
    kp, kd = np.array(case.kp), np.array(case.kd)
    initial = law.settings.initial_estimate
    limit = law.settings.torque.limit

    def torque(_: int, measurement: np.ndarray, qr: np.ndarray) -> np.ndarray:
        q, dq = measurement.reshape(3, -1)[:2]
        gravity = case.gravity * gravity_torque(law.settings, initial, q)
        return np.asarray(np.clip(kp * (qr - q) - kd * dq + gravity, -limit, limit))

    return _visit(case, arm, torque)


def with_this_law(case: Case) -> list[Reached]:
    """Return what this law reaches with the defaults of the preset."""
    guard, arm = arm_of(case)
    guard.starting.activate()
    last = np.array(case.rest)

    def torque(k: int, measurement: np.ndarray, qr: np.ndarray) -> np.ndarray:
        nonlocal last
        if (qr != last).any():
            last = qr
            point = TrajectoryPoint(_MOVING, tuple(qr.tolist()))
            guard.motions.adopt(
                guard.motions.plan(Trajectory(guard.config.joints, (point,)))
            )
        found = guard.update(FIRST_STAMP + k * guard.config.sample_time_ns, measurement)
        if found is None or guard.supervisor.text:
            raise RuntimeError(guard.supervisor.text or guard.starting.waiting_for)
        return found

    return _visit(case, arm, torque)


def _visit(case: Case, arm: MujocoPlant, torque: Torques) -> list[Reached]:
    """Move the joint from target to target; return where it is at the end of each."""
    qr = np.array(case.rest)
    found = []
    samples = round(1e3 * (_MOVING + _HELD))
    for number, target in enumerate((case.rest[case.joint], *case.targets)):
        qr = qr.copy()
        qr[case.joint] = target
        for k in range(number * samples, (number + 1) * samples):
            arm.step(torque(k, arm.measure().copy(), qr))
        q = np.array(arm.data.qpos)
        error = float(np.abs(q - qr).max())
        found.append(Reached(target, float(q[case.joint]), error))
    return found[1:]


def share(reached: list[Reached], start: float) -> float:
    """Return the mean share of the way that was reached."""
    return float(
        np.mean([(each.position - start) / (each.target - start) for each in reached])
    )


def rows() -> list[list[str]]:
    """Return the table of both arms."""
    found = []
    for case in (OPENARM, WIDOWX):
        start = case.rest[case.joint]
        for name, run in (
            ('position loop', with_position_loop),
            ('this law', with_this_law),
        ):
            reached = run(case)
            found.append(
                [
                    case.preset,
                    name,
                    f'{share(reached, start):.1%}',
                    f'{1e3 * max(each.error for each in reached):.3g} mrad',
                    ', '.join(f'{np.degrees(each.position):.1f}' for each in reached),
                ]
            )
    return found


def main(_options: argparse.Namespace) -> None:
    """Print the table."""
    heads = ('arm', 'control', 'of the way', 'farthest joint', 'reached [degrees]')
    print_table(heads, rows())
