# SPDX-License-Identifier: Apache-2.0
"""The first torque, the safe torque, and the second line against a dead controller.

The first torque is checked before it is sent to an arm that nobody has commanded yet. Whether
drives compensate gravity cannot be told from positions, but from the effort with which they hold a
resting arm: gravity if they do, nothing if the brakes hold it.  Only its direction and order of
magnitude are used, so it may also be a current.  An effort of nothing shows nothing if it may not
be measured, or not contain what the drives add: then a live arm gets no torque of gravity without
being told that its drives tolerate it.

The safe torque is computed from the last usable state; ramps lead from the last torque to it.
"""

from __future__ import annotations

from math import inf

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.model import regressors_at
from blf_dsc_controller.compiled.elementary import tanh
from blf_dsc_controller.configuration.controller import ControllerConfig, Safety
from blf_dsc_controller.errors import StartError
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.factory import settings_of_config
from blf_dsc_controller.law.state import Settings
from blf_dsc_controller.law.torque import RATE_CUT, added_torque

Vector = NDArray[np.float64]

_AT_REST = 0.01  # rad/s
_NOTICED = 0.02  # of the torque of gravity; a few amperes for some fifty N m
_MATTERS = 0.05  # of the torque limit
_ALIKE = 0.9  # cosine of the angle between two torques
_SEND = 'safety.first_torque: send'
_OBSERVER = 30.0  # rad/s, L: slow against the lag of velocities and torques
_LARGEST_LOAD = 0.5  # of the torque limit


class LastState:
    """The last usable joint state.

    Attributes:
        measurement: [q, dq, applied torque] (3 n,) [rad, rad/s, N m].
        q, dq: views of it; a velocity that is currently unknown is zero.
        ddq: acceleration since the state before (n,) [rad/s^2], None if it is unknown.
        age: time without a usable state [s]; infinite before the first.
    """

    def __init__(self, n: int) -> None:
        self.measurement = np.zeros(3 * n)
        self.q = self.measurement[:n]
        self.dq = self.measurement[n : 2 * n]
        self.ddq: Vector | None = None
        self.age = inf
        self._stamp = -1

    def take(self, stamp: int, measurement: Vector) -> None:
        """Store a valid state with its stamp [ns]."""
        self.measurement[:] = measurement
        self.ddq = None
        self.age = 0.0
        self._stamp = stamp

    def take_usable(
        self, stamp: int, measurement: Vector, velocity_limit: float, period: float
    ) -> None:
        """Store the usable part of any other state, `period` [s] after the last.

        Positions that are not finite or have a repeated stamp do not show where the arm is now. A
        velocity that is missing, not finite or beyond the limit is replaced with the one
        differenced from the positions, within the limit.
        """
        q, dq, _ = measurement.reshape(3, -1)
        if stamp == self._stamp or not np.isfinite(q).all():
            self.miss(period)
            return
        elapsed = (stamp - self._stamp) * 1e-9
        is_next = self.age == 0.0 and elapsed > 0.0
        differenced = np.zeros_like(q)
        if is_next:
            differenced = np.clip((q - self.q) / elapsed, -velocity_limit, velocity_limit)
        usable = np.where(np.abs(dq) <= velocity_limit, dq, differenced)
        self.ddq = (usable - self.dq) / elapsed if is_next else None
        self.q[:] = q
        self.dq[:] = usable
        self.age = 0.0
        self._stamp = stamp

    def miss(self, period: float) -> None:
        """Account for `period` [s] without a usable state."""
        self.dq[:] = 0.0
        self.ddq = None
        self.age += period


def model_torque(settings: Settings, estimate: Vector, *motion: Vector) -> Vector:
    """Return H(q, dq, dq, ddq) P^ (n,) [N m] of a motion q, dq, ddq (n,); at rest of q alone."""
    q, dq, ddq = motion if len(motion) > 1 else (*motion, *np.zeros((2, settings.n)))
    (H,) = regressors_at(settings.model, *(vector[np.newaxis] for vector in (q, dq, dq, ddq)))
    return np.asarray((H * estimate[: settings.p]).sum(axis=1))


def friction_torque(settings: Settings, estimate: Vector, dq: Vector) -> Vector:
    """Return the friction (n,) [N m] of the estimate at dq (n,) [rad/s], zero without columns."""
    n, at = settings.n, settings.p + settings.n * settings.bias
    torque = np.zeros(n)
    for is_on, effect in (
        (settings.viscous, dq),
        (settings.coulomb, [tanh(speed) for speed in dq / settings.coulomb_velocity]),
    ):
        if is_on:
            torque += estimate[at : at + n] * effect
            at += n
    return torque


