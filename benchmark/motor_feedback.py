# SPDX-License-Identifier: Apache-2.0
"""Feedback through a bus, and inside motors with a PD of their own: OpenArm, YAM.

    python -m benchmark motor-feedback [LAW...] [--arm openarm | yam] [--gears rigid elastic]

The arm of the preset runs its motion for 14 s and picks up 0.5 kg at 8 s.  Its links are
10 % off, its rotors 20 %.  The motors run at 4 kHz, frames go at 250 or 500 Hz with the
ranges and bits of Damiao's, and arrive a period after the state behind them.  So in all
columns the host gets positions in steps of 0.38 mrad.  Gears are

    rigid      and the motors' own encoders have steps of 0.043 mrad
    elastic    with the encoders at the motors: OpenArm's as planetary gears may give way
               (nothing is published of them), 4000, 2000 and 800 N m/rad at shoulder,
               elbow and wrist; YAM's as the preset has them, with their play
    coarse     elastic, and the motors know their positions and velocities only as they
               report them, in steps of 0.38 mrad

A cell has the largest error [mrad] of a link from 4 s on, and at the pick-up; the weight
found [kg]; and how far the arm moves in 2 s [rad] once the host is dead.  The laws are

    maker        the gains that LeRobot has for OpenArm and i2rt for YAM in the motors, over
                 the gravity of the description: position and torque, no velocity
    whole        the gains of rigid gears, through the inertia matrix
    published    the maker's gains as those of the joints
    stiff        twice of them
    preset       the gains of the preset, where they are others: OpenArm's

by torques alone (host), or inside the motors' PD (motor).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Collection, Iterator, Mapping
from itertools import product
from typing import NamedTuple

import numpy as np

from benchmark.harness import print_table
from blf_dsc_controller.configuration.drive import DriveConfig
from blf_dsc_controller.configuration.motor_options import limits_of
from blf_dsc_controller.configuration.nodes import (
    CONTROLLER,
    DRIVE,
    PLANT,
    LoopConfig,
    load,
    load_loop,
    locate,
)
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.control.arm_controller import ArmController
from blf_dsc_controller.drive.motor_feedback import MotorFeedback
from blf_dsc_controller.motors import damiao
from blf_dsc_controller.motors.frame import Frame, Ranges, torque_alone
from blf_dsc_controller.supervision.model_torque import gravity_torque
from blf_dsc_controller.supervision.supervisor import Phase
from sim_plant.motors import MotorPlant

SECONDS, PICK_UP, SETTLED, DEAD = 14.0, 8.0, 4.0, 2.0  # s
RATE = 4000.0  # Hz, of the motors: they have 10 kHz or more, which takes longer
WEIGHT = 0.5  # kg

_Changes = Mapping[str, object]
LAWS = ('maker', 'whole', 'published', 'stiff', 'preset')
GEARS: Mapping[str, _Changes] = {
    'openarm': {
        'joint.stiffness': [
            4000.0,
            4000.0,
            2000.0,
            2000.0,
            800.0,
            800.0,
            800.0,
        ],  # N m/rad
        'joint.backlash': None,
    },
    'yam': {},
}
"""Where elastic gears are not those of the preset."""
PUBLISHED: Mapping[str, _Changes] = {
    'openarm': {'feedback.joint_damping': [5.0, 5.0, 3.0, 5.0, 0.3, 0.3, 0.3]},
    'yam': {},
}
"""The maker's gains for motors, where those of the preset, for a host, are others."""
RIGID: _Changes = {
    'joint.stiffness': None,
    'joint.backlash': None,
    'sensor.side': 'link',
}
KINDS = ('rigid', 'elastic', 'coarse')


class Result(NamedTuple):
    """What a run shows."""

    stopped: float | None  # s; None: it did not
    late: float = np.nan  # rad
    pick_up: float = np.nan  # rad
    weight: float = np.nan  # kg
    travel: float = np.nan  # rad

    def __str__(self) -> str:
        if self.stopped is not None:
            return f'stops at {self.stopped:.2f} s, {self.travel:.2g}'
        weight = '-' if np.isnan(self.weight) else f'{self.weight:.3f}'
        late, pick_up = 1e3 * self.late, 1e3 * self.pick_up
        return f'{late:.1f}, {pick_up:.1f}; {weight}; {self.travel:.2g}'


def changes_of(arm: str, law: str, joints: int) -> _Changes:
    """Return what a law changes of the controller of a preset."""
    published = PUBLISHED[arm]
    if law == 'maker':  # whose errors and torques are no fault
        return {
            **published,
            'robot.effort': 'unknown',
            'safety.saturation_time': 1e3,
            'barrier.bound': [0.5] * joints,
            'barrier.initial_bound': [0.0] * joints,
        }
    if law == 'whole':
        return {
            'feedback.inertia': 'whole',
            'feedback.joint_stiffness': None,
            'feedback.joint_damping': None,
            'barrier.bound': [0.01] * joints,  # rad
        }
    stiffness = {'feedback.stiffness': 2.0} if law == 'stiff' else {}
    return {} if law == 'preset' else {**published, **stiffness}


