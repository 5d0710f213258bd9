# SPDX-License-Identifier: Apache-2.0
"""Whether gains are too high for the sampled loop, for known gears or for drives of any weight.

The loop of an arm from a URDF, in a few postures, without and with its payload, is that of
`arms.linear_loop`.  Gears are rigid where `robot.joint_stiffness` is not given.  Drives whose
inertia is a guess may be some times as heavy, which makes the loop of the same gains slower.
Gains that make errors grow with every one of these drives or gears are refused: nothing holds the
arm but its friction.  Gains that do with some of them are warned of.  What is stable instead
are the gains that would follow if its gears were known (`arms.known_gears`).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.arms.joint_gains import linear
from blf_dsc_controller.arms.known_gears import MARGIN
from blf_dsc_controller.arms.linear_loop import Loop
from blf_dsc_controller.configuration.plausibility import STIFFNESS
from blf_dsc_controller.configuration.rules import Excess, Rule, Severity, When
from blf_dsc_controller.numerics.digits import two_digits
from blf_dsc_controller.warnings.case import Case

# Modulus margin below which gains of known gears are warned of: the makers' gains of the presets
# that hold have 0.20 (openarm) to 0.43 (fr3_direct) with rigid gears.
_LEAST_MARGIN = 0.2
# radius from which errors grow: an integrator without gain has 1, as exactly as it is computed
_GROWS = 1.0 + 1e-6


class _Oscillation(NamedTuple):
    """The oscillation that grows fastest in a loop."""

    growth: float  # from sample to sample
    joint: int
    frequency: float  # Hz


def _oscillation(loop: Loop) -> _Oscillation:
    """Return what grows fastest in a loop, or decays most slowly."""
    A, _ = loop.transition()
    values, vectors = np.linalg.eig(A)
    k, i = np.unravel_index(int(np.abs(values).argmax()), values.shape)
    n = len(loop.joints.motors)
    inertia = np.diagonal(loop.links[k]) + loop.joints.motors
    moves = np.abs(vectors[k, :n, i]) * np.sqrt(inertia)
    frequency = abs(np.angle(values[k, i])) / (2.0 * np.pi * loop.timing.period)
    growth = abs(values[k, i]) / _GROWS
    return _Oscillation(float(growth), int(moves.argmax()), float(frequency))


def _all_grow(case: Case) -> Iterator[Excess]:
    """Refuse gains with which no arm is stable."""
    found = [_oscillation(loop) for loop in case.loops]
    least = min(each.growth for each in found)
    if least > 1.0:
        text = (
            f'{_grows(case, found[0])}{_advice(case)}. If the motors of the arm close this loop '
            'themselves, keep the gains that the maker runs in them: `blf_dsc drive` with '
            f'drive.feedback: motor. If these are meant, list {STIFFNESS} in insist'
        )
        yield Excess(f'{STIFFNESS}:', least, text)


def _some_grow(case: Case) -> Iterator[Excess]:
    """Warn of gains with which some of the possible arms are unstable."""
    robot = case.config.robot
    found = next(
        (each for each in map(_oscillation, case.loops) if each.growth > 1.0), None
    )
    if found is not None:
        doubt = ''
        if not robot.joint_stiffness:
            doubt = (
                ' if its drives are as light as guessed (without robot.rotor_inertia)'
            )
        text = f'{_grows(case, found)}{doubt}{_advice(case)}'
        yield Excess(f'{STIFFNESS}:', found.growth, text)
    elif robot.joint_stiffness:
        margin = min(loop.margin() for loop in case.loops)
        text = (
            f'with robot.joint_stiffness the loop rings near {two_digits(margin.frequency)} Hz, '
            f'its modulus margin is {margin.value:.2g}'
        )
        if margin.value < _LEAST_MARGIN:
            yield Excess(
                f'{STIFFNESS}:', _LEAST_MARGIN / margin.value, text + _advice(case)
            )


def _grows(case: Case, found: _Oscillation) -> str:
    config = case.config
    gears = (
        'with robot.joint_stiffness'
        if config.robot.joint_stiffness
        else ('on rigid gears too')
    )
    return (
        f'with a sample time of {config.sample_time:g} s and a robot.lag of '
        f'{config.robot.lag:g} s these gains make errors grow from sample to sample, {gears}: '
        f'{config.joints[found.joint]} oscillates at {two_digits(found.frequency)} Hz'
    )


def _advice(case: Case) -> str:
    """Return gains with which all loops have the margin, to be pasted."""
    arm = case.arm
    gains = arm.joint_gains()
    if arm.margin(linear(gains, arm.inertia, len(arm.links))).value < MARGIN:
        return '. Lower it, or measure its stability limit: `blf_dsc commission`'
    stiffness, damping = (
        [float(f'{each:.2g}') for each in values]
        for values in (gains.stiffness, gains.damping)
    )
    without = ''
    if any(case.config.feedback.joint_damping_lag):
        without = ', without feedback.joint_damping_lag'
    return (
        f'. It is stable with feedback.joint_stiffness: {stiffness} and feedback.joint_damping: '
        f'{damping}{without}'
    )


def _held_softly(case: Case) -> Iterator[str]:
    """Warn that nothing is known of the gears, so that gains only hold the arm softly."""
    config = case.config
    if config.feedback.joint_stiffness or config.robot.joint_stiffness:
        return
    damping = case.settings.feedback.gain
    softest = int(np.argmin(damping))
    joint = config.joints[softest]
    unit = config.units[softest].of('N m s/rad')
    yield (
        'feedback.joint_stiffness: nothing is known of the gears of this arm, so its gains '
        f'only hold it softly, {joint} with a damping of {damping[softest]:.2g} {unit}. '
        'Measure it with `blf_dsc commission`, or give feedback.joint_stiffness and '
        'feedback.joint_damping as the maker of the arm publishes them, or '
        'robot.joint_stiffness'
    )


def _unmeasured(case: Case) -> Iterator[str]:
    """Warn before a robot moves with gains that were not found by measuring it.

    Gains of an arm of which nothing is known are warned of in any case (`_held_softly`).
    """
    config = case.config
    feedback = config.feedback
    if config.commissioning.friction:
        if feedback.stiffness > 1.0:
            yield (
                f'feedback.stiffness: {feedback.stiffness:g} times the gains for which this arm '
                'was commissioned: give 1 at most, or measure it again'
            )
        return
    is_unknown = not (feedback.joint_stiffness or config.robot.joint_stiffness)
    if feedback.inertia == 'none' and is_unknown:
        return
    unmeasured = (
        'commissioning: nobody has measured whether this arm is stable with its gains'
    )
    if case.in_motors:
        yield (
            f'{unmeasured}, which its motors close, and `blf_dsc commission` measures torques over '
            'the bus: begin with those of its maker, and halve feedback.stiffness if the arm hums '
            'or rings'
        )
    else:
        yield f'{unmeasured}: `blf_dsc commission` does, and chooses gains with a margin'


def _is_fixed(case: Case) -> bool:
    return case.is_fixed


_GAINS = When.START | When.LIVE

RULES = (
    Rule(STIFFNESS, _GAINS, Severity.REFUSE, _all_grow, _is_fixed, can_insist=True),
    Rule(STIFFNESS, _GAINS, Severity.WARN, _some_grow, _is_fixed),
    Rule(
        'feedback.joint_stiffness', When.START, Severity.WARN, _held_softly, _is_fixed
    ),
    Rule(
        'commissioning',
        When.ROBOT,
        Severity.WARN,
        _unmeasured,
        lambda case: case.is_linear,
    ),
)
