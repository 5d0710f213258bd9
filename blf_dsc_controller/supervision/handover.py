# SPDX-License-Identifier: Apache-2.0
"""Torques without surprises: the first one, and those after a change of gains.

The first torque is checked before it is sent to an arm that nobody has commanded yet. Whether
drives compensate gravity cannot be told from positions, but from the effort with which they hold a
resting arm: gravity if they do, nothing if the brakes hold it.  Only its direction and order of
magnitude are used, so it may also be a current.  An effort of nothing shows nothing if it may not
be measured, or not contain what the drives add: then a live arm gets no torque of gravity without
being told that its drives tolerate it.

A jump of the gains at unchanged errors would make the torque jump. Two states of the law absorb
the difference: the surface filter is shifted with the virtual control, so that alpha2' does not
change, and the disturbance estimate, the integrator of the law, absorbs the rest; it then returns
to its own value at the rate of its gain. A joint whose disturbance gain is 0 has no integrator, so
its torque steps.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.compiled.layout import pack
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.errors import StartError
from blf_dsc_controller.law import barrier
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.factory import settings_of_config
from blf_dsc_controller.law.settings import LINEAR
from blf_dsc_controller.supervision.safe_torque import model_torque

Vector = NDArray[np.float64]

_AT_REST = 0.01  # rad/s
_NOTICED = 0.02  # of the torque of gravity; a few amperes for some fifty N m
_MATTERS = 0.05  # of the torque limit
_ALIKE = 0.9  # cosine of the angle between two torques
_SEND = 'safety.first_torque: send'


def check_first_torque(
    controller: Controller, config: ControllerConfig, measurement: Vector
) -> None:
    """Raise StartError if the first torque must not be sent; the controller has begun.

    `measurement` is [q (n,) rad, dq (n,) rad/s, effort (n,) N m].
    """
    if config.safety.first_torque == 'send':
        return
    torque = controller.trial(0.0, config.sample_time, measurement)
    q, dq, effort = measurement.reshape(3, -1)
    gravity = np.zeros_like(q)
    if config.robot.urdf:
        gravity = model_torque(controller.settings, controller.state.estimate, q)
        _check_gravity(config, dq, effort, gravity, torque)
    step = np.array(config.torque.first_step)
    # Of an effort that only contains commands, a torque is held that this one replaces.
    held = effort if config.robot.effort == 'commanded' else 0.0
    excess = np.where(step > 0.0, np.abs(torque - held) - step, 0.0)
    worst = int(np.argmax(excess))
    if excess[worst] <= 0.0:
        return
    text = (
        f'the first torque would step to {torque[worst]:.4g} N m on joint '
        f'{config.joints[worst]!r}, more than the {step[worst]:g} N m that its drive tolerates '
        '(torque.first_step)'
    )
    if _is_like(torque, gravity):
        text += (
            ': it is the gravity of the URDF; if the drives compensate it themselves, set '
            'robot.drive_compensates to gravity, or to gravity_and_friction'
        )
    raise StartError(text)


def _is_like(torque: Vector, gravity: Vector) -> bool:
    sizes = float(np.linalg.norm(torque)), float(np.linalg.norm(gravity))
    return sizes[0] > _NOTICED * sizes[1] and float(torque @ gravity) > _ALIKE * sizes[0] * sizes[1]


def check_support(controller: Controller, config: ControllerConfig, measurement: Vector) -> None:
    """Raise StartError if nothing shows what holds a live arm at rest, and nothing limits a step.

    It may be brakes, or drives that compensate gravity, to which gravity would be added.
    """
    robot = config.robot
    is_known = robot.drive_compensates != 'none' or robot.effort in ('whole', 'current')
    if not robot.urdf or is_known or config.safety.first_torque == 'send':
        return
    q, dq, effort = measurement.reshape(3, -1)
    gravity = model_torque(controller.settings, controller.state.estimate, q)
    unlimited = np.where(np.array(config.torque.first_step) > 0.0, 0.0, np.abs(gravity))
    worst = int(np.argmax(unlimited))
    matters = unlimited[worst] > _MATTERS * config.torque.limit[worst]
    is_held = np.isfinite(effort).all() and _is_like(effort, gravity)  # which the check above sees
    if matters and not is_held and not np.abs(dq).max() > _AT_REST:
        raise StartError(
            f'what holds the arm? It rests, its gravity is {gravity[worst]:.4g} N m on joint '
            f'{config.joints[worst]!r}, and its effort of {effort[worst]:.4g} N m does not show '
            'whether brakes hold it or drives that compensate gravity. Set robot.drive_compensates '
            'if they do; if not, set robot.effort to whole if the drives measure torques, or '
            'torque.first_step to the torques that may be sent at once'
        )


def _check_gravity(
    config: ControllerConfig, dq: Vector, effort: Vector, gravity: Vector, torque: Vector
) -> None:
    """Raise StartError if the arm would get gravity twice, or not at all."""
    worst = int(np.argmax(np.abs(gravity)))
    matters = np.abs(gravity[worst]) > _MATTERS * config.torque.limit[worst]
    if not (matters and np.abs(dq).max() <= _AT_REST and np.isfinite(effort).all()):
        return
    compensates, joint = config.robot.drive_compensates, config.joints[worst]
    holds, is_commanded = _is_like(effort, gravity), config.robot.effort == 'commanded'
    if compensates == 'none':
        if not holds or is_commanded:
            return
        raise StartError(
            f'gravity twice: the first torque would be {torque[worst]:.4g} N m on joint {joint!r}, '
            f'but it rests with an effort of {effort[worst]:.4g} N m before any command: '
            'the drives compensate gravity (set robot.drive_compensates to gravity), or a torque '
            'of another or an earlier controller holds the arm (set robot.effort to commanded if '
            f'the effort never contains anything else, or {_SEND})'
        )
    no_gravity = f'no gravity: robot.drive_compensates is {compensates}, but joint {joint!r} rests'
    if is_commanded and holds:
        raise StartError(
            f'{no_gravity} with a commanded effort of {effort[worst]:.4g} N m where none should be '
            'needed: set it to none, or robot.effort to whole if the effort contains what the '
            f'drives add, or, if a torque of another controller holds the arm, {_SEND}'
        )
    if not is_commanded and np.linalg.norm(effort) <= _NOTICED * np.linalg.norm(gravity):
        raise StartError(
            f'{no_gravity} with an effort of {effort[worst]:.4g} N m where the drives should hold '
            f'{gravity[worst]:.4g} N m: the first torque, {torque[worst]:.4g} N m, would drop the '
            'arm. Release the brakes if they hold it, or set robot.drive_compensates to none, or '
            f'robot.effort to commanded if the effort does not contain what the drives add, or '
            f'{_SEND}'
        )


_STABLE = 2.0  # x += -a x diverges for a >= 2
_ROUNDED = 1.0 + 1e-9  # times the radius, on which the projection may hold an estimate


def apply(controller: Controller, config: ControllerConfig) -> None:
    """Replace the settings of a law."""
    controller.settings_vector[:] = pack(settings_of_config(config))


def apply_bumpless(
    controller: Controller, config: ControllerConfig, t: float, measurement: Vector
) -> None:
    """Replace the settings of a running law without a jump of its torque.

    `t` [s] and `measurement` (3 n,) are those of the last sample.
    """
    state, signals, T = controller.state, controller.signals, config.sample_time
    controller.trial(t, T, measurement)
    beta2, demand = signals.beta2.copy(), signals.demand.copy()
    apply(controller, config)
    if controller.settings.surface != LINEAR:
        controller.trial(t, T, measurement)
        state.alpha2[:] += signals.beta2 - beta2
    controller.trial(t, T, measurement)
    integrates = controller.settings.gamma > 0.0
    state.disturbance[integrates] -= (signals.demand - demand)[integrates]


def problems(controller: Controller, config: ControllerConfig, t: float) -> Iterator[str]:
    """Yield reasons why a running law cannot accept a valid configuration at time t [s]."""
    state, p, learning = controller.state, controller.settings.p, config.learning
    errors, torques = np.abs(controller.sample.xi1), np.abs(controller.sample.torque)
    settings = settings_of_config(config)
    barrier.update_bound(settings, controller.signals, t)
    for joint, error, bound in zip(config.joints, errors, controller.signals.bound, strict=True):
        if not error < bound:
            yield (
                f'barrier.bound: {joint} is {error:.6g} rad from its reference now, outside of a '
                f'bound of {bound:g} rad: choose a wider one, or try again with a smaller error'
            )
    for joint, torque, limit in zip(config.joints, torques, config.torque.limit, strict=True):
        if torque > limit:
            yield (
                f'torque.limit: {joint} is held with {torque:.4g} N m now, more than a limit of '
                f'{limit:g} N m: choose a higher one'
            )
    norm = float(np.linalg.norm(state.estimate[:p]))
    if norm > _ROUNDED * learning.radius:
        yield (
            f'learning.radius: the norm of the estimate is {norm:.4g} kg m^2 now, above a '
            f'radius of {learning.radius:g} kg m^2: choose a larger one'
        )
    stretch = 1.0 if learning.update == 'newton' else float(np.linalg.norm(state.Phi, 2))
    step = learning.weight * float(settings.Gamma.max()) * stretch * config.sample_time
    if state.latched[0] and step >= _STABLE:
        yield (
            f'learning.weight: with the update {learning.update}, each sample would correct the '
            f'estimates by {step:.3g} times their error, which diverges at {_STABLE:g} or more: '
            'lower learning.weight or learning.adaptation_gain'
        )
