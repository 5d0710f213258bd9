# SPDX-License-Identifier: Apache-2.0
"""Warnings about a configuration that is valid but cannot work well.

They concern gains, limits and windows, and are based on the initial parameter estimate,
which is a guess. doc/tuning.md derives them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.tuning import SAMPLES, UNKNOWN_EFFORT, loop_delay
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.law_traits import OWN
from blf_dsc_controller.configuration.robot import (
    UNKNOWN_FRICTION,
    implausible_friction,
)
from blf_dsc_controller.configuration.tool_bound import ANGLE, POSITION
from blf_dsc_controller.factory.settings import settings_of_config
from blf_dsc_controller.law.adaptation import NEWTON
from blf_dsc_controller.law.state import Settings
from blf_dsc_controller.supervision.expected_errors import (
    ExpectedErrors,
    expected_errors,
)
from blf_dsc_controller.supervision.gear_warnings import gear_warnings, softer_by
from blf_dsc_controller.supervision.reference_load import ReferenceLoad, reference_load
from blf_dsc_controller.supervision.retuning import settings_in_loop

Floats = NDArray[np.float64]

_MARGIN = 1.25  # recommended torque limit over what the reference needs
_FIRST_ERROR = 1.5  # recommended bound over the first error
_PERIODS = 0.02  # periods by which a window may differ from a whole number
_LONGEST_LAG = 0.1  # s; drivers have up to 0.03
_WIDEST_BOUND = 0.35  # rad, 20 degrees
_LONG = 5.0  # s: a time in ms is a thousand times as long as it should be
_TIMES = (
    'state_timeout',
    'saturation_time',
    'stop_ramp',
    'deactivation_ramp',
    'fade_time',
)
# exponent of an error in the stiffness it needs: 0.5 without delays
_STIFFENING = 0.6
_ROOM = 1.1  # recommended bound over the errors to expect
_SLUGGISH = 1.0  # rad/s^2; the weakest joint of the presets has 60


class Finding(NamedTuple):
    """A limit of the gains: what it is on, how much is used, what follows above 1."""

    subject: str
    use: float
    text: str  # goes on after the subject


def _of_units(config: ControllerConfig) -> Iterator[str]:
    """Check for values that are those of another unit."""
    lag = config.robot.lag
    if lag > _LONGEST_LAG:
        yield (
            f'robot.lag: {lag:g} s between a state and its torque is too long for any loop: is it '
            f'in ms? Give {1e-3 * lag:g}'
        )
    limits = config.limits
    widths = np.subtract(limits.position_upper, limits.position_lower)
    crossed = max(_LONG, float(np.max(widths / limits.velocity)))
    for name in _TIMES:
        seconds = getattr(config.safety, name)
        if seconds > crossed:
            yield (
                f'safety.{name}: in {seconds:g} s the arm can cross its range (limits): is it in '
                f'ms? Give {1e-3 * seconds:g}'
            )


def _of_width(config: ControllerConfig, errors: ExpectedErrors | None) -> Iterator[str]:
    """Check for bounds that bound nothing: of another unit, or because of soft gains.

    `errors` are those to expect, if known.
    """
    barrier = config.barrier
    widest = max(barrier.widest)
    if widest <= _WIDEST_BOUND:
        return
    of_joint = widest in barrier.bound
    name = 'barrier.bound' if of_joint else 'barrier.initial_bound'
    remedy = f'is it in degrees? Give {math.radians(widest):.3g}'
    if barrier.bounds_tool:
        name = POSITION if barrier.tool_bound > 0.0 else ANGLE
        remedy = 'the bound of a joint follows from this one: give less'
    elif of_joint and errors is not None and not errors.is_endless:
        is_widest = np.array(barrier.bound) == widest
        needed = np.where(is_widest, errors.unmodelled + errors.pick_up, 0.0)
        j = int(needed.argmax())
        if _ROOM * needed[j] > _WIDEST_BOUND:
            remedy = (
                f'{config.joints[j]} is expected to be up to {needed[j]:.2g} rad from its '
                'reference with these gains. Give less robot.payload, if the arm carries less, or '
                'stiffer gains, if it bears them; then narrow the bound'
            )
    yield (
        f'{name}: {widest:g} rad is {math.degrees(widest):.3g} degrees and bounds nothing: {remedy}'
    )


def _of_stop(config: ControllerConfig) -> Iterator[str]:
    """Check that the joint bounds from which a bound at the tool follows are kept."""
    share = config.safety.error_ratio
    if config.barrier.bounds_tool and not 0.0 < share <= 1.0:
        stop = (
            f'only {share:g} times past a joint bound' if share else 'at no joint bound'
        )
        yield (
            f'safety.error_ratio: the arm stops {stop}; before that, the tool may leave its '
            'bound: give 1'
        )


def config_warnings(
    config: ControllerConfig, load: ReferenceLoad | None = None
) -> list[str]:
    """Return the warnings, each beginning with the parameter to change first.

    `load` is that of the reference, if known.
    """
    settings = settings_of_config(config)
    load = load or reference_load(config, settings)
    errors = None
    if config.model == 'urdf' and config.law in OWN:
        errors = expected_errors(config, settings)
    found = [*_of_units(config), *_of_width(config, errors), *_of_stop(config)]
    if config.model == 'urdf':
        found += _of_urdf(config, load)
    found += [f'{each.subject} {each.text}' for each in _of_gains(config, load)]
    if errors is not None:
        found += gear_warnings(config, settings)
        found += _of_errors(config, settings.barrier.bound, errors)
    if config.model != 'urdf' and config.law in OWN:
        found += _of_first_error(config, settings, load)
    if (
        settings.has_barrier == 1
        and settings.adaptation.weight > 0.0
        and settings.adaptation.adaptation_gain.any()
    ):
        found += _of_learning(config, settings, load)
    return found


def worsened(
    before: ControllerConfig, after: ControllerConfig, load: ReferenceLoad
) -> list[str]:
    """Return the warnings on gains that are new or worse after a change."""
    known = {each.subject: each.use for each in _of_gains(before, load)}
    return [
        f'{each.subject} {each.text}'
        for each in _of_gains(after, load)
        if each.use > known.get(each.subject, 1.0)
    ]


def _of_urdf(config: ControllerConfig, load: ReferenceLoad) -> Iterator[str]:
    """Check for implausible figures, and for defaults that are hardly meant."""
    yield from _of_placeholders(config)
    chain = config.robot.chain(config.joints)
    if chain.gripper and not config.robot.tip:
        yield (
            f'robot.tip: without it, {chain.gripper}, which slides at the end of a turning arm, '
            'is one of the joints of the arm. If it is a gripper, give the link that carries it: '
            f'{chain.joints[-2].link}'
        )
    for joint, limit, inertia in zip(
        chain.joints, config.torque.limit, load.free_inertia, strict=True
    ):
        if math.isinf(joint.effort) and limit == UNKNOWN_EFFORT:
            yield (
                f'torque.limit: {joint.name} has no effort in the URDF: {limit:g} N m is assumed; '
                'give the rated torque of its drive'
            )
        if limit / inertia < _SLUGGISH:
            yield (
                f'robot.urdf: {joint.name} accelerates at only {limit / inertia:.2g} rad/s^2 at '
                'its torque limit: are masses in kg, inertias in kg m^2, lengths in m?'
            )


def _of_placeholders(config: ControllerConfig) -> Iterator[str]:
    """Check for efforts and friction that look like placeholders."""
    robot = config.robot
    chain = robot.chain(config.joints)
    if (joints := robot.placeholder_efforts(chain)) and not robot.rotor_inertia:
        largest = max(joint.effort for joint in chain.joints)
        yield (
            f'torque.limit: an effort of up to {largest:g} N m for {", ".join(joints)} looks like '
            'a placeholder on an arm of this weight. The assumed inertia of the drives and '
            'learning.residual_floor follow from the weight instead: give the rated torques'
        )
    if (joints := implausible_friction(robot, chain)) and not (
        robot.viscous and robot.coulomb
    ):
        yield (
            'robot.coulomb: the friction in the description takes a quarter of the effort of '
            f'{", ".join(joints)} or more, which looks like a placeholder. Friction is not '
            'compensated until it is learned: give robot.viscous and robot.coulomb'
        )


def _of_errors(
    config: ControllerConfig, bound: Floats, errors: ExpectedErrors
) -> Iterator[str]:
    """Check that the errors to expect are within the bound (n,) [rad]."""
    if errors.is_endless:
        softer = softer_by(config)
        yield (
            f'{softer}: with a sample time of {config.sample_time:g} s and a robot.lag of '
            f'{config.robot.lag:g} s these gains make errors grow from sample to sample, on rigid '
            f'gears too: lower {softer}. Gains that the motors of an arm close themselves belong '
            'there: `blf_dsc drive` with drive.feedback: motor'
        )
        return
    yield from _of_unmodelled(config, bound, errors.unmodelled)
    yield from _of_pick_up(config, bound, errors.pick_up)


def _tool_parameter(config: ControllerConfig) -> str:
    """Return the parameter by which the error at the tool is bounded; empty if it is not."""
    if not config.barrier.bounds_tool:
        return ''
    return POSITION if config.barrier.tool_bound > 0.0 else ANGLE


def _of_unmodelled(
    config: ControllerConfig, bound: Floats, errors: Floats
) -> Iterator[str]:
    """Check the errors (n,) [rad] by friction and unmodelled torque."""
    worst = int(np.argmax(errors / bound))
    if not errors[worst] > bound[worst]:
        return
    parameter = 'barrier.bound'
    wide_enough = f'{_ROOM * errors[worst]:.2g} rad'
    remedy = f'give {wide_enough}, or stiffer gains, if the arm bears them'
    if of_tool := _tool_parameter(config):
        parameter = of_tool
        wider = float(errors[worst] / bound[worst])
        remedy = (
            f'past its joint bound of {bound[worst]:g} rad; give more than {wider:.2g} times '
            'this bound at the tool'
        )
    yield (
        f'{parameter}: friction{_assumed_friction(config)} and unmodelled torque '
        f'(learning.residual_floor) alone are expected to move {config.joints[worst]} '
        f'{errors[worst]:.2g} rad from its reference: {remedy}'
    )


def _assumed_friction(config: ControllerConfig) -> str:
    """Return how much friction is assumed, in brackets; empty if that of each joint is known."""
    robot = config.robot
    is_unknown = robot.unknown_friction(robot.chain(config.joints)).any()
    if config.commissioning.friction or not is_unknown:
        return ''
    share = f'{100.0 * UNKNOWN_FRICTION:g} %'
    return f' ({share} of the rated torque without robot.coulomb)'


def _of_pick_up(
    config: ControllerConfig, bound: Floats, errors: Floats
) -> Iterator[str]:
    """Check the errors (n,) [rad] when a load is picked up in motion."""
    worst = int(np.argmax(errors / bound))
    peak = errors[worst]
    if not peak > bound[worst]:
        return
    share = bound[worst] / peak
    parameter = 'barrier.bound'
    wide_enough = f'{_ROOM * peak:.2g} rad'
    if of_tool := _tool_parameter(config):
        parameter = of_tool
        wide_enough = f'{_ROOM / share:.2g} times this bound at the tool'
    payload = config.robot.payload
    yield (
        f'{parameter}: when {payload:g} kg (robot.payload) are picked '
        f'up in motion, {config.joints[worst]} is expected to be {peak:.2g} rad from its '
        f'reference, past its bound of {bound[worst]:g} rad: give {wide_enough}, or '
        f'{_remedy_of_pick_up(config, share)}, or pick up at most {share * payload:.2g} kg'
    )


def _remedy_of_pick_up(config: ControllerConfig, share: float) -> str:
    """Return the change that reduces the error of a pick-up to this share of it."""
    lag = config.robot.lag
    if config.feedback.inertia == 'none':
        return 'a larger feedback.stiffness, if the arm bears it'
    stiffer = config.feedback.stiffness / share**_STIFFENING
    if stiffer <= 1.0:
        return f'a feedback.stiffness of {math.ceil(100.0 * stiffer) / 100.0:g}'
    faster = loop_delay(config.sample_time, lag) * math.sqrt(share) - lag
    if faster > 0.0:
        return f'a sample time of {faster / SAMPLES:.2g} s'
    return f'a robot.lag below {lag:g} s'


def _of_first_error(
    config: ControllerConfig, settings: Settings, load: ReferenceLoad
) -> Iterator[str]:
    """Check that these gains keep the first error within the bound.

    The prior of such an arm is as wide as its parameters: at first the torque may err
    by all that the reference needs, which feedback and barrier make up for: K_p (K/2 +
    mu) xi1 + w xi1.
    """
    stiffness = (
        settings.feedback.gain * (settings.surface.gain / 2.0 + settings.surface.mu)
        + settings.barrier.weight
    )
    errors = load.torque / np.maximum(stiffness, 1e-12)
    widest = settings.barrier.initial_bound
    worst = int(np.argmax(errors / widest))
    if errors[worst] > widest[worst]:
        needed = _FIRST_ERROR * errors[worst]
        yield (
            f'barrier.bound: until the arm is learned, {config.joints[worst]} may be '
            f'{errors[worst]:.2g} rad from its reference with these gains, past its bound of '
            f'{widest[worst]:g} rad: give {needed:.2g} rad or more, or a barrier.initial_bound '
            'of that, or larger gains at a shorter sample_time'
        )


def _of_gains(config: ControllerConfig, load: ReferenceLoad) -> list[Finding]:
    # a limit of next to nothing is exceeded infinitely
    with np.errstate(over='ignore'):
        return [each for each in _limits_of_gains(config, load) if each.use > 1.0]


def _limits_of_gains(
    config: ControllerConfig, load: ReferenceLoad
) -> Iterator[Finding]:
    """Yield what the gains and torque limits use of their limits; above 1 is too much."""
    settings = settings_in_loop(config)
    yield from _limits_of_torque(config, load)
    yield from _limits_of_feedback(config, settings, load)
    if settings.has_barrier == 1:
        yield from _limits_of_surface(config, settings)
        yield from _limits_of_slope(config, settings, load)


def _limits_of_torque(
    config: ControllerConfig, load: ReferenceLoad
) -> Iterator[Finding]:
    for joint, need, limit in zip(
        config.joints, load.torque, config.torque.limit, strict=True
    ):
        yield Finding(
            f'torque.limit: {joint}',
            _MARGIN * need / limit,
            f'has {limit:g} N m, but with learning.initial_estimate the reference alone needs '
            f'{need:.3g} N m: let the reference be slower, or give at least '
            f'{_MARGIN * need:.3g} N m if the drive has that much',
        )


def _limits_of_feedback(
    config: ControllerConfig, settings: Settings, load: ReferenceLoad
) -> Iterator[Finding]:
    T = config.sample_time
    rate = load.rate(settings)
    yield Finding(
        'feedback.gain: K_p over the inertia',
        rate * T,
        f'is {rate:.3g} 1/s with learning.initial_estimate, {rate * T:.2g} times the inverse of '
        'sample_time. Above 1 the loop has little margin for delays, above 2 it chatters between '
        'the limits: lower feedback.gain or sample_time',
    )
    absorbed = float(np.max(settings.disturbance.gain * T / _damping(settings, load)))
    yield Finding(
        'disturbance.gain: in each sample the disturbance estimate absorbs',
        2.0 * absorbed,
        f'{absorbed:.2g} of the velocity feedback. Above a half it oscillates against '
        'feedback.gain: lower disturbance.gain',
    )


def _damping(settings: Settings, load: ReferenceLoad) -> Floats:
    """Return the damping (n,) [N m s/rad] of the feedback, above zero."""
    return np.asarray(np.maximum(load.damping(settings), 1e-12))


def _limits_of_surface(
    config: ControllerConfig, settings: Settings
) -> Iterator[Finding]:
    T, filtering = config.sample_time, config.surface.time_constant
    yield Finding(
        'surface.time_constant:',
        T / filtering,
        f'{filtering:g} s is less than the sample time, {T:g} s: alpha2 follows the measurement '
        'noise, and its derivative enters the torque: give more',
    )
    if settings.surface.known_rate == 0:
        rate = float(np.max(settings.surface.gain / 2.0 + settings.surface.mu))
        yield Finding(
            'surface.gain, surface.mu: K/2 + mu',
            filtering * rate,
            f'is {rate:.3g} 1/s, but a filter of {filtering:g} s rings above '
            f'{0.25 / filtering:.3g} 1/s: lower surface.time_constant or the gains',
        )


def _limits_of_slope(
    config: ControllerConfig, settings: Settings, load: ReferenceLoad
) -> Iterator[Finding]:
    T, damping = config.sample_time, _damping(settings, load)
    ratios = settings.barrier.slope_limit * T / damping
    for joint, ratio in zip(config.joints, ratios, strict=True):
        yield Finding(
            f'barrier.slope_limit: past the knee of its barrier {joint} is corrected by',
            ratio / 2.0,
            f'{ratio:.2g} times its error in a sample. Above 2 the error grows: give less than '
            '2 feedback.gain / sample_time',
        )


def _of_learning(
    config: ControllerConfig, settings: Settings, load: ReferenceLoad
) -> Iterator[str]:
    learning = config.learning
    rate = float(settings.adaptation.adaptation_gain.max())
    what = 'kappa Gamma T'
    if settings.adaptation.update != NEWTON:
        scale = np.sqrt(settings.adaptation.adaptation_gain[: settings.p])
        rate = float(np.linalg.eigvalsh(load.excitation * np.outer(scale, scale))[-1])
        what = 'kappa lambda_max(Gamma Phi) T'
    step = settings.adaptation.weight * rate * config.sample_time
    if step > 1.0:
        yield (
            f'learning.weight: {what} is {step:.2g}. Above 1 the estimate overshoots, above 2 it '
            'diverges: lower learning.weight or learning.adaptation_gain'
        )
    if config.reference.type == 'sinusoids':
        for frequency in config.reference.frequency:
            periods = learning.window * frequency / (2.0 * np.pi)
            if frequency > 0.0 and abs(periods - round(periods)) > _PERIODS:
                yield (
                    f'learning.window: {learning.window:g} s are {periods:.3g} periods of the '
                    f"reference's {frequency:g} rad/s: give a whole number of periods, over which "
                    'a disturbance of that frequency averages out'
                )