def loop_of(arm: str, law: str, kind: str, period: float) -> LoopConfig:
    """Return the configurations of a run."""
    time = {'sample_time': period}
    events = {
        'events.begin': [PICK_UP],
        'events.duration': [0.0],
        'events.payload': [WEIGHT],
    }
    gears = RIGID if kind == 'rigid' else GEARS[arm]
    plant = {**time, **events, 'sensor.resolution': damiao.ENCODER, **gears}
    joints = len(load_loop(arm).controller.joints)
    given = {**time, **changes_of(arm, law, joints)}
    return load_loop(arm, {CONTROLLER: given, PLANT: plant})


def ranges_of(arm: str, joints: int) -> Ranges:
    """Return what the frames of an arm's motors hold."""
    config = load(locate(arm), DRIVE, DriveConfig)
    return damiao.ranges_of(limits_of(config, joints))


def frames_of(
    law: str, feedback: str, controller: ArmController, ranges: Ranges, latency: float
) -> Callable[[np.ndarray, np.ndarray], Frame]:
    """Return what is sent for a torque (n,) [N m] of the law, at positions (n,) [rad]."""
    if law != 'maker':
        motors = MotorFeedback(controller, ranges, latency)
        inside = feedback == 'motor'
        return lambda torque, _: (
            motors.frame(torque) if inside else torque_alone(torque)
        )
    settings = controller.guard.controller.settings
    still = np.zeros(len(controller.joints))
    stiffness, damping = map(
        np.array,
        (
            controller.config.feedback.joint_stiffness,
            controller.config.feedback.joint_damping,
        ),
    )

    def maker(_: np.ndarray, q: np.ndarray) -> Frame:
        gravity = gravity_torque(settings, settings.initial_estimate, q)
        return Frame(controller.reference.q, still, stiffness, damping, gravity)

    return maker


def run(arm: str, law: str, feedback: str, kind: str, period: float) -> Result:
    """Run a law on an arm, and let its host die at the end."""
    loop = loop_of(arm, law, kind, period)
    controller = ArmController(loop.controller)
    n = len(controller.joints)
    ranges = ranges_of(arm, n)
    config = change(loop.plant, {'duration': 0.0})
    plant = MotorPlant(config, ranges, RATE, as_reported=kind == 'coarse')
    latency = loop.plant.actuator.delay * period
    frame_of = frames_of(law, feedback, controller, ranges, latency)
    errors = []
    stopped = None
    for k in range(round(SECONDS / period)):
        measured = plant.measure()
        torque = controller.update(1.0 + k * period, *measured)
        if torque is None or controller.phase is Phase.SAFE_STOP:
            stopped = k * period
            break
        errors.append(position(plant, n) - controller.reference.q)
        plant.step(frame_of(torque, measured[0]))
    left = position(plant, n)
    for _ in range(round(DEAD / period)):
        plant.coast()
    travel = float(np.abs(position(plant, n) - left).max())
    if stopped is not None:
        return Result(stopped, travel=travel)
    worst = np.abs(errors).max(axis=1)
    times = np.arange(worst.size) * period
    weight = np.nan if law == 'maker' else controller.load.mass
    before = worst[(times >= SETTLED) & (times < PICK_UP)]
    at = worst[(times >= PICK_UP) & (times < PICK_UP + SETTLED)]
    return Result(None, float(before.max()), float(at.max()), weight, travel)


def position(plant: MotorPlant, n: int) -> np.ndarray:
    """Return the positions (n,) [rad] of the links."""
    return np.array(plant.plant.truth()[-2 * n : -n])


def rows(
    arm: str, laws: Collection[str], kinds: Collection[str]
) -> Iterator[tuple[str, ...]]:
    """Yield a row for each law, with some KINDS of gears."""
    cases = [
        ('maker', 'motor'),
        *product(LAWS[1:], ('host', 'motor')),
    ]
    for law, feedback in cases:
        if law not in laws or (law == 'preset' and not PUBLISHED[arm]):
            continue
        cells = [
            str(run(arm, law, feedback, kind, period))
            for kind, period in product(kinds, (0.004, 0.002))
        ]
        yield f'{law}, {feedback}', *cells


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument('--arm', choices=GEARS, default='openarm')
    parser.add_argument('--gears', nargs='+', choices=KINDS, default=KINDS)
    parser.add_argument('laws', nargs='*', metavar='LAW', help=', '.join(LAWS))


def main(options: argparse.Namespace) -> None:
    """Print the table."""
    kinds = options.gears
    heads = [f'{kind}, {rate} Hz' for kind, rate in product(kinds, (250, 500))]
    print_table(['law', *heads], rows(options.arm, options.laws or LAWS, kinds))