def safe_torque(
    safety: Safety,
    settings: Settings,
    last: LastState,
    estimate: Vector,
    load: Vector,
    scale: Vector | float = 1.0,
) -> Vector:
    """Return the safe torque (n,) [N m], within the torque limit and always finite.

    It is zero, damping -D dq, or damping plus gravity H(q, 0, 0, 0) P^ and `load` (n,) [N m] as far
    as the drive does not add them, and fades to zero while no usable state arrives. D is the
    configured damping times `scale` (n,).
    """
    torque = np.zeros(settings.n)
    if last.age >= safety.fade_time:
        return torque
    with np.errstate(over='ignore', invalid='ignore'):  # checked below
        if safety.torque != 'zero':
            torque -= scale * np.array(safety.damping) * last.dq
        if safety.torque == 'hold_gravity':
            torque += model_torque(settings, estimate, last.q) + load
            torque -= added_torque(settings, last.q)
    if not np.isfinite(torque).all():
        return np.zeros(settings.n)
    limited = np.clip(torque, -settings.torque_limit, settings.torque_limit)
    return limited * (1.0 - last.age / safety.fade_time)


class SafeTorque:
    """The torque without the law: a ramp from the last torque to the safe torque.

    It obeys the rate limit, except for the last torque of all.

    What holds the arm besides the model's gravity is observed from its motion, in the stop, too:

        load' = L (tau - H(q, dq, dq, ddq) P^ - friction - load),   |load| <= half the torque limit

    Estimated friction is not part of it, since it helps to brake.  So an arm comes to rest with a
    payload, or with a model, that the law had not learned yet.  An arm that does not move at all
    (brakes) leaves the load as it is.

    Attributes:
        load: torque (n,) [N m] that the model lacks; initially the disturbance estimate of the law.
        commanded: the last torque (n,) [N m], from the law or this ramp.
        last: the last usable joint state.
        longest_step: time [s] for which one torque may change at the rate limit.
        scale: factor (n,) on the damping: measured inertia of the joints over the assumed.
    """

    def __init__(self, n: int) -> None:
        self.commanded = np.zeros(n)
        self.load = np.zeros(n)
        self.scale = np.ones(n)
        self.longest_step = inf
        self.last = LastState(n)
        self._start = np.zeros(n)
        self._duration = self._elapsed = 0.0

    def begin_ramp(self, duration: float, load: Vector) -> None:
        """Start a linear ramp of `duration` [s] at the last torque, with the `load` as known."""
        self.load[:] = load
        self._start[:] = self.commanded
        self._duration, self._elapsed = duration, 0.0

    @property
    def is_settled(self) -> bool:
        """Whether the ramp is over and the arm at rest, as far as its states show."""
        is_over = self._elapsed >= self._duration
        return is_over and self.last.age == 0.0 and float(np.abs(self.last.dq).max()) < _AT_REST

    def leave(self, safety: Safety, settings: Settings, estimate: Vector) -> Vector | None:
        """Return the last torque (n,) [N m]; None before the first usable state.

        It is not damped: a driver may hold it for ever, and a constant torque damps nothing.
        """
        self._duration = 0.0
        self.last.dq[:] = 0.0
        return self.advance(safety, settings, estimate, 0.0)

    def advance(
        self, safety: Safety, settings: Settings, estimate: Vector, dt: float
    ) -> Vector | None:
        """Return the torque (n,) [N m] `dt` [s] later; None before the first usable state."""
        if self.last.age == inf:
            return None
        if safety.torque == 'hold_gravity':
            self.observe(settings, estimate, dt)
        goal = safe_torque(safety, settings, self.last, estimate, self.load, self.scale)
        self._elapsed += dt
        if self._elapsed < self._duration:
            goal = self._start + self._elapsed / self._duration * (goal - self._start)
        if dt > 0.0:  # drives that stop when commands jump would brake
            step = settings.rate_limit * min(dt, self.longest_step)
            step = np.where(settings.rate_limit > 0.0, step, inf)
            goal = np.clip(goal, self.commanded - step, self.commanded + step)
        limit = settings.torque_limit
        self.commanded[:] = np.clip(goal, -limit, limit)
        return self.commanded

    def observe(self, settings: Settings, estimate: Vector, dt: float) -> None:
        """Update the load by the motion of the last `dt` [s] under the torque commanded before."""
        last, limit = self.last, settings.torque_limit
        if last.ddq is not None:
            with np.errstate(over='ignore', invalid='ignore'):
                explained = model_torque(settings, estimate, last.q, last.dq, last.ddq)
                explained += friction_torque(settings, estimate, last.dq)
            whole = self.commanded + added_torque(settings, last.q)
            residual = np.clip(whole - explained - self.load, -limit, limit)
            self.load += min(1.0, _OBSERVER * dt) * np.nan_to_num(residual)
        np.clip(self.load, -_LARGEST_LOAD * limit, _LARGEST_LOAD * limit, out=self.load)


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


