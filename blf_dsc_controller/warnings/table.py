# SPDX-License-Identifier: Apache-2.0
"""The rules of a start and of other gains, and what they find in a configuration.

Those on gains are in `gains` and `stability`, those on the bound in `bounds`; here are the
others, and all of them together. doc/gains.md says how to choose them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator

import numpy as np

from blf_dsc_controller.arms.tuning import UNKNOWN_EFFORT
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.law_traits import OWN, PAPER
from blf_dsc_controller.configuration.plausibility import LONGEST_LAG
from blf_dsc_controller.configuration.robot import implausible_friction
from blf_dsc_controller.configuration.rules import (
    Excess,
    Finding,
    Rule,
    Severity,
    When,
    findings,
)
from blf_dsc_controller.errors import StartError
from blf_dsc_controller.warnings import bounds, gains, stability
from blf_dsc_controller.warnings.bodies import body_warnings
from blf_dsc_controller.warnings.case import Case, case_of

_FIRST_ERROR = 1.5  # recommended bound over the first error
_PERIODS = 0.02  # periods by which a window may differ from a whole number
_LONG = 5.0  # s: a time in ms is a thousand times as long as it should be
_TIMES = ('state_timeout', 'saturation_time')
_SLUGGISH = 1.0  # rad/s^2; the weakest joint of the presets has 60


def _of_units(case: Case) -> Iterator[str]:
    """Check for values that are those of another unit."""
    config = case.config
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


def _of_stop(case: Case) -> Iterator[str]:
    """Check that the joint bounds from which a bound at the tool follows are kept."""
    config = case.config
    share = config.safety.error_ratio
    if config.barrier.bounds_tool and not 0.0 < share <= 1.0:
        stop = (
            f'only {share:g} times past a joint bound' if share else 'at no joint bound'
        )
        yield (
            f'safety.error_ratio: the arm stops {stop}; before that, the tool may leave its '
            'bound: give 1'
        )


def _of_bodies(case: Case) -> Iterator[str]:
    return body_warnings(case.config.robot.chain(case.config.joints))


def _of_tip(case: Case) -> Iterator[str]:
    """Check for a joint of a gripper among those of the arm."""
    chain = case.config.robot.chain(case.config.joints)
    if chain.gripper and not case.config.robot.tip:
        yield (
            f'robot.tip: without it, {chain.gripper} is one of the joints of the arm. If it is '
            f'that of a gripper, give the link that carries it: {chain.joints[-2].link}'
        )


def _of_strength(case: Case) -> Iterator[str]:
    """Check for joints that are far too weak for their links."""
    config = case.config
    for joint, limit, inertia, units in zip(
        config.joints,
        config.torque.limit,
        case.load.free_inertia,
        config.units,
        strict=True,
    ):
        if limit / inertia < _SLUGGISH:
            yield (
                f'robot.urdf: {joint} accelerates at only {limit / inertia:.2g} '
                f'{units.position}/s^2 at its torque limit: are masses in kg, inertias in kg m^2, '
                'lengths in m?'
            )


def _of_torque_sensors(case: Case) -> Iterator[str]:
    """Check that joint torque sensors are used if they are declared, and only then."""
    config = case.config
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


def _of_unknown_efforts(case: Case) -> Iterator[str]:
    """Check for joints whose torque limit is assumed, for want of an effort."""
    config = case.config
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


def _of_placeholders(case: Case) -> Iterator[str]:
    """Check for efforts and friction that look like placeholders."""
    config = case.config
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


def _of_first_error(case: Case) -> Iterator[str]:
    """Check that these gains keep the first error within the bound.

    The prior of such an arm is as wide as its parameters: at first the torque may err
    by all that the reference needs, which feedback and barrier make up for: K_p (K/2 +
    mu) xi1 + w xi1.
    """
    config, settings, load = case.config, case.settings, case.load
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


def _of_learning(case: Case) -> Iterator[str]:
    config, settings, load = case.config, case.settings, case.load
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


def _of_urdf(case: Case) -> bool:
    return case.config.model == 'urdf'


def _errs_at_first(case: Case) -> bool:
    return case.config.model != 'urdf' and case.config.law in (OWN, PAPER)


def _learns(case: Case) -> bool:
    adaptation = case.settings.adaptation
    has_gains = adaptation.weight > 0.0 and adaptation.adaptation_gain.any()
    return bool(case.settings.has_barrier == 1 and has_gains)


def _row(
    name: str,
    find: Callable[[Case], Iterable[Finding]],
    applies: Callable[[Case], bool],
) -> Rule:
    return Rule(name, When.START, Severity.WARN, find, applies)


RULES = (
    Rule('robot.lag', When.START, Severity.WARN, _of_units),
    Rule('safety.error_ratio', When.START, Severity.WARN, _of_stop),
    *bounds.RULES,
    _row('torque.limit', _of_placeholders, _of_urdf),
    _row('robot.urdf', _of_bodies, _of_urdf),
    _row('robot.tip', _of_tip, _of_urdf),
    _row('torque.limit', _of_unknown_efforts, _of_urdf),
    _row('disturbance.observer_bandwidth', _of_torque_sensors, _of_urdf),
    _row('robot.urdf', _of_strength, _of_urdf),
    *gains.RULES,
    *stability.RULES,
    _row('barrier.bound', _of_first_error, _errs_at_first),
    _row('learning', _of_learning, _learns),
)


def refuse(config: ControllerConfig) -> None:
    """Raise StartError if no arm is stable with the gains, unless they are insisted on."""
    refused = findings(
        RULES, case_of(config), When.START, Severity.REFUSE, config.insist
    )
    for found in refused:
        raise StartError(str(found))


def config_warnings(
    config: ControllerConfig,
    when: When = When.START,
    *,
    in_motors: bool = False,
) -> list[str]:
    """Return the warnings, each beginning with the parameter to change first.

    Raises StartError if no arm is stable with the gains.
    """
    if When.START in when:
        refuse(config)
    case = case_of(config, in_motors=in_motors)
    return [str(each) for each in findings(RULES, case, when, Severity.WARN)]


def worsened(before: ControllerConfig, after: ControllerConfig) -> list[str]:
    """Return what is wrong with gains, and was less so before a change of a running law."""
    found = {each.subject: each for each in _excesses(after)}
    known = {each.subject: each.use for each in _excesses(before)}
    return [
        str(each)
        for subject, each in found.items()
        if each.use > known.get(subject, 1.0)
    ]


def _excesses(config: ControllerConfig) -> Iterator[Excess]:
    for severity in (Severity.WARN, Severity.REFUSE):
        for each in findings(
            RULES, case_of(config), When.LIVE, severity, config.insist
        ):
            if isinstance(each, Excess):
                yield each
