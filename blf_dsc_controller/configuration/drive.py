# SPDX-License-Identifier: Apache-2.0
"""Parameters of `blf_dsc drive`: driver, preparation of the robot, end."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Literal

from blf_dsc_controller.configuration.schema import (
    Vector,
    non_negative,
    parameter,
    positive,
)
from blf_dsc_controller.motors.damiao import ANSWERS, MODELS

_WHY = 'it is read once, before the motion starts'
_fixed = partial(parameter, read_only=_WHY)
_thresholds = partial(positive, (), read_only=_WHY, omittable=True)
_identifiers = partial(
    parameter, (), read_only=_WHY, omittable=True, at_least=1, at_most=0x7FE
)
_FORCE = 6


@dataclass(frozen=True)
class DriveConfig:
    """Parameters of `blf_dsc drive`, a loop on a robot's own interface without ROS."""

    driver: str = _fixed(
        'franka',
        'franka, damiao, or a Python file with a class DRIVER (drive/driver.py)',
    )
    feedback: Literal['host', 'motor'] = _fixed(
        'host',
        'who closes the feedback: the host, by torques, or as far as they can the '
        "motors' own PD, by reference, gains and the rest of the torque",
    )
    collision_torque: tuple[float, ...] = _thresholds(
        'external torque of each joint that stops the robot; empty: as configured in'
        ' the robot',
        'N m',
    )
    collision_force: tuple[float, ...] = _thresholds(
        'external force (3) and torque (3) at the hand that stop the robot; empty: '
        'as configured in the robot',
        'N, N m',
    )
    set_load: bool = _fixed(
        True,
        'send robot.drive_payload to the robot as its load; false: the robot has it already',
    )
    load_inertia: Vector = non_negative(
        (0.001, 0.001, 0.001),
        'inertia of that load about its centre, along the axes of the flange',
        'kg m^2',
        read_only=_WHY,
    )
    motor_ids: tuple[int, ...] = _identifiers(
        'damiao: identifier of the motor of each joint; empty: 1, 2, ...'
    )
    feedback_ids: tuple[int, ...] = _identifiers(
        'damiao: identifier with which each answers; empty: 16 more'
    )
    motor_directions: tuple[int, ...] = parameter(
        (),
        'damiao: 1 for a motor that turns with its joint, -1 against it; empty: 1',
        read_only=_WHY,
        omittable=True,
        at_least=-1,
        at_most=1,
    )
    motor_offsets: tuple[float, ...] = parameter(
        (),
        'damiao: position of each motor at the zero of its joint; empty: 0',
        'rad',
        read_only=_WHY,
        omittable=True,
    )
    motor_models: tuple[str, ...] = _fixed(
        (),
        'damiao: model of each motor, such as 4310, for simulated ones; real ones say '
        'themselves what their frames hold',
        omittable=True,
    )
    can_fd: bool = _fixed(False, 'damiao: send frames of CAN FD')
    at_end: Literal['hold', 'release'] = _fixed(
        'hold',
        'damiao: at the end, the motors hold the arm where it is, or are disabled: an arm '
        'without brakes falls',
    )
    namespace: str = _fixed('', 'ros: namespace of the node and of these topics')
    states: str = _fixed('', 'ros: topic of the joint states; empty: joint_states')
    commands: str = _fixed(
        '', 'ros: topic of the torques; empty: blf_dsc_controller/commands'
    )
    settle_time: float = positive(
        3.0,
        'longest time to wait for the arm to come to rest at the end',
        's',
        read_only=_WHY,
    )

    def identifiers(self, motors: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Return the identifiers of so many motors, and those with which they answer."""
        ids = self.motor_ids or tuple(range(1, motors + 1))
        return ids, self.feedback_ids or tuple(each + ANSWERS for each in ids)

    def problems(self) -> Iterator[str]:
        """Check thresholds, which come together and six at the hand, and motors."""
        if bool(self.collision_torque) != bool(self.collision_force):
            yield (
                'collision_torque and collision_force: got one of them, but a robot takes both: '
                'give both, or neither'
            )
        if len(self.collision_force) not in (0, _FORCE):
            yield (
                f'collision_force: got {len(self.collision_force)} entries, but three forces and '
                'three torques are needed'
            )
        yield from self._identifier_problems()
        if 0 in self.motor_directions:
            yield (
                f'motor_directions: got {list(self.motor_directions)}, but a motor turns with its '
                'joint, 1, or against it, -1'
            )
        unknown = [each for each in self.motor_models if each not in MODELS]
        if unknown:
            yield (
                f'motor_models: got {", ".join(unknown)}, but known are {", ".join(MODELS)}'
            )

    def _identifier_problems(self) -> Iterator[str]:
        """Check that no identifier on the bus stands for two motors, or both ways."""
        for name in ('motor_ids', 'feedback_ids'):
            given = getattr(self, name)
            twice = [each for each in given if given.count(each) > 1]
            if twice:
                yield (
                    f'{name}: got {list(given)}, but {twice[0]} is that of two motors: give each '
                    'its own'
                )
        motors = max(len(self.motor_ids), len(self.feedback_ids))
        ids, answers = self.identifiers(motors)
        # a motor may answer with its own identifier
        both = [
            each for k, each in enumerate(ids) if each in answers[:k] + answers[k + 1 :]
        ]
        if both:
            yield (
                f'motor_ids: got {both[0]}, with which another one answers: a motor would take '
                'answers for its commands'
            )
