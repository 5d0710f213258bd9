# SPDX-License-Identifier: Apache-2.0
"""Warnings about a configuration that is valid but cannot work well.

Those on gains are in `gains` and `stability`, those on the bound in `bounds`; here are the
others, and all of them together. doc/tuning.md derives them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from blf_dsc_controller.arms.tuning import UNKNOWN_EFFORT
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.law_traits import OWN, PAPER
from blf_dsc_controller.configuration.plausibility import LONGEST_LAG
from blf_dsc_controller.configuration.robot import (
    implausible_friction,
)
from blf_dsc_controller.factory.settings import settings_of_config
from blf_dsc_controller.law.state import Settings
from blf_dsc_controller.warnings.bodies import body_warnings
from blf_dsc_controller.warnings.bounds import (
    error_warnings,
    width_warnings,
)
from blf_dsc_controller.warnings.expected_errors import (
    expected_errors,
)
from blf_dsc_controller.warnings.gains import exceeded_limits
from blf_dsc_controller.warnings.reference_load import ReferenceLoad, reference_load
from blf_dsc_controller.warnings.stability import (
    is_checked,
    refuse_unstable,
    soft_gains_warning,
    stability_warnings,
)

_FIRST_ERROR = 1.5  # recommended bound over the first error
_PERIODS = 0.02  # periods by which a window may differ from a whole number
_LONG = 5.0  # s: a time in ms is a thousand times as long as it should be
_TIMES = (
    'state_timeout',
    'saturation_time',
    'stop_ramp',
    'deactivation_ramp',
)
_SLUGGISH = 1.0  # rad/s^2; the weakest joint of the presets has 60


def _of_units(config: ControllerConfig) -> Iterator[str]:
    """Check for values that are those of another unit."""
    lag = config.robot.lag
    if lag > LONGEST_LAG:
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
    refuse_unstable(config, settings)
    if is_checked(config):
        errors = expected_errors(config, settings)
    found = [*_of_units(config), *width_warnings(config, errors), *_of_stop(config)]
    if config.model == 'urdf':
        found += _of_urdf(config, load)
    found += [f'{each.subject} {each.text}' for each in exceeded_limits(config, load)]
    if errors is not None:
        found += stability_warnings(config, settings)
        found += soft_gains_warning(config, settings)
        found += error_warnings(config, settings.barrier.bound, errors)
    if config.model != 'urdf' and config.law in (OWN, PAPER):
        found += _of_first_error(config, settings, load)
    if (
        settings.has_barrier == 1
        and settings.adaptation.weight > 0.0
        and settings.adaptation.adaptation_gain.any()
    ):
        found += _of_learning(config, settings, load)
    return found


def _of_urdf(config: ControllerConfig, load: ReferenceLoad) -> Iterator[str]:
    """Check for implausible figures, and for defaults that are hardly meant."""
    yield from _of_placeholders(config)
    chain = config.robot.chain(config.joints)
    yield from body_warnings(chain)
    if chain.gripper and not config.robot.tip:
        yield (
            f'robot.tip: without it, {chain.gripper} is one of the joints of the arm. If it is '
            f'that of a gripper, give the link that carries it: {chain.joints[-2].link}'
        )
    yield from _of_unknown_efforts(config)
    yield from _of_torque_sensors(config)
    for joint, limit, inertia, units in zip(
        chain.joints, config.torque.limit, load.free_inertia, config.units, strict=True
    ):
        if limit / inertia < _SLUGGISH:
            yield (
                f'robot.urdf: {joint.name} accelerates at only {limit / inertia:.2g} '
                f'{units.position}/s^2 at its torque limit: are masses in kg, inertias in kg m^2, '
                'lengths in m?'
            )


def _of_torque_sensors(config: ControllerConfig) -> Iterator[str]:
    """Check that joint torque sensors are used if they are declared, and only then."""
    pole = config.disturbance.observer_bandwidth
    if config.has_torque_sensors and not pole and not config.commissioning.friction:
        yield (
            'disturbance.observer_bandwidth: nothing has proven the joint torque sensors that '
            'robot.effort and robot.torque_loop declare, so that no load is taken up by them: '
            'commission the arm (`blf_dsc commission`), which measures them and gives this pole'
        )
    if pole and not config.has_torque_sensors:
        yield (
            f'disturbance.observer_bandwidth: {pole:g} rad/s is not used: the load observer needs '
            'joint torque sensors (robot.torque_loop true and robot.effort whole) and '
            f'{OWN} as law'
        )


def _of_unknown_efforts(config: ControllerConfig) -> Iterator[str]:
    """Check for joints whose torque limit is assumed, for want of an effort."""
    joints = config.robot.chain(config.joints).joints
    assumed = {
        joint.name: f'{limit:g} {units.torque}'
        for joint, limit, units in zip(
            joints, config.torque.limit, config.units, strict=True
        )
        if math.isinf(joint.effort) and limit == UNKNOWN_EFFORT
    }
    if assumed:
        limits = ' or '.join(dict.fromkeys(assumed.values()))
        yield (
            f'torque.limit: no effort in the URDF for {", ".join(assumed)}: {limits} is assumed; '
            'give the rated torque of each drive'
        )


def _of_placeholders(config: ControllerConfig) -> Iterator[str]:
    """Check for efforts and friction that look like placeholders."""
    robot = config.robot
    chain = robot.chain(config.joints)
    if (joints := robot.placeholder_efforts(chain)) and not robot.rotor_inertia:
        efforts = {joint.name: joint.effort for joint in chain.joints}
        largest = max(joints, key=efforts.__getitem__)
        unit = config.units[config.joints.index(largest)].torque
        yield (
            f'torque.limit: an effort of up to {efforts[largest]:g} {unit} for {", ".join(joints)} '
            'looks like a placeholder on an arm of this weight. The assumed inertia of the drives '
            'and learning.residual_floor follow from the weight instead: give the rated torques'
        )
    if (joints := implausible_friction(robot, chain)) and not (
        robot.viscous and robot.coulomb
    ):
        yield (
            'robot.coulomb: the friction in the description takes a quarter of the effort of '
            f'{", ".join(joints)} or more, which looks like a placeholder. Friction is not '
            'compensated until it is learned: give robot.viscous and robot.coulomb'
        )


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
        unit = config.units[worst].position
        needed = _FIRST_ERROR * errors[worst]
        yield (
            f'barrier.bound: until the arm is learned, {config.joints[worst]} may be '
            f'{errors[worst]:.2g} {unit} from its reference with these gains, past its bound of '
            f'{widest[worst]:g} {unit}: give {needed:.2g} {unit} or more, or larger gains at '
            'a shorter sample_time'
        )


def _of_learning(
    config: ControllerConfig, settings: Settings, load: ReferenceLoad
) -> Iterator[str]:
    learning = config.learning
    rate = float(settings.adaptation.adaptation_gain.max())
    what = 'kappa Gamma T'
    if config.law == PAPER:
        scale = np.sqrt(settings.adaptation.adaptation_gain[: settings.p])
        rate = float(np.linalg.eigvalsh(load.excitation * np.outer(scale, scale))[-1])
        what = 'kappa lambda_max(Gamma Phi) T'
    step = settings.adaptation.weight * rate * config.sample_time
    if step > 1.0:
        yield (
            f'two_link.learning_weight: {what} is {step:.2g}. Above 1 the estimate overshoots, '
            'above 2 it diverges: lower it or two_link.adaptation_gain'
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
