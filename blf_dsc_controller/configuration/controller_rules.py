# SPDX-License-Identifier: Apache-2.0
"""What the parameters of a controller ask of each other and of the model, one rule a row."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator

from blf_dsc_controller.arms.model import arm_model
from blf_dsc_controller.configuration import plausibility, tool_bound, two_link
from blf_dsc_controller.configuration.controller_groups import Feedback
from blf_dsc_controller.configuration.controller_parameters import (
    ControllerParameters,
)
from blf_dsc_controller.configuration.law_traits import OWN, PAPER
from blf_dsc_controller.configuration.rules import (
    Finding,
    Rule,
    Severity,
    When,
    findings,
)
from blf_dsc_controller.errors import BlfDscError


def _tell_drive(config: ControllerParameters) -> Iterator[str]:
    compensates = config.robot.drive_compensates != 'none'
    if config.load.tell_drive and not (config.weighs and compensates):
        yield (
            f'load.tell_drive: got true with model {config.model}, law {config.law} and '
            f'robot.drive_compensates {config.robot.drive_compensates}, but needs a load that is '
            f'weighed, by robot.urdf and {OWN}, and drives that compensate gravity'
        )


def _load_service(config: ControllerParameters) -> Iterator[str]:
    load = config.load
    if load.service and not load.tell_drive:
        yield (
            f'load.service: got {load.service}, but load.tell_drive is '
            'false: set it to true'
        )


def _load_frame(config: ControllerParameters) -> Iterator[str]:
    if config.load.frame:
        to_frame = dataclasses.replace(config.robot, tip=config.load.frame)
        try:
            to_frame.chain(config.joints)
        except BlfDscError as error:
            yield f'load.frame: {error}'


def _contact(config: ControllerParameters) -> Iterator[str]:
    """Check that contacts are found, and by a law that can find them."""
    contact = config.contact
    can_find = config.traits.learns and config.has_exact_rows
    if contact.enabled and not can_find:
        yield (
            f'contact.enabled: got true with law {config.law}, but the external torque needs a '
            f'law that learns, such as {OWN}'
        )
    if contact.reaction != 'none' and not contact.enabled:
        yield (
            f'contact.reaction: got {contact.reaction}, but without contact.enabled nothing '
            'finds contacts: set it to true'
        )


def _stiffness(config: ControllerParameters) -> Iterator[str]:
    feedback = config.feedback
    if config.model != 'urdf' and feedback.stiffness != Feedback().stiffness:
        yield (
            f'feedback.stiffness: got {feedback.stiffness:g} with model {config.model}, but only '
            'the gains of an arm from a URDF follow from it: leave it at 1, and lower '
            'two_link.feedback_gain and two_link.surface_gain'
        )
    if feedback.inertia == 'whole' and feedback.stiffness > 1.0:
        yield (
            f'feedback.stiffness: got {feedback.stiffness:g} with feedback.inertia whole, but '
            'the delay of the loop allows at most 1'
        )


def _damping_lag(config: ControllerParameters) -> Iterator[str]:
    feedback = config.feedback
    if any(feedback.joint_damping_lag) and feedback.inertia == 'whole':
        yield (
            f'feedback.joint_damping_lag: got {max(feedback.joint_damping_lag):g} s with '
            'feedback.inertia whole, whose damping has no lag: set it to 0'
        )


def _joint_gains(config: ControllerParameters) -> Iterator[str]:
    """Check that stiffness and damping of joints are both given, and act."""
    feedback = config.feedback
    given = bool(feedback.joint_stiffness), bool(feedback.joint_damping)
    acts = feedback.inertia == 'none' and config.model == 'urdf'
    if any(given) and config.law in (OWN, PAPER) and not acts:
        yield (
            'feedback.joint_stiffness, feedback.joint_damping: gains follow from them only '
            f'for a URDF with feedback.inertia none, but got {feedback.inertia} and model '
            f'{config.model}'
        )
    elif any(given) and not all(given):
        yield (
            'feedback.joint_stiffness, feedback.joint_damping: one of them is given, but '
            'they belong together: give both'
        )
    elif all(given) and 0.0 in (*feedback.joint_stiffness, *feedback.joint_damping):
        yield (
            'feedback.joint_stiffness, feedback.joint_damping: got 0 for a joint, but each '
            'must be above 0'
        )


def _arm(config: ControllerParameters) -> Iterator[str]:
    needed = None
    if config.model != 'urdf':
        given = two_link.two_link(config)
        needed = arm_model(given.l1, given.gravity).n
    return config.arm_problems(f'model {config.model}', needed)


def _row(name: str, find: Callable[[ControllerParameters], Iterable[Finding]]) -> Rule:
    return Rule(name, When.LOAD, Severity.REFUSE, find)


_FIRST = (
    _row('load.tell_drive', _tell_drive),
    _row('load.service', _load_service),
    _row('load.frame', _load_frame),
    _row('contact', _contact),
    _row('feedback.stiffness', _stiffness),
    _row('feedback.joint_damping_lag', _damping_lag),
    _row('feedback.joint_stiffness', _joint_gains),
    _row('joints', _arm),
    _row('reference.times', lambda config: config.reference.problems()),
    _row(
        'limits.position_upper',
        lambda config: config.limits.problems(config.joints, config.units),
    ),
    _row('barrier.tool_bound', tool_bound.problems),
    _row(
        'learning.window',
        lambda config: config.learning.problems(config.sample_time),
    ),
    plausibility.INSISTED,
)


def problems(config: ControllerParameters) -> Iterator[Finding]:
    """Yield why a configuration is refused when it is built."""
    yield from _found(_FIRST, config)
    of_robot = [*_found(plausibility.OF_ROBOT, config)]
    yield from of_robot or _found(plausibility.OF_CONTROLLER, config)


def _found(rules: Iterable[Rule], config: ControllerParameters) -> Iterator[Finding]:
    return findings(rules, config, When.LOAD, Severity.REFUSE, config.insist)
