# SPDX-License-Identifier: Apache-2.0
"""Commissioning of an arm from a URDF: what follows from the runs of its motions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import datetime
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.joint_gains import (
    JointGains,
    damped_arm,
    max_integral_fraction,
)
from blf_dsc_controller.arms.known_gears import MARGIN
from blf_dsc_controller.arms.model import inertia_matrices
from blf_dsc_controller.arms.tuning import Design
from blf_dsc_controller.commissioning.better_known import as_measured, known_friction
from blf_dsc_controller.commissioning.choice import LAGS, Choice, choose
from blf_dsc_controller.commissioning.chosen import (
    as_parameters,
    capped_stop_damping,
    widened_bounds,
    with_gains,
)
from blf_dsc_controller.commissioning.findings import Findings, findings_of
from blf_dsc_controller.commissioning.margin import BARELY, Loops, RigidArm
from blf_dsc_controller.commissioning.measurement import Measured, check_joints, named
from blf_dsc_controller.commissioning.motion import lines_in
from blf_dsc_controller.commissioning.observer_pole import ObserverPole, SensedLoops
from blf_dsc_controller.commissioning.planned import measuring_gains
from blf_dsc_controller.commissioning.response import Response, response_of
from blf_dsc_controller.configuration.controller import ControllerConfig, design_of
from blf_dsc_controller.configuration.schema import Value
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.numerics.digits import two_digits

Floats = NDArray[np.float64]

CREEPING = 1.5
"""Times the measured friction, to expect of a joint that hardly slid while it was measured.

