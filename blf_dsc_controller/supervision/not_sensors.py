# SPDX-License-Identifier: Apache-2.0
"""The message about efforts that are not the torques of joint sensors."""

from __future__ import annotations

from collections.abc import Sequence

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.torque_sensors import (
    COMMANDS,
    MAY_SHAKE,
    NONE,
    OFF,
    SHAKES,
    STILL_SHAKES,
)

_ALONE = 'the load observer is off, and the law goes on without it'
_DRIVER = (
    '. A driver of `blf_dsc drive` knows robot.effort of its robot, and takes no other: with one, '
    'set disturbance.observer_bandwidth to 0'
)
_SHAKES = (
    'joint {joint!r} %s by the load observer: a gear is softer than is known, efforts are not '
    'those of joint torque sensors, or positions are those of the motors; %s. If there are no '
    'such sensors, set robot.effort to unknown and robot.torque_loop to false; else commission '
    f'the arm, or set disturbance.observer_bandwidth to 0{_DRIVER}'
)
_TEXTS = {
    MAY_SHAKE: (
        'joint {joint!r} oscillates, and the load observer, which may be the cause, is slower '
        'there from now on: the gains are high for this arm or its base. Commission it, or give a '
        'smaller feedback.stiffness or disturbance.observer_bandwidth'
    ),
    SHAKES: _SHAKES
    % ('shakes', 'it follows loads more slowly from now on, where it shakes'),
    STILL_SHAKES: _SHAKES % ('has shaken', _ALONE),
    COMMANDS: (
        'the efforts are what is commanded, most of all that of joint {joint!r}, and not those '
        f'of joint torque sensors: {_ALONE}. Set robot.effort to commanded if they are commands '
        f'or unknown if they are currents of motors, and robot.torque_loop to false{_DRIVER}'
    ),
    OFF: (
        'the effort of joint {joint!r} is off {off:+.3g} {unit} from what is commanded while the '
        f'arm follows: a sensor is stuck, dead or in another unit{{load}}; {_ALONE}. Mend it, or '
        f'set robot.effort to unknown{_DRIVER}'
    ),
}
_LOAD = ', or the drives compensate another load than robot.drive_payload, {:g} kg'


def fault_of(controller: Controller) -> int:
    """Return what is wrong with the efforts, NONE if nothing is."""
    return int(controller.state.sensors.fault[0])


def is_off(controller: Controller) -> bool:
    """Whether efforts do not even follow the commands, so that they show nothing about them."""
    return fault_of(controller) == OFF


def text_of(controller: Controller, config: ControllerConfig) -> str:
    """Return what is wrong and the remedy; empty if nothing is."""
    fault = fault_of(controller)
    if fault == NONE:
        return ''
    i = int(controller.state.sensors.joint[0])
    off = float(controller.signals.sensors.differences[0, i])
    unit = config.units[i].torque
    robot = config.robot
    adds_weight = robot.effort == 'whole' and robot.drive_compensates != 'none'
    load = _LOAD.format(robot.drive_payload) if adds_weight else ''
    return _TEXTS[fault].format(joint=config.joints[i], off=off, unit=unit, load=load)


def joint_of(controller: Controller, joints: Sequence[str]) -> str:
    """Return the joint that shows it most."""
    return joints[int(controller.state.sensors.joint[0])]
