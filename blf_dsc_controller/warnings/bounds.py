# SPDX-License-Identifier: Apache-2.0
"""Warnings about the bound: one that bounds nothing, or that the errors to expect leave."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from blf_dsc_controller.arms.base_parameters import HEAVIER_DRIVE
from blf_dsc_controller.arms.tuning import SAMPLES, loop_delay
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.robot import UNKNOWN_FRICTION
from blf_dsc_controller.configuration.rules import Rule, Severity, When
from blf_dsc_controller.configuration.tool_bound import ANGLE, POSITION
from blf_dsc_controller.run import TURNING, JointUnits
from blf_dsc_controller.warnings.case import Case
from blf_dsc_controller.warnings.expected_errors import ExpectedErrors, guesses_rotors

# exponent of an error in the stiffness it needs: 0.5 without delays
_STIFFENING = 0.6
_ROOM = 1.1  # recommended bound over the errors to expect
_WIDEST_BOUND = 0.35  # rad, 20 degrees


def _width(case: Case) -> Iterator[str]:
    """Check for bounds that bound nothing: of another unit, or because of soft gains."""
    config, errors = case.config, case.errors
    barrier = config.barrier
    widest = max(barrier.bound)
    if widest <= _WIDEST_BOUND:
        return
    name = 'barrier.bound'
    units = config.units[barrier.bound.index(widest)]
    wide = f'{widest:g} {units.position}'
    remedy = f'is it in mm? Give {1e-3 * widest:.3g}'
    if units == TURNING:
        wide += f' is {math.degrees(widest):.3g} degrees and'
        remedy = (
            f'is it in degrees? Give {math.radians(widest):.3g}; in mrad? Give '
            f'{1e-3 * widest:.3g}'
        )
    if of_tool := _tool_parameter(config):
        name = of_tool
        remedy = 'the bound of a joint follows from this one: give less'
    elif errors is not None and not errors.is_endless:
        is_widest = np.array(barrier.bound) == widest
        needed = np.where(is_widest, errors.unmodelled + errors.pick_up, 0.0)
        j = int(needed.argmax())
        if _ROOM * needed[j] > _WIDEST_BOUND:
            remedy = (
                f'{config.joints[j]} is expected to be up to {needed[j]:.2g} '
                f'{config.units[j].position} from its '
                'reference with these gains. Give less robot.payload, if the arm carries less, or '
                'stiffer gains, if it is stable with them; then narrow the bound'
            )
    yield f'{name}: {wide} bounds nothing: {remedy}'


def _tool_parameter(config: ControllerConfig) -> str:
    """Return the parameter by which the error at the tool is bounded; empty if it is not."""
    if not config.barrier.bounds_tool:
        return ''
    return POSITION if config.barrier.tool_bound > 0.0 else ANGLE


def _of_unmodelled(case: Case) -> Iterator[str]:
    """Check the errors by friction and unmodelled torque."""
    config, bound = case.config, case.settings.barrier.bound
    errors = _expected(case).unmodelled
    worst = int(np.argmax(errors / bound))
    if not errors[worst] > bound[worst]:
        return
    units = config.units[worst]
    unit = units.position
    parameter = 'barrier.bound'
    remedy = f'{_wide_enough(errors[worst], units)} stiffer gains, if the arm is stable with them'
    if of_tool := _tool_parameter(config):
        parameter = of_tool
        wider = float(errors[worst] / bound[worst])
        remedy = (
            f'past its joint bound of {bound[worst]:g} {unit}; give more than {wider:.2g} times '
            'this bound at the tool'
        )
    yield (
        f'{parameter}: friction{_assumed_friction(config)} and unmodelled torque '
        f'(learning.residual_floor){_guessed_rotors(config)} alone are expected to move '
        f'{config.joints[worst]} '
        f'{errors[worst]:.2g} {unit} from its reference: {remedy}'
    )


def _assumed_friction(config: ControllerConfig) -> str:
    """Return how much friction is assumed, in brackets; empty if that of each joint is known."""
    robot = config.robot
    is_unknown = robot.unknown_friction(robot.chain(config.joints)).any()
    if config.commissioning.friction or not is_unknown:
        return ''
    share = f'{100.0 * UNKNOWN_FRICTION:g} %'
    return f' ({share} of the rated torque without robot.coulomb)'


def _guessed_rotors(config: ControllerConfig) -> str:
    """Return how heavy the drives may be, after a comma; empty if that is known."""
    if not guesses_rotors(config):
        return ''
    return (
        f', and drives up to {1.0 + HEAVIER_DRIVE:g} times as heavy as guessed '
        '(without robot.rotor_inertia),'
    )


def _wide_enough(error: float, units: JointUnits) -> str:
    """Return what to give against an error of a joint, before what else helps."""
    wide_enough = _ROOM * error
    if wide_enough > math.pi and units == TURNING:
        return 'no bound below half a turn is wide enough; give'
    return f'give {wide_enough:.2g} {units.position}, or'


def _of_pick_up(case: Case) -> Iterator[str]:
    """Check the errors when a load is picked up in motion."""
    config, bound = case.config, case.settings.barrier.bound
    errors = _expected(case).pick_up
    worst = int(np.argmax(errors / bound))
    peak = errors[worst]
    if not peak > bound[worst]:
        return
    share = bound[worst] / peak
    parameter = 'barrier.bound'
    units = config.units[worst]
    wide_enough = _wide_enough(peak, units)
    if of_tool := _tool_parameter(config):
        parameter = of_tool
        wide_enough = f'give {_ROOM / share:.2g} times this bound at the tool, or'
    payload = config.robot.payload
    yield (
        f'{parameter}: when {payload:g} kg (robot.payload) are picked '
        f'up in motion, {config.joints[worst]} is expected to be {peak:.2g} {units.position} '
        f'from its reference, past its bound of {bound[worst]:g} {units.position}: {wide_enough} '
        f'{_remedy_of_pick_up(config, share)}, or pick up at most {share * payload:.2g} kg'
    )


def _remedy_of_pick_up(config: ControllerConfig, share: float) -> str:
    """Return the change that reduces the error of a pick-up to this share of it."""
    lag = config.robot.lag
    if config.feedback.inertia == 'none':
        return 'a larger feedback.stiffness, if the arm is stable with it'
    stiffer = config.feedback.stiffness / share**_STIFFENING
    if stiffer <= 1.0:
        return f'a feedback.stiffness of {math.ceil(100.0 * stiffer) / 100.0:g}'
    faster = loop_delay(config.sample_time, lag) * math.sqrt(share) - lag
    if faster > 0.0:
        return f'a sample time of {faster / SAMPLES:.2g} s'
    return f'a robot.lag below {lag:g} s'


def _expected(case: Case) -> ExpectedErrors:
    assert case.errors is not None  # noqa: S101 - `_has_errors`
    return case.errors


def _has_errors(case: Case) -> bool:
    return case.errors is not None and not case.errors.is_endless


RULES = (
    Rule('barrier.bound', When.START, Severity.WARN, _width),
    Rule('barrier.bound', When.START, Severity.WARN, _of_unmodelled, _has_errors),
    Rule('barrier.bound', When.START, Severity.WARN, _of_pick_up, _has_errors),
)
