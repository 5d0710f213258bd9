# SPDX-License-Identifier: Apache-2.0
"""Checks before the first torque of an arm that nobody has commanded yet.

The effort of a resting arm shows whether its drives compensate gravity: it equals
gravity if they do, and is zero if the brakes hold the arm.  Only its direction and
order of magnitude are used, so it may also be a current.  A zero effort is inconclusive
if it may not be measured, or may not contain what the drives add.  Then no torque of
gravity is sent unless the configuration says that the drives tolerate it (`check_support`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.errors import StartError
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.reference.approach import AT_REST
from blf_dsc_controller.supervision.model_torque import gravity_torque
from blf_dsc_controller.supervision.reading import Reading

Vector = NDArray[np.float64]

MATTERS = 0.05
"""Fraction of the torque limit from which a torque of gravity matters."""

# rad/s: below it efforts are those of rest, which encoder steps interrupt
_RESTING_SPEED = 0.05
_NOTICED_GRAVITY = 0.02  # of the torque of gravity; a few amperes for some fifty N m
_ALIKE_COSINE = 0.9  # cosine of the angle between two torques
_SEND = 'safety.first_torque: send'
_DRIVER = (
    '. A driver of `blf_dsc drive` knows robot.drive_compensates and robot.effort of its robot, '
    f'and takes no others: if its states do not show that, set {_SEND}'
)


def check_support(
    controller: Controller, config: ControllerConfig, measurement: Vector
) -> None:
    """Check that it is known what holds the arm, or that the first step is limited.

    Brakes may hold it, or drives that compensate gravity, to which gravity would be added.
    `measurement` is [q, dq, effort] (3 n,).

    Raises:
        StartError: it is not known, and gravity matters.
    """
    robot = config.robot
    is_known = robot.drive_compensates != 'none' or robot.effort in ('whole', 'current')
    if not robot.urdf or is_known or config.safety.first_torque == 'send':
        return
    q, dq, effort = measurement.reshape(3, -1)
    gravity = gravity_torque(controller.settings, controller.state.estimate, q)
    unlimited = np.where(np.array(config.torque.first_step) > 0.0, 0.0, np.abs(gravity))
    worst = int(np.argmax(unlimited))
    matters = unlimited[worst] > MATTERS * config.torque.limit[worst]
    # an effort like gravity is refused by `check_first_torque`, with more to say
    is_held = np.isfinite(effort).all() and is_like(effort, gravity)
    if matters and not is_held and not np.abs(dq).max() > AT_REST:
        unit = config.units[worst].torque
        raise StartError(
            'what holds the arm? The arm rests, but the joint states do not show whether its '
            'brakes hold it, or drives that compensate gravity: on joint '
            f'{config.joints[worst]!r} gravity is {gravity[worst]:.4g} {unit}, and the effort is '
            f'{effort[worst]:.4g} {unit}. If the drives compensate gravity, set '
            'robot.drive_compensates. If not, set robot.effort to whole, if the drives measure '
            'torques, or set torque.first_step to the torques that may be sent at once'
        )


def check_first_torque(
    controller: Controller,
    config: ControllerConfig,
    reading: Reading,
    acting: Vector | None,
) -> None:
    """Check that the first torque may be sent; the controller has begun.

    `reading` is the first state; `acting` (n,) [N m] the command of another node, if one holds
    the arm.

    Raises:
        StartError: a joint would step by more than `torque.first_step`, gravity would be sent
            twice, or not at all.
    """
    if config.safety.first_torque == 'send':
        return
    torque = controller.trial(0.0, config.sample_time, reading.measurement)
    q, dq, effort = reading.q, reading.dq, reading.effort
    gravity = np.zeros_like(q)
    if config.robot.urdf and acting is None:
        gravity = gravity_torque(controller.settings, controller.state.estimate, q)
        _check_gravity(config, dq, effort, gravity, torque)
    # Of an effort that only contains commands, a torque is held that this one replaces.
    held = effort if config.robot.effort == 'commanded' else np.zeros_like(q)
    if acting is not None:
        held = acting
    text = _too_large_step(config, torque, held)
    if not text:
        return
    if config.robot.drive_compensates == 'none' and is_like(torque, gravity):
        text += (
            ': this is the gravity of the URDF. If the drives compensate it themselves, set '
            'robot.drive_compensates to gravity, or to gravity_and_friction'
        )
    speed = np.abs(dq)
    if speed.max() > AT_REST:
        fastest = int(np.argmax(speed))
        unit = config.units[fastest].of('rad/s')
        text += (
            f'; the arm still moves, joint {config.joints[fastest]!r} at {speed[fastest]:.3g} '
            f'{unit}: start again when it rests'
        )
    raise StartError(text)


def _too_large_step(config: ControllerConfig, torque: Vector, held: Vector) -> str:
    """Return which joint steps most from the `held` torque (n,) [N m]; empty if none by too much.

    `torque` (n,) [N m] is the first one, which replaces it.
    """
    step = np.array(config.torque.first_step)
    excess = np.where(step > 0.0, np.abs(torque - held) - step, 0.0)
    worst = int(np.argmax(excess))
    if excess[worst] <= 0.0:
        return ''
    unit = config.units[worst].torque
    return (
        f'the first torque would step to {torque[worst]:.4g} {unit} on joint '
        f'{config.joints[worst]!r}, more than the {step[worst]:g} {unit} that its drive tolerates '
        '(torque.first_step)'
    )


def is_like(torque: Vector, gravity: Vector) -> bool:
    """Whether a torque (n,) has the direction and magnitude of gravity."""
    sizes = float(np.linalg.norm(torque)), float(np.linalg.norm(gravity))
    return (
        sizes[0] > _NOTICED_GRAVITY * sizes[1]
        and float(torque @ gravity) > _ALIKE_COSINE * sizes[0] * sizes[1]
    )


def _check_gravity(
    config: ControllerConfig,
    dq: Vector,
    effort: Vector,
    gravity: Vector,
    torque: Vector,
) -> None:
    """Raise StartError if the arm would get gravity twice, or not at all."""
    worst = int(np.argmax(np.abs(gravity)))
    matters = np.abs(gravity[worst]) > MATTERS * config.torque.limit[worst]
    if not (
        matters and np.abs(dq).max() <= _RESTING_SPEED and np.isfinite(effort).all()
    ):
        return
    if config.robot.drive_compensates == 'none':
        _check_not_twice(config, effort, gravity, torque)
    else:
        _check_compensated(config, effort, gravity, torque)


def _check_not_twice(
    config: ControllerConfig, effort: Vector, gravity: Vector, torque: Vector
) -> None:
    """Raise StartError if an arm rests by efforts (n,) [N m] before any command.

    A joint torque sensor measures the weight of the arm, whatever holds it.
    """
    robot = config.robot
    shows_drives = robot.effort != 'commanded' and not robot.torque_loop
    if not (shows_drives and is_like(effort, gravity)):
        return
    worst = int(np.argmax(np.abs(gravity)))
    joint, unit = config.joints[worst], config.units[worst].torque
    raise StartError(
        f'gravity twice: the first torque would be {torque[worst]:.4g} {unit} on joint {joint!r}, '
        f'but the joint already rests with an effort of {effort[worst]:.4g} {unit}, before any '
        'command. If the drives compensate gravity, set robot.drive_compensates to gravity. '
        'If a torque of another or an earlier controller holds the arm, set robot.effort to '
        f'commanded (if efforts contain only commands), or {_SEND}{_DRIVER}'
    )


def _check_compensated(
    config: ControllerConfig, effort: Vector, gravity: Vector, torque: Vector
) -> None:
    """Raise StartError if efforts (n,) [N m] contradict that the drives compensate gravity."""
    worst = int(np.argmax(np.abs(gravity)))
    joint, unit = config.joints[worst], config.units[worst].torque
    is_commanded = config.robot.effort == 'commanded'
    no_gravity = (
        f'no gravity: robot.drive_compensates is {config.robot.drive_compensates}, but joint '
        f'{joint!r} rests'
    )
    if is_commanded and is_like(effort, gravity):
        raise StartError(
            f'{no_gravity} with a commanded effort of {effort[worst]:.4g} {unit}, where none '
            'should be needed. If the drives compensate nothing, set robot.drive_compensates to '
            'none. If the effort contains what the drives add, set robot.effort to whole. If a '
            f'torque of another controller holds the arm, set {_SEND}{_DRIVER}'
        )
    noticed = _NOTICED_GRAVITY * np.linalg.norm(gravity)
    if not is_commanded and np.linalg.norm(effort) <= noticed:
        raise StartError(
            f'{no_gravity} with an effort of {effort[worst]:.4g} {unit} where the drives should '
            f'hold {gravity[worst]:.4g} {unit}. The first torque, {torque[worst]:.4g} {unit}, '
            'would drop the arm. If the brakes hold it, release them. If the drives compensate '
            'nothing, set robot.drive_compensates to none. If the effort does not contain what the '
            f'drives add, set robot.effort to commanded, or {_SEND}{_DRIVER}'
        )