def limit_first_torque(controller: Controller, last: Vector, dt: float) -> None:
    """Limit the rate of the law's first torque, `dt` [s] after the torque `last` (n,) [N m].

    The law does not know `last`.
    """
    settings, state, sample = controller.settings, controller.state, controller.sample
    step = np.where(settings.rate_limit > 0.0, settings.rate_limit * dt, inf)
    slowed = np.clip(sample.torque, last - step, last + step)
    limited = np.clip(slowed, -settings.torque_limit, settings.torque_limit)
    cut = limited != sample.torque
    state.rate_cuts[cut] += 1.0
    sample.cuts[cut] += RATE_CUT
    sample.torque[:] = state.torque[:] = limited


class SecondLine:
    """Decides when to command in the place of a silent controller, and what.

    Times are those [s] of a steady clock. It commands when no torque of the controller has been
    seen for `timeout` while joint states went on by half of that, by their stamps: a plant in
    lock-step, which waits for a torque, is left alone. It ends with the next torque of the
    controller, or when the safe torque has faded because the states stopped, too.

    The gravity is that of the initial estimate, and what it lacks (a payload, say) is observed from
    the motion and the controller's torques all along, as in a safe stop.

    Attributes:
        config: configuration of the controller.
        active: whether it commands now.
        takeovers: how often it began to.
        stamp: of the last joint state [ns]; -1 before the first.
        silence: time [s] without a torque of the controller at the last takeover.
    """

    def __init__(self, config: ControllerConfig, timeout: float, *, armed: bool = False) -> None:
        """Compile the model of a controller's configuration.

        With `armed` it does not wait for a first torque: the controller has died before.
        """
        self.config = config
        self.active = False
        self.takeovers = 0
        self.silence = 0.0
        self._timeout = timeout
        self._settings = settings_of_config(config)
        self._estimate = self._settings.initial_estimate
        self._safe = SafeTorque(self._settings.n)
        self._safe.longest_step = config.sample_time
        self.stamp = self._commanded_stamp = -1  # the second: before the last torque
        self._seen_at = self._polled_at = -inf
        self._commanded_at = inf  # no takeover before the first torque
        self._knows_torque = False
        self._armed = armed
        model_torque(self._settings, self._estimate, np.zeros(self._settings.n))

    def state(self, stamp: int, measurement: Vector, now: float) -> None:
        """Take a joint state with its stamp [ns]; `measurement` is [q, dq, effort] (3 n,)."""
        limit = self.config.safety.velocity_limit
        self._safe.last.take_usable(stamp, measurement, limit, self.config.sample_time)
        if stamp > self.stamp or self.stamp < 0:
            self._seen_at = now
        self.stamp = stamp
        if self._armed:
            self._armed, self._commanded_at, self._commanded_stamp = False, now, stamp

    def torque_of_controller(self, torque: Vector, now: float) -> None:
        """Take a torque (n,) [N m] that the controller has commanded, and hand over to it."""
        self._safe.commanded[:] = np.nan_to_num(torque)
        self._knows_torque = True
        self._commanded_at, self._commanded_stamp = now, self.stamp
        self.active = False

    def poll(self, now: float) -> Vector | None:
        """Return the torque (n,) [N m] to command now, None to stay silent."""
        dt, self._polled_at = min(now - self._polled_at, self._timeout), now
        safety, safe = self.config.safety, self._safe
        if now - self._seen_at > self.config.sample_time + safety.state_timeout:
            safe.last.miss(dt)
        if not self.active:
            if self._knows_torque:
                safe.observe(self._settings, self._estimate, dt)
            self._begin_if_due(now)
        if not self.active:
            return None
        torque = safe.advance(safety, self._settings, self._estimate, dt)
        if safe.last.age >= safety.fade_time:
            self.active, self._commanded_at = False, inf
        return torque

    def leave(self) -> Vector | None:
        """Return the torque to leave behind, None if the controller commands."""
        if not self.active:
            return None
        return self._safe.leave(self.config.safety, self._settings, self._estimate)

    def _begin_if_due(self, now: float) -> None:
        silence = now - self._commanded_at
        gone_on = (self.stamp - self._commanded_stamp) * 1e-9
        if silence > self._timeout and gone_on > 0.5 * self._timeout:
            self.active, self.silence = True, silence
            self.takeovers += 1
            if not self._knows_torque:  # as if the torque that the drive holds were the model's
                self._safe.leave(self.config.safety, self._settings, self._estimate)