A joint that friction damps more than its gains do follows less than half of its swings, and shows
only a part of its friction.  The factor is the one that is taken for breakaway.
"""


class Commissioned(NamedTuple):
    """What was measured of an arm, and the gains that follow."""

    joints: tuple[str, ...]
    responses: tuple[Response, ...]
    loops: Loops  # of these responses
    start: JointGains  # of the measurement
    choice: Choice
    findings: Findings
    assumed: Floats  # (n,) kg m^2, inertias by URDF and guess, where findings has them
    rotors: Floats  # (n,) kg m^2, robot.rotor_inertia: measured, unless drives hide it
    friction: Floats  # (n,) N m, to expect: of joints that creep more than measured
    unseen: Floats  # (n,) kg m^2, that friction may hide beyond the model's
    lag: float  # s, robot.lag: measured, or that of the file where it is not seen
    date: str  # when the gains were chosen
    aim: float  # the modulus margin that was asked for
    before: ControllerConfig  # for which the arm was measured
    coulomb: Floats | None  # (n,) N m, robot.coulomb, if the last runs compensated it
    # None: there are no joint torque sensors, or they are not used
    sensed: SensedLoops | None
    observer: ObserverPole | None  # likewise

    @property
    def has_margin(self) -> bool:
        """Whether the chosen gains have the modulus margin."""
        return self.choice.margin.value >= self.aim

    @property
    def has_lags(self) -> bool:
        """Whether the damping of a joint is to lag."""
        return bool(np.any(self.choice.gains.damping_lag))

    @property
    def why_no_margin(self) -> str:
        """Why no gains may have the margin, and what to do."""
        own = self.loops.margin(self.start, noise=False)
        if own.value >= BARELY:
            return (
                'noise or friction hide the response. Measure again with a larger --torque or '
                '--travel'
            )
        return (
            'noise or friction hide the response, or the arm nearly oscillates with the gains of '
            f'its file, near {two_digits(own.frequency)} Hz (their modulus margin is '
            f'{own.value:.2g}). Measure again with a smaller feedback.stiffness, or with a larger '
            '--torque or --travel'
        )

    def parameters(self) -> dict[str, Value]:
        """Return the parameters that follow, by dotted name.

        Raises BlfDscError if no gains have the margin.
        """
        if not self.has_margin:
            raise BlfDscError(
                f'no gains have the modulus margin of {self.aim:g}: {self.why_no_margin}'
            )
        values = self.parameters_but_bounds()
        return values | widened_bounds(with_gains(self.before, values))

    @property
    def config(self) -> ControllerConfig:
        """The configuration with the parameters, and all that follows from them.

        Raises BlfDscError if no gains have the margin.
        """
        return with_gains(self.before, self.parameters())

    def parameters_but_bounds(self) -> dict[str, Value]:
        """Return the parameters that follow, without bounds, also of gains without the margin."""
        gains = self.choice.gains
        damping = _rounded(gains.damping)
        of_arm: dict[str, Value] = {}
        if not self.before.robot.torque_loop:
            of_arm = capped_stop_damping(self.before, np.array(damping))
            of_arm['robot.rotor_inertia'] = _rounded(self.rotors)
        if self.coulomb is not None:
            of_arm['robot.coulomb'] = _rounded(self.coulomb)
        if self.has_lags or any(self.before.feedback.joint_damping_lag):
            of_arm['feedback.joint_damping_lag'] = _rounded(
                np.asarray(gains.damping_lag)
            )
        if self.observer is not None:
            of_arm['disturbance.observer_bandwidth'] = self.observer.pole
        return {
            **of_arm,
            'robot.lag': float(f'{self.lag:.3g}'),
            'feedback.inertia': 'none',
            **as_parameters(_rounded(gains.stiffness), damping),
            'commissioning.friction': _rounded(self.friction),
            'commissioning.unseen_inertia': _rounded(self.unseen),
        }


def commissioned(
    config: ControllerConfig,
    runs: Sequence[Measured],
    margin: float = MARGIN,
    lags: Sequence[float] = LAGS,
    names: Sequence[str] = (),
) -> Commissioned:
    """Return what runs of `plan` show, each with the configuration that it had.

    `margin` is the modulus margin that the gains are chosen for, `lags` [s] are those of the
    damping that are tried, `names` those of the runs in errors.

    Raises BlfDscError if a run is not one of its motions, or has a stop.
    """
    names = names or [''] * len(runs)
    _check_runs(config, runs, names)
    T = config.sample_time
    measured_with = as_measured(config, [made for _, made in runs])
    arm, _ = design_of(measured_with)
    responses = tuple(map(partial(_response_of, T), runs, names))
    found = findings_of([run for run, _ in runs], responses)
    assumed = _assumed_inertia(arm, responses)
    inertia = _largest_inertia(arm, found, assumed)
    loops = Loops(responses, inertia, T)
    start = measuring_gains(measured_with)
    rigid = RigidArm(_least(found.inertias, assumed), found.timing(T, arm.lag))
    by_factors = _gains_by_factors(config, start, inertia)
    choice = choose(loops, start, by_factors, rigid, margin, lags)
    lag = _lag(measured_with, found)
    sensed = _sensed_loops(config, arm, loops, lag)
    return Commissioned(
        joints=config.joints,
        responses=responses,
        loops=loops,
        start=start,
        choice=choice,
        findings=found,
        assumed=assumed.max(axis=0),
        rotors=_rotors(config, arm, found, assumed),
        friction=_expected_friction(found, start),
        unseen=_unseen(found, assumed),
        lag=lag,
        date=datetime.now().astimezone().strftime('%Y-%m-%d %H:%M'),
        aim=margin,
        before=config,
        coulomb=(
            None
            if measured_with is config
            else np.maximum(known_friction(measured_with), found.friction)
        ),
        sensed=sensed,
        observer=None if sensed is None else sensed.fastest_pole(choice.gains),
    )


def _response_of(sample_time: float, measured: Measured, name: str) -> Response:
    """Return the response that a run of this name shows."""
    with named(name):
        return response_of(measured[0], lines_in(measured[1]), sample_time)


def _check_runs(
    config: ControllerConfig, runs: Sequence[Measured], names: Sequence[str]
) -> None:
    """Raise BlfDscError if there is none, or if one is of other joints."""
    if not runs:
        raise BlfDscError(
            'there is no run of a motion in a posture: give the bags of these, too'
        )
    for (run, _), name in zip(runs, names, strict=True):
        check_joints(name or 'the run', run.joints, config)


def _assumed_inertia(arm: Design, responses: Sequence[Response]) -> Floats:
    """Return the inertias (k, n) [kg m^2] of the model in the postures of k runs."""
    postures = np.array([each.posture for each in responses])
    P = arm.parameters.of(arm.chain.inertias, arm.rotors)
    M = inertia_matrices(arm.parameters.model, P, postures)
    return np.diagonal(M, axis1=1, axis2=2)


def _largest_inertia(arm: Design, found: Findings, assumed: Floats) -> Floats:
    """Return the largest inertia (n,) [kg m^2] of each joint over all postures.

    In the postures of the runs it is the measured one, or that `assumed` (k, n) where none was
    seen.  The model says how much larger it is in other postures.
    """
    here = assumed.max(axis=0)
    elsewhere = arm.over_postures().inertia - here
    known = np.where(np.isnan(found.inertia), here, found.inertia)
    return np.asarray(known + np.maximum(elsewhere, 0.0))


def _rotors(
    config: ControllerConfig, arm: Design, found: Findings, assumed: Floats
) -> Floats:
    """Return the inertias of the rotors (n,) [kg m^2], by what the `assumed` (k, n) lack.

    The run that lacks least counts, since a load is no rotor.  Drives with torque loops hide
    their rotors: those of the configuration are returned.
    """
    if config.robot.torque_loop:
        return arm.rotors
    missing = _least(found.inertias - assumed, 0.0 * assumed)
    return np.asarray((arm.rotors + missing).clip(0.0))


def _gains_by_factors(
    config: ControllerConfig, start: JointGains, inertia: Floats
) -> Callable[[Floats], JointGains]:
    """Return the gains as a function of factors (n,) on the damping of the measurement.

    Where the configuration gives a stiffness, it grows with the damping; else it follows
    from the damping and the inertia (n,) [kg m^2].
    """
    follows_damping = not config.feedback.joint_stiffness
    integral_fraction = max_integral_fraction(has_torque_loop=config.robot.torque_loop)

    def gains(factors: Floats) -> JointGains:
        scaled = start.scaled(factors)
        found = damped_arm(scaled.damping, inertia) if follows_damping else scaled
        return found._replace(integral_fraction=integral_fraction)

    return gains


def _expected_friction(found: Findings, start: JointGains) -> Floats:
    """Return the friction (n,) [N m] to expect, more than measured where joints crept."""
    is_creeping = found.damping > start.damping
    return np.asarray(found.friction * np.where(is_creeping, CREEPING, 1.0))


def _lag(config: ControllerConfig, found: Findings) -> float:
    """Return `robot.lag` [s]: measured, or that of the configuration."""
    lag = found.lag(config.sample_time)
    return config.robot.lag if np.isnan(lag) else lag


def _sensed_loops(
    config: ControllerConfig, arm: Design, loops: Loops, lag: float
) -> SensedLoops | None:
    """Return the loops with joint torque sensors, if there are any and all runs have efforts.

    `lag` [s] is that of velocities and torques together.
    """
    sensed = tuple(each.sensed for each in loops.responses if each.sensed is not None)
    if not config.has_torque_sensors or len(sensed) < len(loops.responses):
        return None
    postures = np.array([each.posture for each in loops.responses])
    P_l = arm.parameters.of(arm.chain.inertias, np.zeros_like(arm.rotors))
    links = inertia_matrices(arm.parameters.model, P_l, postures)
    return SensedLoops(loops, sensed, links, sensor_lag=0.5 * lag)


def _least(measured: Floats, assumed: Floats) -> Floats:
    """Return the least (n,) of what was measured in k runs (k, n); of `assumed` where none was."""
    least = np.where(np.isnan(measured), np.inf, measured).min(axis=0)
    return np.asarray(np.where(np.isinf(least), assumed.min(axis=0), least))


def _unseen(found: Findings, assumed: Floats) -> Floats:
    """Return the inertia (n,) that may be missing, of joints that no run shows.

    The model has `assumed` (k, n) [kg m^2] in k runs.
    """
    beyond = (found.hidden - assumed).clip(0.0).min(axis=0)
    return np.asarray(np.where(np.isnan(found.inertia), beyond, 0.0))


def _rounded(values: Floats) -> tuple[float, ...]:
    return tuple(float(f'{value:.3g}') for value in values)
