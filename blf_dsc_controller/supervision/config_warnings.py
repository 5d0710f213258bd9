# SPDX-License-Identifier: Apache-2.0
"""Warnings before the start: gains, limits and windows that are valid but cannot work well.

They are based on the initial parameter estimate, which is a guess. doc/tuning.md derives them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.inertia import pseudo_inertia
from blf_dsc_controller.arms.tuning import SAMPLES, UNKNOWN_EFFORT, loop_delay
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.robot import implausible_friction
from blf_dsc_controller.law.factory import settings_of_config
from blf_dsc_controller.law.settings import FILTERED, LINEAR, NEWTON, Settings
from blf_dsc_controller.supervision.linear_loop import (
    ReferenceLoad,
    expected_errors,
    reference_load,
)

Floats = NDArray[np.float64]

_MARGIN = 1.25  # recommended torque limit over what the reference needs
_PERIODS = 0.02  # periods by which a window may differ from a whole number
_FUNNEL = 20.0  # times the bound; up to 5 with the presets
_SLUGGISH = 1.0  # rad/s^2; the weakest joint of the presets has 60
_IMPOSSIBLE = 1e-3  # of the pseudo-inertia's largest eigenvalue: more than rounding errors
_SETTLED = 10.0  # time constants of the filter (8) ...
_FILTERED = 4.0  # ... and of the regressor's filter, applied to both sides of the identity


class Finding(NamedTuple):
    """Gains that cannot work well: what they affect, a ratio (bad above 1), and a sentence."""

    of: str
    excess: float
    text: str


def config_warnings(config: ControllerConfig, load: ReferenceLoad | None = None) -> list[str]:
    """Return the warnings, one sentence each, beginning with the parameter to change first.

    `load` is that of the reference, if known.
    """
    settings = settings_of_config(config)
    load = load or reference_load(config, settings)
    found = [*_of_urdf(config, load)] if config.model == 'urdf' else []
    found += [finding.text for finding in _of_gains(config, load)]
    if config.model == 'urdf' and config.law == 'blf_dsc':
        found += _of_errors(config, settings)
    if settings.surface != LINEAR and settings.kappa > 0.0 and settings.Gamma.any():
        found += _of_learning(config, settings, load)
    return found


def worsened(before: ControllerConfig, after: ControllerConfig, load: ReferenceLoad) -> list[str]:
    """Return the warnings on gains that are new or worse after a change."""
    known = {finding.of: finding.excess for finding in _of_gains(before, load)}
    return [
        finding.text
        for finding in _of_gains(after, load)
        if finding.excess > known.get(finding.of, 1.0)
    ]


def _of_urdf(config: ControllerConfig, load: ReferenceLoad) -> Iterator[str]:
    """Check for figures that nobody can have measured, and for defaults that are hardly meant."""
    robot, barrier = config.robot, config.barrier
    chain = robot.chain(config.joints)
    if chain.pointlike:
        yield (
            f'robot.urdf: {", ".join(chain.pointlike)}: a mass without moments of inertia (all '
            'zero): the gains of these joints rest on the drives alone; give rough ones'
        )
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
    for i, joint in enumerate(chain.joints):
        limit = config.torque.limit[i]
        moments = np.linalg.eigvalsh(pseudo_inertia(joint.inertia))
        if moments[0] < -_IMPOSSIBLE * moments[-1]:
            yield (
                f'robot.urdf: the inertia of what {joint.name} moves ({joint.link}) is impossible, '
                'one moment above the sum of the others: is it in kg m^2, about the centre of mass?'
            )
        if math.isinf(joint.effort) and limit == UNKNOWN_EFFORT:
            yield (
                f'torque.limit: {joint.name} has no effort in the URDF: {limit:g} N m is assumed; '
                'set what its drive can withstand'
            )
        acceleration = limit / load.free_inertia[i]
        if acceleration < _SLUGGISH:
            yield (
                f'robot.urdf: at its torque limit {joint.name} accelerates at only '
                f'{acceleration:.2g} rad/s^2: are masses in kg, inertias in kg m^2, lengths in m?'
            )
        widest, bound = barrier.widest[i], barrier.bound[i]
        if widest > _FUNNEL * bound:
            yield (
                f'barrier.initial_bound: {joint.name} begins with a bound of {widest:.3g} rad, '
                f'which narrows to {bound:g}: with gains for robot.lag of {robot.lag:g} s it would '
                f'sag that far under an undeclared load of {robot.payload:g} kg (robot.payload)'
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
    """Check that the errors to expect are within the bound, also with lighter drives.

    The lightest drives are those with which friction alone stays within the bound: the gains follow
    the inertia that the law measures (`apparent_inertia`), so errors grow with its inverse.
    """
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
    drives = settings.joint_inertia - settings.link_inertia
    least = settings.joint_inertia * errors.unmodelled / bound - settings.link_inertia
    lightest = np.zeros_like(drives)  # of the inertia assumed; where it is given, nothing is
    np.divide(least, drives, out=lightest, where=settings.unsure_rotor > 0.0)
    worst = int(lightest.argmax())
    if lightest[worst] > 0.0:
        yield (
            f'robot.rotor_inertia: the bound may be passed if the drive of {config.joints[worst]} '
            f'has less than {lightest[worst]:.2g} of the inertia assumed: then give it'
        )


def _of_gains(config: ControllerConfig, load: ReferenceLoad) -> list[Finding]:
    with np.errstate(over='ignore'):  # a limit of next to nothing is exceeded infinitely
        return [each for each in _ratios(config, load) if each.excess > 1.0]


def _ratios(config: ControllerConfig, load: ReferenceLoad) -> Iterator[Finding]:
    """Yield what limits the gains, and by how much they use it."""
    settings, T = settings_of_config(config), config.sample_time
    damping = np.maximum(load.damping(settings), 1e-12)
    for joint, need, limit in zip(config.joints, load.torque, config.torque.limit, strict=True):
        yield Finding(
            f'torque of {joint}',
            _MARGIN * need / limit,
            f'torque.limit: {joint} has {limit:g} N m, but with learning.initial_estimate the '
            f'reference alone needs {need:.3g} N m: give that and a quarter more',
        )
    rate = load.rate(settings)
    yield Finding(
        'feedback',
        rate * T,
        f'feedback.gain: K_p over the inertia is {rate:.3g} 1/s with learning.initial_estimate, '
        f'{rate * T:.2g} times the inverse of sample_time: above 1 the loop has little margin for '
        'delays, and above 2 it chatters between the limits: lower either',
    )
    fraction = float(np.max(settings.gamma * T / damping))
    yield Finding(
        'disturbance',
        2.0 * fraction,
        f'disturbance.gain: in each sample the disturbance estimate absorbs {fraction:.2g} of '
        'the velocity feedback, and above a half it oscillates against feedback.gain: lower it',
    )
    yield Finding(
        'leakage',
        settings.eta * float(settings.gamma.max()) * T,
        'disturbance.leakage: eta gamma T > 1 makes the disturbance estimate oscillate: lower it',
    )
    if settings.surface == LINEAR:
        return
    filtering = config.surface.time_constant
    yield Finding(
        'filter',
        T / filtering,
        f'surface.time_constant: {filtering:g} s is less than the sample time, {T:g} s: alpha2 '
        'follows the measurement noise, and its derivative enters the torque: give more',
    )
    rate = float(np.max(settings.K / 2.0 + settings.mu))
    yield Finding(
        'surface',
        filtering * rate,
        f'surface.gain, surface.mu: K/2 + mu is {rate:.3g} 1/s, but a filter of {filtering:g} s '
        f'rings above {0.25 / filtering:.3g} 1/s: lower surface.time_constant or the gains',
    )
    for joint, ratio in zip(config.joints, settings.slope_limit * T / damping, strict=True):
        yield Finding(
            f'barrier of {joint}',
            ratio / 2.0,
            f'barrier.slope_limit: past the knee of its barrier {joint} is corrected by '
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
            'diverges: lower it, or learning.adaptation_gain and learning.column_gain'
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
    filtered = settings.prediction == FILTERED
    pole = learning.filter_pole if filtered else learning.derivative_filter
    if learning.settling_time * pole < (_FILTERED if filtered else _SETTLED):
        yield (
            f'learning.settling_time: {learning.settling_time:g} s is too short for the filters '
            f'({pole:g} rad/s), whose transient is still in the first windows: give more'
        )
