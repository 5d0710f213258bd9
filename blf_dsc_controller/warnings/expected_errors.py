# SPDX-License-Identifier: Apache-2.0
"""The errors to expect: those of the sampled loop at small errors.

About a motion that the law follows, learning aside, the law is linear in the errors,
and so is the arm with its inertia M of that posture (`arms.linear_loop`).  Torques
arrive a sample late and pass the drives, velocities are differences of positions behind
a filter; each of both lags is half of `robot.lag`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.linear_loop import Feedback, Joints, Loop, Timing
from blf_dsc_controller.arms.model import inertia_matrices, regressors_at
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.robot import parameters_of
from blf_dsc_controller.configuration.tool_bound import at_reversal
from blf_dsc_controller.factory.settings import settings_of_config
from blf_dsc_controller.law.state import Settings
from blf_dsc_controller.numerics.digits import largest_error
from blf_dsc_controller.warnings.reference_load import along

Floats = NDArray[np.float64]

_RESPONSE = 20.0  # time constants of the damping, for which the response is followed
_PEAK = 6.0  # of the surface, likewise; the peak comes before the integral acts
_MOMENTS = 40  # of the reference
_LOOKED_AT = 8  # of them, every so many, for a loop that is stable


def linear_feedback(settings: Settings, M0: Floats, stiffness: Floats) -> Feedback:
    """Return the law at small errors, with its inertia M0 (k, n, n) [kg m^2] of k postures.

    `stiffness` (n,) [N m/rad] is the slope of the barrier.
    """
    one = np.broadcast_to(np.eye(settings.n), M0.shape)
    acting = (
        M0 / settings.joint_inertia if settings.feedback.follows_inertia == 1 else one
    )
    return Feedback(
        position=acting * stiffness,
        surface=one * settings.feedback.gain + M0 * settings.feedback.damping_rate,
        inertia=0.0 * M0 if settings.feedback.decoupled == 1 else M0,
        integral=acting * settings.disturbance.gain,
        rate=settings.surface.gain / 2.0 + settings.surface.mu,
        time_constant=settings.surface.time_constant,
        known_rate=settings.surface.known_rate == 1,
        damping_lag=settings.feedback.damping_lag,
    )


def timing_of(config: ControllerConfig) -> Timing:
    """Return how late torques and velocities are: half of `robot.lag` each."""
    half = 0.5 * config.robot.lag
    return Timing(config.sample_time, drive_lag=half, velocity_lag=half)


def guesses_rotors(config: ControllerConfig) -> bool:
    """Whether the drives may be heavier than the inertia that is guessed for them."""
    unknown = config.robot.unknown_rotors(config.robot.chain(config.joints))
    return not config.commissioning.unseen_inertia and bool(unknown.any())


def _peak_errors(loop: Loop, settings: Settings, torque: Floats) -> Floats:
    """Return the largest errors (k, n) [rad] after a torque step d (k, n) [N m]."""
    T = loop.timing.period
    A, B = loop.transition()
    push = (B @ torque[..., None])[..., 0]
    x = np.zeros_like(push)
    largest = np.zeros_like(torque)
    duration = _PEAK / max(float(loop.feedback.rate.min()), 1.0)
    if settings.feedback.damping_rate > 0.0:
        duration = _RESPONSE / max(settings.feedback.damping_rate, 1.0)
    for _ in range(round(duration / T)):
        x = (A @ x[..., None])[..., 0] + push
        largest = np.maximum(largest, np.abs(x[:, : settings.n]))
    return largest


def _stable_loop(
    config: ControllerConfig, settings: Settings, M0: Floats
) -> Loop | None:
    """Return the loop of an arm with rigid gears in k postures; None if it is unstable.

    The law's inertia is M0 (k, n, n) [kg m^2].  Drives are as heavy as guessed, or else as they
    may be at most.
    """
    feedback = linear_feedback(settings, M0, settings.barrier.weight)
    nothing = np.zeros(settings.n)
    unknown = config.robot.unknown_rotors(config.robot.chain(config.joints))
    for drives in (nothing, unknown) if guesses_rotors(config) else (nothing,):
        joints = Joints(motors=drives, viscous=nothing)
        loop = Loop(M0, joints, timing_of(config), feedback)
        if loop.at(slice(None, None, _LOOKED_AT)).is_stable():
            return loop
    return None


class ExpectedErrors(NamedTuple):
    """Largest errors (n,) [rad] along the reference, before anything is learned."""

    unmodelled: Floats  # of learning.residual_floor and friction at a reversal
    pick_up: Floats  # when robot.payload is picked up in motion

    @property
    def is_endless(self) -> bool:
        """Whether they grow from sample to sample."""
        return bool(np.isinf(self.pick_up).any())


def expected_errors(config: ControllerConfig, settings: Settings) -> ExpectedErrors:
    """Return the expected errors of an arm from a URDF, infinite if its loop is unstable."""
    model, robot = settings.model, config.robot
    chain = robot.chain(config.joints)
    if config.reference.type == 'hold':  # at rest anywhere
        limits = config.limits.position_lower, config.limits.position_upper
        q = np.random.default_rng(0).uniform(*limits, (_MOMENTS, len(config.joints)))
        dq = ddq = np.zeros_like(q)
    else:
        q, dq, ddq = along(config, _MOMENTS)
    P0 = settings.initial_estimate[: settings.p]
    load = robot.payload * parameters_of(robot, chain).load
    M0, M = (inertia_matrices(model, P, q) for P in (P0, P0 + load))
    loop = _stable_loop(config, settings, M0)
    if loop is None:
        endless = np.full(settings.n, np.inf)
        return ExpectedErrors(endless, endless)
    unmodelled = _peak_errors(loop, settings, _unmodelled(config, ddq))
    loaded = loop._replace(links=M)
    pick_up = _peak_errors(
        loaded, settings, regressors_at(model, q, dq, dq, ddq) @ load
    )
    return ExpectedErrors(unmodelled.max(axis=0), pick_up.max(axis=0))


def _unmodelled(config: ControllerConfig, ddq: Floats) -> Floats:
    """Return the torque (k, n) [N m] that the model may lack at accelerations (k, n).

    With what commissioning has measured of friction, and not seen of inertia.  The law
    compensates the friction that it knows; the rest has either sign at a reversal.  Where
    none is known or measured, some is expected, and drives heavier than guessed.
    """
    robot, measured = config.robot, config.commissioning
    chain = robot.chain(config.joints)
    known = np.array(robot.friction(chain)['coulomb'])
    friction = measured.friction or tuple(robot.unknown_friction(chain))
    floor = np.array(config.learning.residual_floor) + at_reversal(known, friction)
    unseen = measured.unseen_inertia or tuple(robot.unknown_rotors(chain))
    return np.asarray(floor + np.abs(ddq) * np.array(unseen))


def _causes(config: ControllerConfig) -> str:
    if guesses_rotors(config):
        return 'friction, unmodelled torque and drives heavier than guessed'
    return 'friction and unmodelled torque'


def expectation(config: ControllerConfig) -> str:
    """Return the largest errors to expect of an arm of a URDF, in a sentence."""
    errors = expected_errors(config, settings_of_config(config))
    if errors.is_endless:
        return 'none can be told, since errors grow from sample to sample: give lower gains'
    usual = largest_error(errors.unmodelled, config.units)
    most = largest_error(errors.pick_up, config.units, config.joints)
    return (
        f'{usual} by {_causes(config)}; {most} when '
        f'{config.robot.payload:g} kg are picked up in motion'
        + (
            ', less what joint torque sensors show in time'
            if config.observes_load
            else ''
        )
    )
