# SPDX-License-Identifier: Apache-2.0
"""Gains: warnings before the start, and changes of a running law without a jump of its torque.

Warnings are about gains, limits and windows that are valid but cannot work well. They are based on
the initial parameter estimate, which is a guess. doc/tuning.md derives them.

The errors to expect are those of the sampled loop at small errors.  About a motion that the law
follows, learning aside, the law is linear in the errors, and so is the arm with its inertia M of
that posture.  From one sample to the next the errors of n joints follow x+ = A x + B d with, for
each joint,

    x = [q, dq, drive torque, torque of the last sample, q of the last sample, filtered dq,
         alpha2, d^3]

where d [N m] is the torque that the model lacks.  Torques arrive a sample late and pass the drives,
velocities are differences of positions behind a filter; each of both lags is half of `robot.lag`.

A jump of the gains at unchanged errors would make the torque jump. Two states of the law absorb
the difference: the surface filter is shifted with the virtual control, so that alpha2' does not
change, and the disturbance estimate, the integrator of the law, absorbs the rest; it then returns
to its own value at the rate of its gain. A joint whose disturbance gain is 0 has no integrator, so
its torque steps.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.model import free_inertias, inertia_matrices, regressors_at
from blf_dsc_controller.arms.tuning import SAMPLES, UNKNOWN_EFFORT, loop_delay
from blf_dsc_controller.compiled.layout import pack
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.robot import implausible_friction, parameters_of
from blf_dsc_controller.law import barrier
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.factory import settings_of_config
from blf_dsc_controller.law.state import LINEAR, NEWTON, Settings
from blf_dsc_controller.reference.approach import reference_of
from blf_dsc_controller.reference.terms import sampled

Floats = NDArray[np.float64]

_MARGIN = 1.25  # recommended torque limit over what the reference needs
_PERIODS = 0.02  # periods by which a window may differ from a whole number
_SLUGGISH = 1.0  # rad/s^2; the weakest joint of the presets has 60
_POINTS = 400  # along the reference
_LONGEST = 120.0  # s of the reference
_RESPONSE = 20.0  # time constants of the damping, for which the response is followed
_MOMENTS = 40  # of the reference
_REVERSAL = 0.75  # of Coulomb friction: half of it too much at breakaway, with either sign
_STABLE = 2.0  # x += -a x diverges for a >= 2
_ROUNDED = 1.0 + 1e-9  # times the radius, on which the projection may hold an estimate


class ReferenceLoad(NamedTuple):
    """Torque, inertia and excitation along the reference."""

    torque: Floats  # largest magnitude (n,), N m
    inertia: Floats  # M, where positive definite (k, n, n), kg m^2
    excitation: Floats  # mean of H^T H (p, p)

    def rate(self, settings: Settings) -> float:
        """Return the largest eigenvalue of M^-1 K_p + omega_v, 1/s."""
        Kp = np.diag(settings.Kp)[np.newaxis]  # numpy 1 reads a lone matrix as vectors
        roots = np.linalg.eigvals(np.linalg.solve(self.inertia, Kp))
        return float(np.abs(roots).max(initial=0.0)) + settings.damping_rate

    @property
    def free_inertia(self) -> Floats:
        """Smallest inertia (n,) of each joint with the others free, kg m^2."""
        least: Floats = free_inertias(self.inertia).min(axis=0, initial=np.inf)
        return least

    def damping(self, settings: Settings) -> Floats:
        """Return the smallest damping (n,) of each joint with the others free, N m s/rad."""
        rate = settings.damping_rate
        damped = rate * self.free_inertia if rate > 0.0 else 0.0
        return settings.Kp + damped


def reference_load(config: ControllerConfig, settings: Settings) -> ReferenceLoad:
    """Evaluate the dynamics along the reference, over its slowest period."""
    model, P = settings.model, settings.initial_estimate[: settings.p]
    q, dq, ddq = _along(config, _POINTS)
    H = regressors_at(model, q, dq, dq, ddq)
    M = inertia_matrices(model, P, q)
    return ReferenceLoad(
        torque=np.abs(H @ P).max(axis=0),
        inertia=M[np.linalg.eigvalsh(M)[:, 0] > 0.0],
        excitation=np.einsum('kni,knj->ij', H, H) / _POINTS,
    )


def _along(config: ControllerConfig, count: int) -> Floats:
    """Return q, dq, ddq (3, k, n) over the whole reference, at most `_LONGEST`."""
    frequencies = [w for w in config.reference.frequency if w > 0.0]
    end = 2.0 * np.pi / min(frequencies, default=1.0)
    if config.reference.type == 'waypoints':
        end = max(config.reference.times)
    times = np.linspace(0.0, min(end, _LONGEST), count, endpoint=False)
    return np.moveaxis(sampled(reference_of(config), times), 1, 0)


def transition(
    settings: Settings, T: float, lag: float, M: Floats, M0: Floats, stiffness: Floats
) -> tuple[Floats, Floats]:
    """Return A (k, 8 n, 8 n) and B (k, 8 n, n) for the inertias M and M0 of the model (k, n, n).

    T [s] is the sample time, `lag` [s] that of velocity filter and drives together, and
    `stiffness` (n,) [N m/rad] the slope of the barrier.
    """
    n = settings.n
    decay = np.exp(-T / max(0.5 * lag, 1e-9))  # of the drives
    mean = (1.0 - decay) * 0.5 * lag / T  # of the drives' transient over the sample
    rate = settings.K / 2.0 + settings.mu
    g = barrier.filter_gain(settings.time_constant, T)
    # Rows of x, and of what the law computes in terms of x: alpha2', xi2 and the torque.
    q, dq, drive, last, before, speed, alpha2, d3 = np.eye(8 * n).reshape(8, n, 8 * n)
    measured = speed + (1.0 - decay) * ((q - before) / T - speed)
    beta2 = -rate[:, None] * q
    dalpha2 = g * (beta2 - alpha2) / T
    xi2 = measured - alpha2
    torque = (
        M0 @ (dalpha2 - settings.damping_rate * xi2)
        - settings.Kp[:, None] * xi2
        - stiffness[:, None] * q
        + d3
    )
    applied = mean * drive + (1.0 - mean) * last  # mean over the sample
    free = np.linalg.inv(M)
    push = free @ applied
    rows = [
        q + T * dq + 0.5 * T**2 * push,
        dq + T * push,
        decay * drive + (1.0 - decay) * last,
        torque,
        q,
        measured,
        alpha2 + T * dalpha2,
        d3 - T * settings.gamma[:, None] * xi2,
    ]
    A = np.concatenate(np.broadcast_arrays(*rows), axis=1)
    B = np.zeros((*A.shape[:-1], n))
    B[:, :n], B[:, n : 2 * n] = 0.5 * T**2 * free, T * free
    return A, B


def _peak_errors(
    config: ControllerConfig, settings: Settings, M: Floats, M0: Floats, torque: Floats
) -> Floats:
    """Return the largest errors (k, n) [rad] after a step of the torque d (k, n) [N m]."""
    A, B = transition(settings, config.sample_time, config.robot.lag, M, M0, settings.weight)
    push = (B @ torque[..., None])[..., 0]
    x, largest = np.zeros_like(push), np.zeros_like(torque)
    rate = max(settings.damping_rate, 1.0)
    for _ in range(round(_RESPONSE / rate / config.sample_time)):
        x = (A @ x[..., None])[..., 0] + push
        largest = np.maximum(largest, np.abs(x[:, : settings.n]))
    return largest


class ExpectedErrors(NamedTuple):
    """Largest errors (n,) [rad] along the reference, before anything is learned of their cause."""

    unmodelled: Floats  # of learning.residual_floor and friction at a reversal
    pick_up: Floats  # when robot.payload is picked up in motion


def expected_errors(config: ControllerConfig, settings: Settings) -> ExpectedErrors:
    """Return the errors to expect from an arm of a URDF, by the linear loop without the barrier."""
    model, robot = settings.model, config.robot
    chain = robot.chain(config.joints)
    if config.reference.type == 'hold':  # at rest anywhere
        limits = config.limits.position_lower, config.limits.position_upper
        q = np.random.default_rng(0).uniform(*limits, (_MOMENTS, len(config.joints)))
        dq = ddq = np.zeros_like(q)
    else:
        q, dq, ddq = _along(config, _MOMENTS)
    P0 = settings.initial_estimate[: settings.p]
    load = robot.payload * parameters_of(robot, chain).load
    M0, M = (inertia_matrices(model, P, q) for P in (P0, P0 + load))
    floor = np.array(config.learning.residual_floor)
    floor += _REVERSAL * np.array(robot.friction(chain)['coulomb'])
    unmodelled = _peak_errors(config, settings, M0, M0, np.broadcast_to(floor, q.shape))
    pick_up = _peak_errors(config, settings, M, M0, regressors_at(model, q, dq, dq, ddq) @ load)
    return ExpectedErrors(unmodelled.max(axis=0), pick_up.max(axis=0))


class Finding(NamedTuple):
    """A limit of the gains: on what, how much of it is used, and what follows above 1."""

    subject: str
    use: float
    text: str  # goes on after the subject


def config_warnings(config: ControllerConfig, load: ReferenceLoad | None = None) -> list[str]:
    """Return the warnings, one sentence each, beginning with the parameter to change first.

    `load` is that of the reference, if known.
    """
    settings = settings_of_config(config)
    load = load or reference_load(config, settings)
    found = [*_of_urdf(config, load)] if config.model == 'urdf' else []
    found += [f'{each.subject} {each.text}' for each in _of_gains(config, load)]
    if config.model == 'urdf' and config.law == 'blf_dsc':
        found += _of_errors(config, settings)
    if settings.surface != LINEAR and settings.kappa > 0.0 and settings.Gamma.any():
        found += _of_learning(config, settings, load)
    return found


def worsened(before: ControllerConfig, after: ControllerConfig, load: ReferenceLoad) -> list[str]:
    """Return the warnings on gains that are new or worse after a change."""
    known = {each.subject: each.use for each in _of_gains(before, load)}
    return [
        f'{each.subject} {each.text}'
        for each in _of_gains(after, load)
        if each.use > known.get(each.subject, 1.0)
    ]


def _of_urdf(config: ControllerConfig, load: ReferenceLoad) -> Iterator[str]:
    """Check for figures that nobody can have measured, and for defaults that are hardly meant."""
    robot = config.robot
    chain = robot.chain(config.joints)
    if (joints := robot.placeholder_efforts(chain)) and not robot.rotor_inertia:
        largest = max(joint.effort for joint in chain.joints)
        yield (
            f'torque.limit: an effort of up to {largest:g} N m for {", ".join(joints)} limits '
            'nothing on an arm of this weight, from which the inertia of the drives and '
            'learning.residual_floor follow instead: give the rated torques'
        )
    if (joints := implausible_friction(chain)) and not (robot.viscous and robot.coulomb):
        yield (
            f'robot.coulomb: the friction in <dynamics> takes a quarter of the effort of '
            f'{", ".join(joints)} or more, hardly real, and is not compensated before it is '
            'learned: give robot.viscous and robot.coulomb'
        )
    for joint, limit, inertia in zip(
        chain.joints, config.torque.limit, load.free_inertia, strict=True
    ):
        if math.isinf(joint.effort) and limit == UNKNOWN_EFFORT:
            yield (
                f'torque.limit: {joint.name} has no effort in the URDF: {limit:g} N m is assumed; '
                'set what its drive can withstand'
            )
        if limit / inertia < _SLUGGISH:
            yield (
                f'robot.urdf: {joint.name} accelerates at only {limit / inertia:.2g} rad/s^2 at '
                'its torque limit: are masses in kg, inertias in kg m^2, lengths in m?'
            )


def expectation(config: ControllerConfig) -> str:
    """Return the largest errors to expect of an arm of a URDF, in a sentence."""
    errors = expected_errors(config, settings_of_config(config))
    usual, most = (1e3 * float(each.max()) for each in errors)
    joint = config.joints[int(errors.pick_up.argmax())]
    return (
        f'{usual:.2g} mrad by friction and unmodelled torque; {most:.2g} mrad of {joint} when '
        f'{config.robot.payload:g} kg are picked up in motion'
    )


def _of_errors(config: ControllerConfig, settings: Settings) -> Iterator[str]:
    """Check that the errors to expect are within the bound."""
    bound, T, robot = settings.bound, config.sample_time, config.robot
    errors = expected_errors(config, settings)
    worst = int(np.argmax(errors.unmodelled / bound))
    if errors.unmodelled[worst] > bound[worst]:
        yield (
            'barrier.bound: friction and unmodelled torque (learning.residual_floor) alone push '
            f'{config.joints[worst]} about {errors.unmodelled[worst]:.2g} rad from its reference: '
            f'give more than {bound[worst]:g} rad'
        )
    worst = int(np.argmax(errors.pick_up / bound))
    peak = errors.pick_up[worst]
    if peak > bound[worst]:
        share = bound[worst] / peak
        faster = loop_delay(T, robot.lag) * math.sqrt(share) - robot.lag
        remedy = f'a lower robot.lag than {robot.lag:g} s'
        if faster > 0.0:
            remedy = f'a sample time of {faster / SAMPLES:.2g} s'
        yield (
            f'barrier.bound: when {robot.payload:g} kg (robot.payload) are picked up in motion, '
            f'{config.joints[worst]} is expected to be {peak:.2g} rad from its reference, past its '
            f'bound of {bound[worst]:g} rad: a bound of {1.1 * peak:.2g} rad would hold, or '
            f'{share * robot.payload:.2g} kg, or {remedy}'
        )


def _of_gains(config: ControllerConfig, load: ReferenceLoad) -> list[Finding]:
    with np.errstate(over='ignore'):  # a limit of next to nothing is exceeded infinitely
        return [each for each in _limits_of_gains(config, load) if each.use > 1.0]


def _limits_of_gains(config: ControllerConfig, load: ReferenceLoad) -> Iterator[Finding]:
    settings, T = settings_of_config(config), config.sample_time
    damping = np.maximum(load.damping(settings), 1e-12)
    for joint, need, limit in zip(config.joints, load.torque, config.torque.limit, strict=True):
        yield Finding(
            f'torque.limit: {joint}',
            _MARGIN * need / limit,
            f'has {limit:g} N m, but with learning.initial_estimate the reference alone needs '
            f'{need:.3g} N m: give that and a quarter more',
        )
    rate = load.rate(settings)
    yield Finding(
        'feedback.gain: K_p over the inertia',
        rate * T,
        f'is {rate:.3g} 1/s with learning.initial_estimate, {rate * T:.2g} times the inverse of '
        'sample_time: above 1 the loop has little margin for delays, and above 2 it chatters '
        'between the limits: lower either',
    )
    absorbed = float(np.max(settings.gamma * T / damping))
    yield Finding(
        'disturbance.gain: in each sample the disturbance estimate absorbs',
        2.0 * absorbed,
        f'{absorbed:.2g} of the velocity feedback, and above a half it oscillates against '
        'feedback.gain: lower it',
    )
    if settings.surface == LINEAR:
        return
    filtering = config.surface.time_constant
    yield Finding(
        'surface.time_constant:',
        T / filtering,
        f'{filtering:g} s is less than the sample time, {T:g} s: alpha2 follows the measurement '
        'noise, and its derivative enters the torque: give more',
    )
    rate = float(np.max(settings.K / 2.0 + settings.mu))
    yield Finding(
        'surface.gain, surface.mu: K/2 + mu',
        filtering * rate,
        f'is {rate:.3g} 1/s, but a filter of {filtering:g} s rings above '
        f'{0.25 / filtering:.3g} 1/s: lower surface.time_constant or the gains',
    )
    for joint, ratio in zip(config.joints, settings.slope_limit * T / damping, strict=True):
        yield Finding(
            f'barrier.slope_limit: past the knee of its barrier {joint} is corrected by',
            ratio / 2.0,
            f'{ratio:.2g} times its error in a sample, and above 2 the error grows: give less than '
            '2 feedback.gain / sample_time',
        )


def _of_learning(
    config: ControllerConfig, settings: Settings, load: ReferenceLoad
) -> Iterator[str]:
    learning = config.learning
    rate, what = float(settings.Gamma.max()), 'kappa Gamma T'
    if settings.update != NEWTON:
        scale = np.sqrt(settings.Gamma[: settings.p])
        rate = float(np.linalg.eigvalsh(load.excitation * np.outer(scale, scale))[-1])
        what = 'kappa lambda_max(Gamma Phi) T'
    step = settings.kappa * rate * config.sample_time
    if step > 1.0:
        yield (
            f'learning.weight: {what} is {step:.2g}; above 1 the estimate overshoots, above 2 it '
            'diverges: lower it, or learning.adaptation_gain'
        )
    if config.reference.type == 'sinusoids':
        for frequency in config.reference.frequency:
            periods = learning.window * frequency / (2.0 * np.pi)
            if frequency > 0.0 and abs(periods - round(periods)) > _PERIODS:
                yield (
                    f'learning.window: {learning.window:g} s are {periods:.3g} periods of the '
                    f"reference's {frequency:g} rad/s: give whole ones, over which a disturbance "
                    'of that period averages out'
                )


def apply(controller: Controller, config: ControllerConfig) -> None:
    """Replace the settings of a law."""
    controller.settings_vector[:] = pack(settings_of_config(config))


def apply_bumpless(
    controller: Controller, config: ControllerConfig, t: float, measurement: Floats
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
