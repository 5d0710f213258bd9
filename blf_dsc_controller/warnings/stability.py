# SPDX-License-Identifier: Apache-2.0
"""Whether gains are too high for the sampled loop, for known gears or for drives of any weight.

The loop of an arm from a URDF, in a few postures, without and with its payload, is that of
`arms.linear_loop`.  Gears are rigid where `robot.joint_stiffness` is not given.  Drives whose
inertia is a guess may be some times as heavy, which makes the loop of the same gains slower.
Gains that make errors grow with every one of these drives or gears are refused: nothing holds the
arm but its friction.  Gains that do with some of them are warned of.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms import tuning
from blf_dsc_controller.arms.joint_gains import JointGains, damped_arm, linear
from blf_dsc_controller.arms.known_gears import MARGIN
from blf_dsc_controller.arms.linear_loop import Feedback, Joints, Loop, Timing
from blf_dsc_controller.arms.model import inertia_matrices
from blf_dsc_controller.configuration.controller import ControllerConfig, design_of
from blf_dsc_controller.configuration.law_traits import OWN, PAPER
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.errors import StartError
from blf_dsc_controller.factory.settings import settings_of_config
from blf_dsc_controller.law.state import Settings
from blf_dsc_controller.numerics.digits import two_digits

Floats = NDArray[np.float64]

STIFFNESS = 'feedback.stiffness'
"""The parameter of gains that are too high; listed in `insist`, they are not refused."""
LEAST_MARGIN = 0.2
"""Modulus margin below which gains are warned of."""

# radius from which errors grow: an integrator without gain has 1, as exactly as it is computed
_GROWS = 1.0 + 1e-6
_POSTURES = 3
_SOFTER = 0.8  # of the damping, until joints that are coupled are stable, too
_TRIALS = 10
_SOFTEST = 1.0 / 64.0  # of the gains of a joint
_BISECTIONS = 8


class Oscillation(NamedTuple):
    """The oscillation that grows fastest in a loop."""

    joint: int
    frequency: float  # Hz


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


def possible_joints(config: ControllerConfig) -> list[Joints]:
    """Return what may be between torques and links, beside the inertia of the model.

    The first is as stated or guessed.
    """
    arm, gears = design_of(config)
    if gears is not None:
        return list(gears.variants())
    viscous = np.array(config.robot.friction(arm.chain)['viscous'])
    guessed = Joints(motors=np.zeros(len(viscous)), viscous=viscous)
    if not guesses_rotors(config):
        return [guessed]
    unknown = np.asarray(config.robot.unknown_rotors(arm.chain))
    return [guessed, guessed._replace(motors=unknown)]


def _loops(config: ControllerConfig, settings: Settings) -> list[Loop]:
    """Return the loops that an arm may have with its law."""
    arm, gears = design_of(config)
    model, n = settings.model, settings.n
    q = np.random.default_rng(0).uniform(*arm.limits, (_POSTURES, n))
    rotors = np.zeros(n) if gears is not None else arm.rotors
    P = arm.parameters.of(arm.chain.inertias, rotors)
    loaded = P + arm.payload * arm.parameters.load
    links = np.concatenate([inertia_matrices(model, each, q) for each in (P, loaded)])
    M0 = inertia_matrices(model, settings.initial_estimate[: settings.p], q)
    M0 = np.concatenate([M0, M0])
    feedback = linear_feedback(settings, M0, settings.barrier.weight)
    timing = timing_of(config)
    return [Loop(links, joints, timing, feedback) for joints in possible_joints(config)]


def _oscillation(loop: Loop) -> Oscillation | None:
    """Return what grows fastest in a loop; None if it is stable."""
    A, _ = loop.transition()
    values, vectors = np.linalg.eig(A)
    if np.abs(values).max() < _GROWS:
        return None
    k, i = np.unravel_index(int(np.abs(values).argmax()), values.shape)
    n = len(loop.joints.motors)
    inertia = np.diagonal(loop.links[k]) + loop.joints.motors
    moves = np.abs(vectors[k, :n, i]) * np.sqrt(inertia)
    frequency = abs(np.angle(values[k, i])) / (2.0 * np.pi * loop.timing.period)
    return Oscillation(int(moves.argmax()), float(frequency))


def is_checked(config: ControllerConfig) -> bool:
    """Whether the law of a configuration, and its arm, have a linear loop that is known."""
    return config.model == 'urdf' and config.law in (OWN, PAPER)


def _adapts_to_drives(config: ControllerConfig) -> bool:
    """Whether the law measures the inertia of the drives, and takes down its gains."""
    return config.feedback.inertia == 'whole'


def refuse_unstable(config: ControllerConfig, settings: Settings) -> None:
    """Raise StartError if no arm bears these gains, unless they are insisted on."""
    if not is_checked(config) or _adapts_to_drives(config):
        return
    if STIFFNESS in config.insist:
        return
    loops = _loops(config, settings)
    found = [_oscillation(each) for each in loops]
    first = found[0]
    if first is None or None in found:
        return
    problem = (
        f'{STIFFNESS}: {_grows(config, first)}{_advice(config, loops[0])}. If the motors of the '
        'arm close this loop themselves, keep the gains that the maker runs in them: `blf_dsc '
        f'drive` with drive.feedback: motor. If these are meant, list {STIFFNESS} in insist'
    )
    raise StartError(problem)


def stability_warnings(config: ControllerConfig, settings: Settings) -> Iterator[str]:
    """Warn of gains that some of the arms that are possible do not bear."""
    if _adapts_to_drives(config):
        return
    loops = _loops(config, settings)
    found = next(filter(None, map(_oscillation, loops)), None)
    if found is not None:
        doubt = ''
        if not config.robot.joint_stiffness:
            doubt = (
                ' if its drives are as light as guessed (without robot.rotor_inertia)'
            )
        yield f'{STIFFNESS}: {_grows(config, found)}{doubt}{_advice(config, loops[0])}'
        return
    if config.robot.joint_stiffness:
        margin = min(loop.margin() for loop in loops)
        if margin.value < LEAST_MARGIN:
            yield (
                f'{STIFFNESS}: with robot.joint_stiffness the loop rings near '
                f'{two_digits(margin.frequency)} Hz, its modulus margin is {margin.value:.2g}'
                f'{_advice(config, loops[0])}'
            )


def _grows(config: ControllerConfig, found: Oscillation) -> str:
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


def _advice(config: ControllerConfig, loop: Loop) -> str:
    """Return gains with which all loops are stable, to be pasted."""
    arm, _ = design_of(config)
    least = LEAST_MARGIN if config.robot.joint_stiffness else 0.0
    gains = stiffest_gains(config, loop)
    for _ in range(_TRIALS):
        if gains is None:
            break
        stiffness = [float(f'{value:.2g}') for value in gains.stiffness]
        damping = [float(f'{value:.2g}') for value in gains.damping]
        values = {
            'feedback.joint_stiffness': stiffness,
            'feedback.joint_damping': damping,
        }
        integral = tuning.gains_of(arm._replace(joints=gains, stiffness=1.0)).integral
        rest = {STIFFNESS: 1.0, 'disturbance.gain': integral}
        softer = change(config, values | rest)
        loops = _loops(softer, settings_of_config(softer))
        if all(each.margin().value > least for each in loops):
            texts = ' and '.join(f'{name}: {each}' for name, each in values.items())
            return f'. It bears {texts}'
        # damping ratios stay: stiffness goes with the square of the damping
        gains = JointGains(
            _SOFTER**2 * gains.stiffness, _SOFTER * gains.damping, gains.damping_lag
        )
    return '. Lower it, or measure what the arm bears: `blf_dsc commission`'


def stiffest_gains(config: ControllerConfig, loop: Loop) -> JointGains | None:
    """Return the largest gains, none above those given, with which each joint has the margin.

    Each is looked at alone, with its least and its largest inertia in the postures of a loop.
    None: the feedback acts through the inertia matrix.
    """
    arm, _ = design_of(config)
    if arm.joints is None:
        return None
    lag = np.array(config.feedback.lags(len(config.joints)))
    given = arm.joints.scaled(arm.stiffness)._replace(damping_lag=lag)
    largest = arm.over_postures().inertia
    if guesses_rotors(config):
        largest = largest + config.robot.unknown_rotors(arm.chain)
    factors = np.array(
        [
            _largest_factor(
                _joint_alone(loop, j, most), _gains_of_joint(given, j), most
            )
            for j, most in enumerate(largest)
        ]
    )
    return _damped(given, factors, largest)


def _damped(gains: JointGains, factor: float | Floats, inertia: Floats) -> JointGains:
    """Return gains times a factor, with no more stiffness than leaves the inertia damped."""
    scaled = gains.scaled(factor)
    most = damped_arm(scaled.damping, inertia).stiffness
    return scaled._replace(stiffness=np.minimum(scaled.stiffness, most))


def _joint_alone(loop: Loop, j: int, largest: float) -> Loop:
    """Return the loop of one joint, with its least inertia, others free, and its largest."""
    free = 1.0 / np.diagonal(np.linalg.inv(loop.links), axis1=1, axis2=2)[:, j].max()
    joints = loop.joints
    springs = joints.stiffness
    return loop._replace(
        links=np.array([free, largest]).reshape(2, 1, 1),
        joints=joints._replace(
            motors=joints.motors[j : j + 1],
            viscous=joints.viscous[j : j + 1],
            stiffness=None if springs is None else springs[j : j + 1],
        ),
    )


def _gains_of_joint(gains: JointGains, j: int) -> JointGains:
    one = slice(j, j + 1)
    lag = np.asarray(gains.damping_lag)[one]
    return gains._replace(
        stiffness=gains.stiffness[one], damping=gains.damping[one], damping_lag=lag
    )


def _largest_factor(loop: Loop, gains: JointGains, inertia: float) -> float:
    """Return the largest factor on the gains of a joint, up to 1, with the margin."""
    low, high = _SOFTEST, 1.0
    for _ in range(_BISECTIONS):
        most = np.array([inertia])
        law = linear(_damped(gains, high, most), most, len(loop.links))
        if loop._replace(feedback=law).margin().value >= MARGIN:
            low = high
        else:
            last = high
        if low == 1.0:
            break
        high = math.sqrt(low * last)
    return low


def soft_gains_warning(config: ControllerConfig, settings: Settings) -> Iterator[str]:
    """Warn that nothing is known of the gears, so that gains only hold the arm softly."""
    feedback = config.feedback
    if (
        feedback.inertia != 'none'
        or feedback.joint_stiffness
        or config.robot.joint_stiffness
    ):
        return
    damping = settings.feedback.gain
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
