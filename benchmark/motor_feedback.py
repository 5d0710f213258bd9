# SPDX-License-Identifier: Apache-2.0
"""Feedback through a bus, and inside motors with a PD of their own: OpenArm.

    python benchmark/motor_feedback.py [LAW...]

The arm of the preset runs its motion for 14 s and picks up 0.5 kg at 8 s.  Its links are
10 % off, its rotors 20 %.  The motors run at 4 kHz, frames go at 250 or 500 Hz with the
ranges and bits of Damiao's, and arrive a period after the state behind them.  Gears are
rigid, or give way as planetary gears may (nothing is published of these): 4000, 2000 and
800 N m/rad at shoulder, elbow and wrist, with the encoders at the motors.

A cell has the largest error [mrad] of a link from 4 s on, and at the pick-up; the weight
found [kg]; and how far the arm moves in 2 s [rad] once the host is dead.  The laws are

    lerobot      LeRobot's gains for OpenArm in the motors, over the gravity of the
                 description: position and torque, no velocity
    whole        the gains of rigid gears, through the inertia matrix
    preset       LeRobot's gains as those of the joints
    stiff        twice of them

by torques alone (host), or inside the motors' PD (motor).
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection, Iterator, Mapping
from itertools import product
from typing import NamedTuple

import numpy as np
from harness import print_table

from blf_dsc_controller.configuration.nodes import LoopConfig, load_loop
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.control.arm_controller import ArmController
from blf_dsc_controller.drive.motor_feedback import MotorFeedback
from blf_dsc_controller.motors import damiao
from blf_dsc_controller.motors.frame import Frame, torque_alone
from blf_dsc_controller.supervision.model_torque import model_torque
from blf_dsc_controller.supervision.supervisor import Phase
from sim_plant.motors import MotorPlant

SECONDS, PICK_UP, SETTLED, DEAD = 14.0, 8.0, 4.0, 2.0  # s
RATE = 4000.0  # Hz, of the motors: they have 10 kHz or more, which takes longer
WEIGHT = 0.5  # kg
RANGES = damiao.ranges_of([damiao.MODELS[each] for each in damiao.OPENARM])
STIFFNESS = np.array([240.0, 240.0, 240.0, 240.0, 24.0, 31.0, 25.0])
DAMPING = np.array([5.0, 5.0, 3.0, 5.0, 0.3, 0.3, 0.3])
"""LeRobot's (config_openarm_follower.py of 27de2ca)."""
GEARS = [4000.0, 4000.0, 2000.0, 2000.0, 800.0, 800.0, 800.0]  # N m/rad

_Changes = Mapping[str, object]
LAWS: Mapping[str, _Changes] = {
    'lerobot': {  # whose errors and torques are no fault
        'robot.effort': 'unknown',
        'safety.saturation_time': 1e3,
        'barrier.bound': [0.3] * 7,
        'barrier.initial_bound': [0.0] * 7,
    },
    'whole': {
        'feedback.inertia': 'whole',
        'feedback.joint_stiffness': None,
        'feedback.joint_damping': None,
        'barrier.bound': [0.01] * 7,  # rad
    },
    'preset': {},
    'stiff': {'feedback.stiffness': 2.0},
}
ARMS: Mapping[str, _Changes] = {
    'rigid': {
        'joint.stiffness': None,
        'joint.backlash': None,
        'sensor.side': 'link',
    },
    'elastic': {'joint.stiffness': GEARS, 'joint.backlash': None},
}


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


def loop_of(law: str, arm: str, period: float) -> LoopConfig:
    """Return the configurations of a run."""
    time = {'sample_time': period}
    events = {
        'events.begin': [PICK_UP],
        'events.duration': [0.0],
        'events.payload': [WEIGHT],
    }
    plant = {**time, **events, 'sensor.resolution': damiao.ENCODER, **ARMS[arm]}
    given = {'blf_dsc_controller': {**time, **LAWS[law]}, 'sim_plant': plant}
    return load_loop('openarm', given)


def frames_of(
    law: str, feedback: str, controller: ArmController, latency: float
) -> Callable[[np.ndarray, np.ndarray], Frame]:
    """Return what is sent for a torque of the law, at measured positions."""
    if law != 'lerobot':
        motors = MotorFeedback(controller, RANGES, latency)
        inside = feedback == 'motor'
        return lambda torque, _: (
            motors.frame(torque) if inside else torque_alone(torque)
        )
    settings = controller.guard.controller.settings
    still = np.zeros(len(controller.joints))

    def lerobot(_: np.ndarray, q: np.ndarray) -> Frame:
        gravity = model_torque(settings, settings.initial_estimate, q)
        return Frame(controller.reference.q, still, STIFFNESS, DAMPING, gravity)

    return lerobot


def run(law: str, feedback: str, arm: str, period: float) -> Result:
    """Run a law on an arm, and let its host die at the end."""
    loop = loop_of(law, arm, period)
    controller = ArmController(loop.controller)
    arm_ = MotorPlant(change(loop.plant, {'duration': 0.0}), RANGES, RATE)
    n = len(controller.joints)
    frame_of = frames_of(law, feedback, controller, loop.plant.actuator.delay * period)
    errors = []
    stopped = None
    for k in range(round(SECONDS / period)):
        measured = arm_.measure()
        torque = controller.update(1.0 + k * period, *measured)
        if torque is None or controller.phase is Phase.SAFE_STOP:
            stopped = k * period
            break
        errors.append(position(arm_, n) - controller.reference.q)
        arm_.step(frame_of(torque, measured[0]))
    left = position(arm_, n)
    for _ in range(round(DEAD / period)):
        arm_.coast()
    travel = float(np.abs(position(arm_, n) - left).max())
    if stopped is not None:
        return Result(stopped, travel=travel)
    worst = np.abs(errors).max(axis=1)
    times = np.arange(worst.size) * period
    weight = np.nan if law == 'lerobot' else controller.load.mass
    before = worst[(times >= SETTLED) & (times < PICK_UP)]
    at = worst[(times >= PICK_UP) & (times < PICK_UP + SETTLED)]
    return Result(None, float(before.max()), float(at.max()), weight, travel)


def position(arm: MotorPlant, n: int) -> np.ndarray:
    """Return the positions (n,) [rad] of the links."""
    return np.array(arm.plant.truth()[-2 * n : -n])


def rows(laws: Collection[str]) -> Iterator[tuple[str, ...]]:
    """Yield a row for each law."""
    cases = [
        ('lerobot', 'motor'),
        *product(('whole', 'preset', 'stiff'), ('host', 'motor')),
    ]
    for law, feedback in cases:
        if law not in laws:
            continue
        cells = [
            str(run(law, feedback, arm, period))
            for arm, period in product(ARMS, (0.004, 0.002))
        ]
        yield f'{law}, {feedback}', *cells


def main() -> None:
    """Print the table."""
    heads = [f'{arm}, {rate} Hz' for arm, rate in product(ARMS, (250, 500))]
    print_table(['law', *heads], rows(sys.argv[1:] or LAWS))


if __name__ == '__main__':
    main()
