# SPDX-License-Identifier: Apache-2.0
"""The message about a load observer that is left out, and why."""

from __future__ import annotations

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.torque_sensors import NONE, OFF, OSCILLATING

_ALONE = 'the load observer is off, and the law goes on without it'
_DRIVER = (
    '. A driver of `blf_dsc drive` knows robot.effort of its robot, and takes no other: with one, '
    'set disturbance.observer_bandwidth to 0'
)
_TEXTS = {
    OSCILLATING: (
        f'joint {{joint!r}} oscillates with the load observer: {_ALONE}. A gear is softer than is '
        'known, efforts are not those of joint torque sensors, or positions are those of the '
        'motors. If there are no such sensors, set robot.effort to what efforts are '
        '(commanded, current or unknown) and robot.torque_loop to false; else commission the arm '
        f'(`blf_dsc commission`){_DRIVER}'
    ),
    OFF: (
        'the effort of joint {joint!r} is off {off:+.3g} {unit} from what is commanded while the '
        f'arm follows: a sensor is stuck, dead or in another unit{{load}}; {_ALONE}. Mend it, or '
        f'set robot.effort to unknown{_DRIVER}'
    ),
}
_LOAD = ', or the drives compensate another load than robot.drive_payload, {:g} kg'


def fault_of(controller: Controller) -> int:
    """Return what is wrong with the efforts: NONE, OSCILLATING or OFF of `law.torque_sensors`."""
    return int(controller.state.sensors.fault[0])


def is_off(controller: Controller) -> bool:
    """Whether efforts do not even follow the commands, so that they prove nothing about them."""
    return fault_of(controller) == OFF


def text_of(controller: Controller, config: ControllerConfig) -> str:
    """Return what is wrong and the remedy; empty if nothing is."""
    fault = fault_of(controller)
    if fault == NONE:
        return ''
    i = int(controller.state.sensors.joint[0])
    off = float(controller.signals.sensors.differences[i])
    unit = config.units[i].torque
    robot = config.robot
    adds_weight = robot.effort == 'whole' and robot.drive_compensates != 'none'
    load = _LOAD.format(robot.drive_payload) if adds_weight else ''
    return _TEXTS[fault].format(joint=config.joints[i], off=off, unit=unit, load=load)
