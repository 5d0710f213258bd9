# SPDX-License-Identifier: Apache-2.0
"""What gains that elastic joints bear leave of the error: this law, its rivals, and the goals.

    python -m benchmark soft-arms [goals] [--truths N] [--arms NAME...] [--laws LAW...]
                                  [--links] [--keep FILE]
    python -m benchmark soft-arms integrator [--truths N] [--arms NAME...]
    python -m benchmark soft-arms observers [--truths N] [--arms NAME...]

`goals`: each arm moves as its preset does and picks up 2 kg at 8 s.  A row has the median and the
worst of the N true arms on which a law holds, the same for all laws.  Around those of the row
they have other links, gears, motors and friction, falling and load-dependent, drawn
independently of the controller (`drawn`), or with `--links` other links alone; gains are those of
the arm that is assumed:

    in motion, pick-up, later   the largest error [mrad] from 4 s to the pick-up, from then on, and
                                from 3.5 s after it on, at the encoders; where these are at the
                                motors, a second row has that of the links
    weight known after          until its 95 % interval is within 0.1 kg of 2 kg
    rms                         of the error's norm [mrad], from 3.5 s after the pick-up on; and of
                                each arm, that of the law without learning over it
    shakes                      rms of the torque above 8 Hz in the worst second, of its limit, and
                                whether an oscillation was reported, by which this law halves
                                its gains

The laws:

    this law           with its joint torque sensors, where the arm has them
    without sensors    the same without its load observer
    without learning   the same feedback and model: a PID over the URDF's model along the
                       reference, with the load observer where the arm has sensors
    PD                 stiffness and damping of the maker over gravity, as in Franka's example
    computed torque    with an integral, through the inertia matrix of the URDF
    DOB                that PD over the URDF's model along the reference, and a disturbance
                       observer by momentum, fed forward
    RISE               that PD over that model, and the integral of the error's sign (`rise.py`)

The last four have the gains with which the linear loop (`random_arms`) has the modulus margin
of this law on this arm, the largest factor or rate; of the DOB's and RISE's, the pair of factor
and pole with the largest integral gain.  RISE's sign has the half of this rate, at the amplitude
SIGN of the error by its describing function.  The margin is without the load observer.  The UR5e
whose gears do not bear the gains of its maker has those that leave a margin of 0.5.

`--keep` appends each run to a file, from which the same command goes on.

`integrator`: this law with multiples of `disturbance.gain`, and of each the least factor by which
the slow oscillation of the outstretched arm with its rated payload is damped in `joint_gains.py`
(3 by the rule there; below 1 it grows), with the motors that the arm has.  `by the rule`: as much
as leaves each joint this 3, without the most that the rule also sets.  Arms `*_rest` hold their
posture, in gears with play; rivals have there the gains that they have in motion.

`observers`: the DOB with each pair of factor and pole that has the margin.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmark import elastic, load_observer, random_arms
from benchmark.harness import print_table
from benchmark.kept import Results
from benchmark.load_observer import LATER, PICK_UP, Law
from benchmark.options import positive
from benchmark.random_arms import CT, PD, RANGES, ROBOTS, THIS
from blf_dsc_controller.arms.known_gears import MARGIN
from blf_dsc_controller.arms.linear_loop import Feedback
from blf_dsc_controller.arms.tuning import over_postures
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import LoopConfig
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.robot import parameters_of
from blf_dsc_controller.configuration.schema import flatten
from blf_dsc_controller.simulation.loop import simulate
from blf_dsc_controller.studies.laws import COMPUTED_TORQUE

NO_SENSORS, NO_LEARNING = 'without sensors', 'without learning'
DOB, RISE = 'DOB', 'RISE'
RIVALS = (PD, CT, DOB, RISE)
LAWS = (THIS, NO_SENSORS, NO_LEARNING, *RIVALS)
MOMENTUM = str(Path(__file__).with_name('momentum_observer.py').resolve())
ROBUST = str(Path(__file__).with_name('rise.py').resolve())
FACTORS = 0.01, 1.0  # on the maker's gains, among them
POLES = 0.1, 100.0  # rad/s, of the DOB
SHARES = (0.5, 0.75, 1.0)  # of the PD's factor, in the DOB
POSTURES = 3
SIGN = 1e-2  # rad, amplitude of the error at which the sign is half of RISE's integral

SPREADS = {  # of each joint, over what the arm of a row has
    'joint.stiffness': 1.25,
    'truth.rotor_inertia': 1.25,
    'disturbance.viscous': 2.0,
    'disturbance.coulomb': 1.6,
}
FALLING = (0.0, 1.0)  # friction at rest in excess of that in motion, relative
FALLS_OVER = (0.05, 0.2)  # rad/s
OF_LOAD = (0.0, 0.08)  # friction, of the torque that a gear carries

_Changes = Mapping[str, object]


class Arm(NamedTuple):
    """A preset, what differs from it, and what is aimed at."""

    robot: str
    label: str
    plant: _Changes
    gains: _Changes
    goal: tuple[str, str, str]  # in motion, pick-up, later [mrad]
    known: str = '1'  # s
    is_chosen: bool = (
        False  # whether its gains leave MARGIN, instead of those of the preset
    )


_MOTOR: _Changes = {'sensor.side': 'motor'}


def _gears(stiffness: float, joints: int) -> _Changes:
    return {'joint.stiffness': [stiffness] * joints}


_TWICE: _Changes = {'feedback.stiffness': 2.0}
_UNKNOWN: _Changes = {'robot.torque_loop': False}
ARMS = {
    'ur5e': Arm('ur5e', 'UR5e', {}, {}, ('1.5', '5', '0.8')),
    'ur5e_motor': Arm(
        'ur5e',
        'UR5e, motor 1e4',
        {**_gears(1e4, 6), **_MOTOR},
        {},
        ('1.5', '5', '0.8'),
    ),
    'ur5e_twice': Arm(
        'ur5e', 'UR5e, twice as stiff', {}, _TWICE, ('0.8', '2.5', '0.5')
    ),
    'ur5e_motor_twice': Arm(
        'ur5e',
        'UR5e, motor 1e4, twice as stiff',
        {**_gears(1e4, 6), **_MOTOR},
        _TWICE,
        ('0.8', '2.5', '0.5'),
    ),
    'ur5e_soft': Arm(
        'ur5e',
        'UR5e, link 1e4',
        _gears(1e4, 6),
        {},
        ('1.5', '6', '1'),
        is_chosen=True,
    ),
    'panda': Arm('panda', 'Panda, 1e4', _gears(1e4, 7), {}, ('1', '8', '0.5'), '0.3'),
    'panda_no_loop': Arm(
        'panda',
        'Panda, 1e4, no torque loop',
        {**_gears(1e4, 7), **elastic.NO_LOOP, **_UNKNOWN},
        _UNKNOWN,
        ('-', '8', '1'),
        is_chosen=True,
    ),
    'fr3': Arm('fr3', 'FR3, direct', {}, {}, ('0.4', '1.5', '0.3'), '0.3'),
}


PLAY = 4e-4  # rad
_NONE = ('-', '-', '-')


def _resting(robot: str, label: str, joints: int, plant: _Changes) -> Arm:
    """Return an arm that holds its posture, in gears with play."""
    still: _Changes = {'reference.amplitude': [0.0] * (3 * joints)}
    play = {'joint.backlash': [PLAY] * joints}
    return Arm(robot, f'{label} at rest, play', {**plant, **play}, still, _NONE)


_REST = '_rest'
RESTING = {
    f'ur5e{_REST}': _resting('ur5e', 'UR5e', 6, {}),
    f'panda{_REST}': _resting('panda', 'Panda, 1e4', 7, _gears(1e4, 7)),
    f'fr3{_REST}': _resting('fr3', 'FR3', 7, {}),
}
ALL = {**ARMS, **RESTING}


class Figures(NamedTuple):
    """What becomes of an arm: errors [mrad]; NaN where it stops."""

    stop: str
    errors: list[float]  # in motion, at the pick-up, later, at the encoders
    links: list[float]  # likewise
    rms: float  # of the norm, later
    known: float  # s
    shaking: float  # of the torque limit: see `random_arms`
    is_softened: bool  # an oscillation was reported


@cache
def gains_of(name: str) -> _Changes:
    """Return the gains of this law on an arm, by the names of their parameters."""
    arm = ALL[name]
    if not arm.is_chosen:
        return arm.gains
    factor = random_arms.largest(
        FACTORS, lambda factor: own_margin(arm, factor) >= MARGIN
    )
    return {**arm.gains, 'feedback.stiffness': factor}


def own_margin(arm: Arm, factor: float) -> float:
    """Return the margin of this law with a factor on the gains of the preset."""
    loop = loop_with(arm, {**arm.gains, 'feedback.stiffness': factor})
    described = random_arms.describe(loop.controller, loop.plant, POSTURES)
    return described.margin(random_arms.own_feedback(loop.controller, described.M0))


def loop_with(arm: Arm, gains: _Changes, law: str = THIS, truth: int = 0) -> LoopConfig:
    """Return the loop of an arm with one of our own laws; `truth` is the seed of its links."""
    blind: _Changes = {'disturbance.observer_bandwidth': 0.0}
    own = Law(law, blind if law == NO_SENSORS else {}, law != NO_LEARNING)
    seeds = {'truth.seed': truth, 'seed': truth}
    preset = ROBOTS[arm.robot].preset
    return load_observer.loop_of(preset, own, {**arm.plant, **seeds}, gains)


def drawn(arm: Arm, number: int) -> _Changes:
    """Return what a true arm has instead of the arm of a row, beside its links."""
    plant = loop_with(arm, {}).plant
    seed = np.random.SeedSequence([number, len(plant.joints)])
    random = np.random.Generator(np.random.PCG64(seed))
    given = flatten(plant)
    changes: dict[str, object] = {}
    for name, most in SPREADS.items():
        factor = most ** random.uniform(-1.0, 1.0, len(plant.joints))
        changes[name] = (factor * np.array(given[name])).tolist()
    slowest, fastest = FALLS_OVER
    over = slowest * (fastest / slowest) ** random.uniform()
    return {
        **changes,
        'disturbance.stribeck': random.uniform(*FALLING),
        'disturbance.stribeck_velocity': float(over),
        'disturbance.load_share': random.uniform(*OF_LOAD),
    }


_Pair = tuple[float, float]  # of a DOB or RISE: factor, and pole in rad/s


class Equal(NamedTuple):
    """Gains of equal margin on an arm."""

    margin: float
    PD: float  # factor
    rate: float  # of computed torque, 1/s
    observers: tuple[_Pair, ...]
    integrals: tuple[_Pair, ...] = ()  # of RISE

    @property
    def DOB(self) -> _Pair:
        """The pair with the largest integral gain."""
        return max(self.observers, key=lambda pair: pair[0] * pair[1])

    @property
    def RISE(self) -> _Pair:
        """The pair with the largest integral gain."""
        return max(self.integrals, key=lambda pair: pair[0] * pair[1])


def dob(arm: Arm, M0: np.ndarray, factor: float, pole: float) -> Feedback:
    """Return the DOB at small errors."""
    robot = ROBOTS[arm.robot]
    one = np.broadcast_to(np.eye(len(robot.stiffness)), M0.shape)
    K = factor * np.array(robot.stiffness) * one
    D = factor * np.array(robot.damping) * one
    return random_arms.pid(K + pole * D, D + pole * M0, pole * K)


def rise(arm: Arm, M0: np.ndarray, factor: float, rate: float) -> Feedback:
    """Return RISE at errors of the amplitude SIGN: its sign is the half of the integral."""
    return dob(arm, 0.0 * M0, factor, rate)


def rise_gains(pair: _Pair) -> dict[str, float]:
    """Return the gains of RISE.

    A sign of a sine with amplitude A is 4 / (pi A) times this sine, and the amplitude of e2 is
    at low frequencies D^-1 K times that of the error.
    """
    factor, rate = pair
    half = 0.5 * rate
    sign = 0.25 * np.pi * half * SIGN
    return {'gains.scale': factor, 'gains.rate': half, 'gains.sign': float(sign)}


@cache
def equal(arm_name: str) -> Equal:
    """Return the gains with which rivals have the margin of this law, in motion."""
    arm = ALL[arm_name]
    loop = loop_with(arm, gains_of(arm_name))
    of = random_arms.describe(loop.controller, loop.plant, POSTURES)
    margin = of.margin(random_arms.own_feedback(loop.controller, of.M0))
    aim = max(margin, random_arms.LEAST)

    def rival(law: str) -> float:
        robot = ROBOTS[arm.robot]
        return random_arms.largest(
            RANGES[law],
            lambda factor: (
                of.margin(random_arms.rival_feedback(robot, of.M0, law, factor)) >= aim
            ),
        )

    factor = rival(PD)

    def pairs(feedback: Callable[..., Feedback]) -> tuple[_Pair, ...]:
        def pole(own: float) -> float:
            return random_arms.largest(
                POLES, lambda pole: of.margin(feedback(arm, of.M0, own, pole)) >= aim
            )

        return tuple((share * factor, pole(share * factor)) for share in SHARES)

    return Equal(margin, factor, rival(CT), pairs(dob), pairs(rise))


def law_of(
    config: ControllerConfig, name: str, law: str, pair: _Pair | None = None
) -> ControllerConfig:
    """Return the configuration of a controller with a rival; `pair` is that of a DOB."""
    gains, robot = equal(name.removesuffix(_REST)), ROBOTS[ALL[name].robot]
    if law == PD:
        return random_arms.rival(
            config, robot, random_arms.JOINT_PD, {'gains.scale': gains.PD}
        )
    if law == CT:
        own = random_arms.computed_torque_gains(gains.rate)
        return random_arms.rival(config, robot, COMPUTED_TORQUE, own)
    if law == RISE:
        return random_arms.rival(config, robot, ROBUST, rise_gains(gains.RISE))
    factor, pole = pair or gains.DOB
    own = {'gains.scale': factor, 'gains.bandwidth': pole}
    return random_arms.rival(config, robot, MOMENTUM, own)


def figures(
    name: str,
    law: str,
    truth: int,
    changes: _Changes | None = None,
    pair: _Pair | None = None,
    true: _Changes | None = None,
) -> Figures:
    """Run a law on an arm.

    `changes` of its gains, a DOB's `pair`, and what a `true` arm has instead, are optional.
    """
    arm = ALL[name]
    arm = arm._replace(plant={**arm.plant, **(true or {})})
    loop = loop_with(arm, {**gains_of(name), **(changes or {})}, law, truth)
    controller = loop.controller
    if law in RIVALS:
        controller = law_of(controller, name, law, pair)
    return outcome(controller, loop.plant, weighs=law in (THIS, NO_SENSORS))


def outcome(
    controller: ControllerConfig, plant: PlantConfig, *, weighs: bool
) -> Figures:
    """Run a controller on an arm; `weighs` is whether it is to weigh the load."""
    record = simulate(controller, plant)
    run = record.run()
    if run.stops:
        stop = run.stops[0]
        nothing = [np.nan] * 3
        text = f'{1e-9 * stop.stamp:.2f} s: {stop.text.partition(": ")[0]}'
        return Figures(
            text, nothing, nothing, np.nan, np.nan, np.nan, is_softened=False
        )
    error = np.asarray(run.error)
    late = error[run.time >= PICK_UP + LATER]
    return Figures(
        '',
        load_observer.largest(run.time, error),
        load_observer.largest(run.time, record.true_errors()),
        1e3 * float(np.sqrt((late**2).sum(axis=1).mean())),
        load_observer.known_after(record) if weighs else np.nan,
        random_arms.shaking_of(record),
        bool(run.oscillations),
    )


def laws_of(name: str) -> tuple[str, ...]:
    """Return the laws of the table on an arm."""
    observes = (
        loop_with(ALL[name], gains_of(name)).controller.disturbance.observer_bandwidth
        > 0.0
    )
    return (THIS, *((NO_SENSORS,) if observes else ()), NO_LEARNING, *RIVALS)


def row(name: str, law: str, found: list[Figures], others: list[Figures]) -> list[str]:
    """Return what becomes of some arms with a law; `others`, if any, are without learning."""
    heads = [ALL[name].label, law]
    holding = [each for each in found if not each.stop]
    fate = fate_of(found)
    if not holding:
        return [*heads, fate, *['-'] * 6]
    known = [each.known for each in holding if law == THIS]
    pairs = zip(found, others, strict=False)
    ratios = [b.rms / a.rms for a, b in pairs if not (a.stop or b.stop)]
    shaking = 100.0 * max(each.shaking for each in holding)
    return [
        *heads,
        *(spread(values) for values in np.transpose([e.errors for e in holding])),
        spread(known, unit=' s') if known and np.isfinite(known).all() else '-',
        spread([each.rms for each in holding]),
        spread(ratios, worst=min, digits='.2g') if ratios else '-',
        f'{shaking:.1f} %' + (f', {fate}' if fate else ''),
    ]


def rows_of(
    name: str, law: str, found: list[Figures], others: list[Figures]
) -> Iterator[list[str]]:
    """Compute that row, and where encoders are at the motors a second one for the links."""
    yield row(name, law, found, others)
    if 'sensor.side' in ALL[name].plant:
        at_links = [of._replace(errors=of.links, known=np.nan) for of in found]
        cells = row(name, f'{law}, links', at_links, others)
        yield [*cells[:5], *['-'] * 4]


def goal_row(name: str) -> list[str]:
    """Return what is aimed at on an arm."""
    arm = ALL[name]
    return [arm.label, 'goal', *arm.goal, f'{arm.known} s', '-', '8', '-']


def fate_of(found: Sequence[Figures]) -> str:
    """Return how many of some arms stop, and how many of the others oscillate."""
    stops = [each.stop for each in found if each.stop]
    softened = sum(each.is_softened for each in found)
    return ', '.join(
        f'{count} of {len(found)} {what}'
        for count, what in (
            (len(stops), f'stop, {stops[0]}' if stops else ''),
            (softened, 'oscillate'),
        )
        if count
    )


def spread(
    values: Sequence[float],
    worst: Callable[[Sequence[float]], float] = max,
    digits: str = '.2f',
    unit: str = '',
) -> str:
    """Return the median of values, and the worst of them if there are several."""
    middle = f'{np.median(values):{digits}}{unit}'
    return f'{middle} ({worst(values):{digits}})' if len(values) > 1 else middle


class Kept(Results[tuple[str, str, int], Figures]):
    """Figures by arm, law and number of the true arm, in a file if one is named."""

    def __init__(self, path: Path | None, *, links: bool = False) -> None:
        """Read those that the file has; with `links`, only these differ."""
        self.links = links
        super().__init__(
            path,
            lambda key: (key[0], key[1], key[2]),
            lambda values: Figures(*values),
        )

    def of(self, name: str, law: str, number: int) -> Figures:
        """Return the figures of a run, from the file or computed now."""

        def compute() -> Figures:
            true = {} if self.links else drawn(ALL[name], number)
            return figures(name, law, number, true=true)

        return self.get((name, law, number), compute)


def rows(
    name: str, truths: int, laws: Sequence[str], kept: Kept
) -> Iterator[list[str]]:
    """Compute the rows of an arm with some laws, that without learning first."""
    yield goal_row(name)
    asked = [each for each in laws_of(name) if each in laws]
    others: list[Figures] = []
    for law in sorted(asked, key=lambda each: each != NO_LEARNING):
        found = [kept.of(name, law, k) for k in range(1, truths + 1)]
        others = found if law == NO_LEARNING else others
        yield from rows_of(name, law, found, others)


INTEGRALS = (1.0, 2.0, 4.0, 8.0)  # on `disturbance.gain`
DAMPED = 3.0  # by the rule of `joint_gains.py`, which also bounds the integral's share


def integrator(name: str, truths: int) -> Iterator[list[str]]:
    """Compute the rows of an arm with multiples of its integral gain."""
    loop = loop_with(ALL[name], gains_of(name))
    usual = np.array(loop.controller.disturbance.gain)
    most = np.maximum(1.0, damped(loop, usual) / DAMPED)
    factors = {f'{factor:g}': factor + 0.0 * usual for factor in INTEGRALS}
    for label, factor in {**factors, 'by the rule': most}.items():
        gain = factor * usual
        changes = {'disturbance.gain': gain.tolist()}
        found = [figures(name, THIS, k, changes) for k in range(1, truths + 1)]
        cells = row(name, label, found, found)
        yield [*cells[:5], cells[8], f'{damped(loop, gain).min():.2g}']


def observers(name: str, truths: int) -> Iterator[list[str]]:
    """Compute the rows of an arm with the pairs of a DOB."""
    for pair in equal(name.removesuffix(_REST)).observers:
        found = [figures(name, DOB, k, pair=pair) for k in range(1, truths + 1)]
        cells = row(name, '{:.2g}, {:.2g} rad/s'.format(*pair), found, [])
        yield [*cells[:5], *cells[-1:]]


def damped(loop: LoopConfig, gain: np.ndarray) -> np.ndarray:
    """Return by which factor (n,) the slow oscillation is damped with an integral gain (n,)."""
    config, feedback = loop.controller, loop.controller.feedback
    robot, limits = config.robot, config.limits
    chain = robot.chain(config.joints)
    inertia = over_postures(
        chain,
        parameters_of(robot, chain),
        robot.payload,
        config.learning.initial_estimate,
        limits.position_lower,
        limits.position_upper,
    ).inertia
    motors = np.array(loop.plant.truth.rotor_inertia)
    inertia = inertia + motors - random_arms.guessed_rotors(config)
    damping = feedback.stiffness * np.array(feedback.joint_damping)
    return np.asarray(1.2 * damping**2 / (inertia * gain))


def gains_row(name: str) -> list[str]:
    """Return margin and gains of an arm."""
    of = equal(name.removesuffix(_REST))
    own = gains_of(name).get('feedback.stiffness', 1.0)
    return [
        ALL[name].label,
        f'{of.margin:.2f}',
        f'{own:.2g}',
        f'{of.PD:.2g}',
        f'{of.rate:.2g} 1/s',
        f'{of.DOB[0]:.2g}, {of.DOB[1]:.2g} rad/s',
        f'{of.RISE[0]:.2g}, {of.RISE[1]:.2g} 1/s',
    ]


HEADS = (
    *('arm', 'law', 'in motion', 'pick-up', 'later', 'weight known after'),
    *('rms with 2 kg', 'without learning, over it', 'shakes'),
)
_INTEGRATOR = (*HEADS[:1], 'factor', *HEADS[2:5], HEADS[8], 'damped')
_OBSERVERS = (*HEADS[:1], 'factor and pole', *HEADS[2:5], HEADS[8])
_GAINS = ('arm', 'margin', 'this law, factor', *RIVALS)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    tables = 'goals', 'integrator', 'observers'
    parser.add_argument('table', nargs='?', choices=tables, default='goals')
    about = 'arms of each kind (5)'
    parser.add_argument('--truths', type=positive, default=5, help=about)
    parser.add_argument('--arms', nargs='+', choices=ALL, default=list(ARMS))
    parser.add_argument('--laws', nargs='+', choices=LAWS, default=list(LAWS))
    about = 'true arms differ from the assumed ones in their links alone'
    parser.add_argument('--links', action='store_true', help=about)
    parser.add_argument('--keep', type=Path, help='file of the runs that are made')


def main(given: argparse.Namespace) -> None:
    """Print the table that was asked for; beside the goals, the gains."""
    if given.table == 'integrator':
        of_arms = (integrator(name, given.truths) for name in given.arms)
        print_table(_INTEGRATOR, itertools.chain.from_iterable(of_arms))
        return
    if given.table == 'observers':
        of_arms = (observers(name, given.truths) for name in given.arms)
        print_table(_OBSERVERS, itertools.chain.from_iterable(of_arms))
        return
    print_table(_GAINS, map(gains_row, given.arms))
    print()
    kept = Kept(given.keep, links=given.links)
    of_arms = (rows(name, given.truths, given.laws, kept) for name in given.arms)
    print_table(HEADS, itertools.chain.from_iterable(of_arms))
