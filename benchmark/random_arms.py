# SPDX-License-Identifier: Apache-2.0
"""Random arms with elastic joints: this law and its rivals on the same ones.

    python -m benchmark random-arms margins
    python -m benchmark random-arms arms [N] [--robots NAME...] [--draws DRAW...] [--keep FILE]

Arms are drawn independently of what the controller assumes: each pairs one draw with all
laws, the same noise and the same torque limits.  It runs the motion of its preset under the
guard and picks up the load of its study at 6 s.

    study    the distributions of `monte_carlo_elastic_*`, around what is known of the robot
    wide     beyond them: any gears and table, encoders on either side of the gears, drives with
             and without a torque loop, and rotors of 0.2 to 7 times the controller's guess

The laws, of which only this one has a bound and learns:

    this law           the preset as it is
    stock PD           stiffness and damping that the maker publishes, over gravity
    PD                 the same times a factor
    computed torque    with an integral, through the inertia matrix of the URDF

The last two have the largest factor, and the largest rate w (w^2, 2 w, w^3 / 6), with which the
linear loop has the modulus margin of this law: on the arm in the middle of the distributions of
the study, the least of postures along its motion, with and without the load.  Where this law
has less than 0.1 there, dry friction holds it, and the rivals have 0.1.

An arm is plausible if the stock PD holds on it: no stop, no oscillation reported, and no joint
that shakes (rms of the torque above 8 Hz in any second from 3 s on beyond 5 % of its limit).
`--keep` appends each run to a file, from which the same command goes on.
"""

from __future__ import annotations

import argparse
import itertools
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmark.harness import print_table
from benchmark.kept import Results
from benchmark.studies import FREE, load_study
from blf_dsc_controller.arms.linear_loop import (
    Feedback,
    Joints,
    Loop,
    Timing,
    TorqueLoop,
)
from blf_dsc_controller.arms.model import inertia_matrices
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import load_loop
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.robot import parameters_of
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.factory.settings import settings_of_config
from blf_dsc_controller.law.samples import sample_columns
from blf_dsc_controller.reference.approach import reference_of
from blf_dsc_controller.reference.terms import sampled
from blf_dsc_controller.simulation.loop import Record, simulate
from blf_dsc_controller.studies.distributions import parse
from blf_dsc_controller.studies.laws import COMPUTED_TORQUE
from blf_dsc_controller.studies.monte_carlo import Study, draw, plant_with
from blf_dsc_controller.studies.variations import Variation
from blf_dsc_controller.warnings.expected_errors import linear_feedback

SECONDS = 11.0
BEGIN, PICK_UP, SETTLED = 3.0, 6.0, 9.0  # s
AFTER_STOP = 1.5  # s, for which a stop is followed
AT_REST = 1.0  # s, after which it should be
SLOWEST = 8.0  # Hz, of what shakes
SHAKES = 0.05  # of the torque limit, rms

JOINT_PD = str(Path(__file__).with_name('joint_pd.py').resolve())
THIS, STOCK, PD, CT = 'this law', 'stock PD', 'PD', 'computed torque'
LAWS = (THIS, STOCK, PD, CT)
BLIND = 'this law without its load observer'


class Robot(NamedTuple):
    """A preset, its study, and the gains that are published for it."""

    preset: str
    study: str
    stiffness: tuple[float, ...]  # N m/rad
    damping: tuple[float, ...]  # N m s/rad
    gears: tuple[float, float]  # N m/rad, of the wide draw


# Of the makers' position controllers: stiffness and damping of each joint.
_FRANKA = (600.0,) * 4 + (250.0, 150.0, 50.0), (30.0,) * 4 + (10.0, 10.0, 5.0)
_UR = (900.0,) * 3 + (500.0,) * 3, (60.0,) * 3 + (44.7,) * 3
_LEROBOT = (  # config_openarm_follower.py of 27de2ca
    (240.0, 240.0, 240.0, 240.0, 24.0, 31.0, 25.0),
    (5.0, 5.0, 3.0, 5.0, 0.3, 0.3, 0.3),
)
ROBOTS = {
    'panda': Robot('panda', 'monte_carlo_elastic_panda', *_FRANKA, (5e3, 1e5)),
    'fr3': Robot('fr3_direct', 'monte_carlo_elastic_fr3', *_FRANKA, (5e3, 1e5)),
    'ur5e': Robot('ur5e', 'monte_carlo_elastic_ur5e', *_UR, (5e3, 1e5)),
    'openarm': Robot('openarm', 'monte_carlo_elastic_openarm', *_LEROBOT, (3e2, 2e4)),
}

DRAWS = 'study', 'wide'
PERIOD = 5.0  # s, of the motions
POSTURES = 6
ROTORS = 0.2, 7.0  # times the guess
LOOP_GAIN, LOOP_DAMPING = 4.0, 0.008  # of a torque loop, s


def study_of(name: str, drawn: str = 'study') -> Study:
    """Return the study of a robot, with its own or with wide distributions."""
    robot = ROBOTS[name]
    study = load_study(robot.study)
    times = {'duration': SECONDS, 'events.begin': [PICK_UP]}
    study = replace(study, plant=change(study.plant, times))
    return study if drawn == 'study' else _widened(study, robot)


def _widened(study: Study, robot: Robot) -> Study:
    """Return a study whose gears, encoders, drives, rotors and table may be any."""
    n = len(study.controller.joints)
    guess = guessed_rotors(study.controller)
    softest, stiffest = robot.gears
    given: dict[str, str | list[str]] = {
        'joint.stiffness': [f'loguniform({softest}, {stiffest})'] * n,
        'truth.rotor_inertia': [
            f'loguniform({ROTORS[0] * each}, {ROTORS[-1] * each})' for each in guess
        ],
        'sensor.side': 'choice(link, motor)',
        'actuator.loop_gain': f'choice(0.0, {LOOP_GAIN})',
        'base.mass': 'choice(0.0, 60.0, 150.0)',
        'base.frequency': 'uniform(8.0, 16.0)',
    }
    kept = [each for each in study.variations if each.name not in given]
    for parameter, texts in given.items():
        kind = str if parameter == 'sensor.side' else float
        if isinstance(texts, str):
            column = f'plant.{parameter}'
            kept.append(Variation(parameter, -1, column, parse(texts, kind)))
            continue
        for i, text in enumerate(texts):
            column = f'plant.{parameter}.{study.plant.joints[i]}'
            kept.append(Variation(parameter, i, column, parse(text, kind)))
    without = change(study.plant, {'actuator.loop_damping': 0.0})
    return replace(study, plant=without, variations=tuple(kept))


def guessed_rotors(config: ControllerConfig) -> np.ndarray:
    """Return the inertias of the drives (n,) [kg m^2] that a controller assumes."""
    return np.asarray(config.robot.rotors(config.robot.chain(config.joints)))


def arm_of(study: Study, number: int) -> PlantConfig:
    """Return a random arm, the same for every law."""
    plant = plant_with(study, draw(study, number))
    damping = LOOP_DAMPING if plant.actuator.loop_gain else 0.0
    return replace(plant, actuator=replace(plant.actuator, loop_damping=damping))


class Described(NamedTuple):
    """The linear arm by whose margin the rivals are scaled."""

    links: np.ndarray  # (k, n, n) kg m^2, without and with the rated payload
    M0: np.ndarray  # (k, n, n) kg m^2, of the controller
    joints: Joints
    timing: Timing

    def margin(self, feedback: Feedback) -> float:
        """Return the modulus margin of a law."""
        return Loop(self.links, self.joints, self.timing, feedback).margin().value


@cache
def described(name: str) -> Described:
    """Return the arm in the middle of the distributions of a study, along its motion."""
    study = study_of(name)
    middle = {each.column: each.distribution.at(0.5) for each in study.variations}
    plant = plant_with(study, {'seed': 0, **middle})
    return describe(study.controller, plant, POSTURES)


def describe(config: ControllerConfig, plant: PlantConfig, postures: int) -> Described:
    """Return an arm along the motion of its controller, without and with its load."""
    actuator = plant.actuator
    loop = TorqueLoop(actuator.loop_gain, actuator.loop_damping, actuator.loop_lag)
    joints = Joints(
        motors=np.array(plant.truth.rotor_inertia),
        viscous=np.array(plant.disturbance.viscous),
        stiffness=np.array(plant.joint.stiffness),
        damping_ratio=plant.joint.damping_ratio,
        torque_loop=loop if actuator.loop_gain else None,
        motor_side=plant.sensor.side == 'motor',
    )
    chain = config.robot.chain(config.joints)
    base = parameters_of(config.robot, chain)
    q = sampled(reference_of(config), np.linspace(0.0, PERIOD, postures))[:, 0]
    P = base.of(chain.inertias, np.zeros(len(config.joints)))
    loads = 0.0, max(plant.events.payload)
    links = [inertia_matrices(base.model, P + load * base.load, q) for load in loads]
    M0 = links[0] + np.diag(guessed_rotors(config))
    timing = Timing(
        config.sample_time,
        actuator.delay,
        actuator.time_constant,
        1.0 / plant.sensor.velocity_pole,
    )
    return Described(np.concatenate(links), np.tile(M0, (2, 1, 1)), joints, timing)


def feedback_of(name: str, law: str, factor: float = 1.0) -> Feedback:
    """Return a law at small errors; `factor` is that of the PD, or w [1/s]."""
    robot, M0 = ROBOTS[name], described(name).M0
    if law == THIS:
        return own_feedback(load_loop(robot.preset).controller, M0)
    return rival_feedback(robot, M0, law, factor)


def own_feedback(config: ControllerConfig, M0: np.ndarray) -> Feedback:
    """Return this law at small errors, without its load observer."""
    settings = settings_of_config(config)
    return linear_feedback(settings, M0, settings.barrier.weight)


def rival_feedback(robot: Robot, M0: np.ndarray, law: str, factor: float) -> Feedback:
    """Return a rival at small errors; `factor` is that of the PD, or w [1/s]."""
    if law != CT:
        one = np.broadcast_to(np.eye(len(robot.stiffness)), M0.shape)
        K, D = factor * np.array(robot.stiffness), factor * np.array(robot.damping)
        return pid(K * one, D * one, _WEAK * K * one)
    P, D, I = (M0 * each for each in computed_torque_gains(factor).values())
    return pid(P, D, I)


_WEAK = 1e-3  # 1/s, an integral that does nothing but decay
_PID = ('position', 'velocity', 'integral')


def pid(P: np.ndarray, D: np.ndarray, I: np.ndarray, rate: float = 1.0) -> Feedback:
    """Return tau = - P y - D v - I int y (k, n, n) in the terms of `Feedback`, at any `rate`.

    There xi2 = v + rate y, so that D and its integral I / rate add to P.
    """
    return Feedback(
        position=P - rate * D - I / rate,
        surface=D,
        inertia=0.0 * D,
        integral=I / rate,
        rate=np.full(P.shape[-1], rate),
        time_constant=1e-6,
        known_rate=True,
    )


def computed_torque_gains(rate: float) -> dict[str, float]:
    """Return the gains of computed torque of a rate [1/s], in its usual proportions."""
    gains = rate**2, 2.0 * rate, rate**3 / 6.0
    return {f'gains.{name}': gain for name, gain in zip(_PID, gains, strict=True)}


RANGES = {PD: (0.05, 5.0), CT: (1.0, 100.0)}
_BISECTIONS = 9
LEAST = 0.1
"""Margin of the rivals where this law has less."""


@cache
def factor_of(name: str, law: str) -> float:
    """Return the largest factor of a rival that leaves it the margin of this law."""
    if law in (THIS, STOCK):
        return 1.0
    arm = described(name)
    aim = max(arm.margin(feedback_of(name, THIS)), LEAST)
    return largest(
        RANGES[law], lambda factor: arm.margin(feedback_of(name, law, factor)) >= aim
    )


def largest(within: tuple[float, float], holds: Callable[[float], bool]) -> float:
    """Return the largest number for which something holds, by bisection of its logarithm."""
    low, high = within
    for _ in range(_BISECTIONS):
        middle = math.sqrt(low * high)
        if holds(middle):
            low = middle
        else:
            high = middle
    return low


def law_of(config: ControllerConfig, name: str, law: str) -> ControllerConfig:
    """Return the configuration of a controller with a law."""
    if law == THIS:
        return config
    if law == BLIND:
        return change(config, {'disturbance.observer_bandwidth': 0.0})
    factor = factor_of(name, law)
    if law == CT:
        return rival(
            config, ROBOTS[name], COMPUTED_TORQUE, computed_torque_gains(factor)
        )
    return rival(config, ROBOTS[name], JOINT_PD, {'gains.scale': factor})


def rival(
    config: ControllerConfig, robot: Robot, law: str, gains: Mapping[str, object]
) -> ControllerConfig:
    """Return the configuration with the law of a file; of this law nothing is left."""
    n = len(config.joints)
    changes: dict[str, object] = {
        'law': law,
        'barrier.bound': [FREE] * n,
        'feedback.joint_stiffness': list(robot.stiffness),
        'feedback.joint_damping': list(robot.damping),
        'feedback.stiffness': 1.0,
        'disturbance.observer_bandwidth': 0.0,
        'learning.enabled': False,
    }
    return change(change(config, changes), gains)


class Result(NamedTuple):
    """What becomes of an arm: NaN where it does not come to it."""

    stopped: float  # s
    text: str  # of the stop, or of the first oscillation
    reports: int  # of oscillations
    shaking: float  # of the torque limit, rms above 8 Hz in the worst second
    motion: float  # rad, largest error of a link from 3 s on
    pick_up: float  # rad, likewise from 6 s on
    settled: float  # rad, likewise from 9 s on
    ratio: float  # of the largest error to the bound of the preset
    faster: float  # fastest link after the stop, rad/s
    before: float  # fastest link until then, rad/s
    left: float  # fastest link from 1 s after the stop on, rad/s

    @property
    def holds(self) -> bool:
        """Whether it works without stopping or shaking."""
        return np.isnan(self.stopped) and not self.oscillates

    @property
    def oscillates(self) -> bool:
        """Whether it shakes, or was reported to, until it stops if it does."""
        return self.reports > 0 or bool(self.shaking > SHAKES)


def run(config: ControllerConfig, plant: PlantConfig, bound: np.ndarray) -> Result:
    """Run a law on an arm; `bound` (n,) [rad] is that of the preset."""
    with np.errstate(all='ignore'):
        record = simulate(config, plant, after_stop=AFTER_STOP)
        return result_of(record, bound)


def result_of(record: Record, bound: np.ndarray) -> Result:
    """Return the figures of a run."""
    found = record.run()
    n = bound.size
    t = 1e-9 * record.stamps
    stop = found.stops[0] if found.stops else None
    end = 1e-9 * stop.stamp if stop else np.inf
    error = np.abs(record.true_errors())
    running = t < end
    ratio = float((error[running] / bound).max(initial=0.0))

    def largest(begin: float, last: float) -> float:
        chosen = (t >= begin) & (t < last)
        return float(error[chosen].max()) if last <= end else np.nan

    texts = [each.text for each in (found.stops or found.oscillations)]
    speed = np.abs(record.truths[:, -n:]).max(axis=1)
    alone = (t < PICK_UP) | (end >= PICK_UP)  # a load moves an arm that has stopped
    after, late = (t >= end) & alone, (t >= end + AT_REST) & alone
    return Result(
        stopped=end if stop else np.nan,
        text=texts[0] if texts else '',
        reports=len(found.oscillations),
        shaking=shaking_of(record, end),
        motion=largest(BEGIN, PICK_UP),
        pick_up=largest(PICK_UP, SETTLED),
        settled=largest(SETTLED, SECONDS),
        ratio=ratio,
        faster=float(speed[after].max()) if after.any() else np.nan,
        before=float(speed[running].max(initial=0.0)),
        left=float(speed[late].max()) if late.any() else np.nan,
    )


def shaking_of(record: Record, end: float = math.inf) -> float:
    """Return how much torques shake from 3 s on, and before `end` [s], of their limits."""
    settings = record.controller.settings
    t = 1e-9 * record.stamps
    torque = sample_columns(record.samples, settings).torque
    chosen = torque[(t >= BEGIN) & (t < end)]
    return shaken(chosen / settings.torque.limit, record.config.sample_time)


def shaken(values: np.ndarray, T: float) -> float:
    """Return the largest rms of values (k, n), T [s] apart, above 8 Hz in a second."""
    size = round(1.0 / T)
    decay = 1.0 - np.exp(-2.0 * np.pi * SLOWEST * T)
    slow = values[:1].copy() if len(values) else values
    fast = np.zeros_like(values)
    for k, value in enumerate(values):
        slow = slow + decay * (value - slow)
        fast[k] = value - slow
    seconds = [fast[k : k + size] for k in range(0, len(fast) - size + 1, size)]
    each = [np.sqrt((part**2).mean(axis=0)).max() for part in seconds]
    return float(max(each, default=0.0))


class Key(NamedTuple):
    """Which run it is."""

    robot: str
    draw: str
    number: int
    law: str


class Kept(Results[Key, Result]):
    """Results by run, kept in a file if one is named."""

    def __init__(self, path: Path | None) -> None:
        """Read those that the file has."""
        super().__init__(path, lambda key: Key(*key), lambda value: Result(*value))

    def of(self, key: Key, study: Study) -> Result:
        """Return the result of a run, from the file or computed now."""

        def compute() -> Result:
            controller = law_of(study.controller, key.robot, key.law)
            bound = np.array(study.controller.barrier.bound)
            return run(controller, arm_of(study, key.number), bound)

        return self.get(key, compute)


def arms(
    runs: int, robots: Sequence[str], draws: Sequence[str], kept: Kept
) -> Iterator[list[str]]:
    """Compute the rows: each law on the arms of each draw, plausible ones and the rest."""
    for drawn, name in itertools.product(draws, robots):
        study = study_of(name, drawn)
        results = [
            {law: kept.of(Key(name, drawn, number, law), study) for law in LAWS}
            for number in range(runs)
        ]
        for label, plausible in (('plausible', True), ('rest', False)):
            chosen = [each for each in results if each[STOCK].holds == plausible]
            for law in LAWS if chosen else ():
                yield [name, f'{drawn}, {label}', *row(chosen, law)]


def row(arms: Sequence[Mapping[str, Result]], law: str) -> list[str]:
    """Return what becomes of some arms with a law.

    Errors are those of the arms on which it holds.
    """
    found = [each[law] for each in arms]
    stopped = [each for each in found if not np.isnan(each.stopped)]
    holding = [each for each in found if each.holds]
    shaking = sum(each.oscillates and np.isnan(each.stopped) for each in found)
    kept = sum(np.isnan(each.stopped) and each.ratio < 1.0 for each in found)
    spans = zip(*((e.motion, e.pick_up, e.settled) for e in holding), strict=True)
    errors = [f'{1e3 * np.median(each):.2g} ({1e3 * max(each):.2g})' for each in spans]
    return [
        law,
        f'{len(holding)} of {len(found)}',
        f'{shaking}',
        f'{len(stopped)}',
        f'{kept}',
        *(errors or ['-'] * 3),
    ]


def stops(kept: Kept) -> Iterator[list[str]]:
    """Compute the rows of stops of this law: why, and whether the arm comes to rest."""
    groups: dict[tuple[str, str], list[Result]] = {}
    for key, result in kept.results.items():
        if key.law == THIS and not np.isnan(result.stopped):
            groups.setdefault((key.robot, key.draw), []).append(result)
    for (name, drawn), found in sorted(groups.items()):
        named = sum('oscillat' in each.text for each in found)
        faster = sum(each.faster > 1.1 * each.before for each in found)
        left = max(each.left for each in found)
        reasons = Counter(_kind(each.text) for each in found)
        common = ', '.join(f'{text} ({k})' for text, k in reasons.most_common(3))
        counts = f'{len(found)}', f'{named}', f'{faster}', f'{left:.2g}'
        yield [name, drawn, *counts, common]


def failures(kept: Kept) -> Iterator[list[str]]:
    """Compute the rows of plausible arms on which this law does not hold."""
    for key, result in sorted(kept.results.items()):
        stock = kept.results.get(key._replace(law=STOCK))
        if key.law != THIS or result.holds or stock is None or not stock.holds:
            continue
        study = study_of(key.robot, key.draw)
        plant = arm_of(study, key.number)
        blind = '-'
        if study.controller.disturbance.observer_bandwidth > 0.0:
            blind = _briefly(kept.of(key._replace(law=BLIND), study))
        yield [
            key.robot,
            f'{key.draw}, {key.number}',
            plant.sensor.side,
            'yes' if plant.actuator.loop_gain else 'no',
            _briefly(result),
            result.text.partition(': ')[0],
            blind,
        ]


def _briefly(result: Result) -> str:
    """Return what becomes of an arm, in a few words."""
    if not np.isnan(result.stopped):
        return f'stops at {result.stopped:.2f} s'
    return 'oscillates' if result.oscillates else 'holds'


def _kind(text: str) -> str:
    """Return a message without its numbers and joints."""
    return ' '.join(
        word for word in text.split(':', maxsplit=1)[0].split() if word.isalpha()
    )


def margins() -> Iterator[list[str]]:
    """Compute the rows of the modulus margins, and the gains that follow."""
    for name in ROBOTS:
        arm = described(name)
        values = [
            arm.margin(feedback_of(name, law, factor_of(name, law))) for law in LAWS
        ]
        cells = [f'{each:.2f}' for each in values]
        factors = f'{factor_of(name, PD):.2g}', f'{factor_of(name, CT):.2g} 1/s'
        yield [name, *cells, *factors]


_ERRORS = tuple(f'{each} [mrad]' for each in ('motion', 'pick-up', 'settled'))
HEADS = {
    'margins': ('robot', *LAWS, 'factor of PD', 'w of computed torque'),
    'arms': (
        'robot',
        'arms',
        'law',
        'hold',
        'shake',
        'stop',
        'keep the bound',
        *_ERRORS,
    ),
    'stops': (
        'robot',
        'arms',
        'stops',
        'name an oscillation',
        'faster than before',
        'left after 1 s [rad/s]',
        'why',
    ),
    'failures': ('robot', 'arm', 'encoders', 'torque loop', 'this law', 'why', BLIND),
}


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument('table', choices=('margins', 'arms'))
    parser.add_argument('runs', type=int, nargs='?', default=1000, help='arms of each')
    parser.add_argument('--robots', nargs='+', choices=ROBOTS, default=list(ROBOTS))
    parser.add_argument('--draws', nargs='+', choices=DRAWS, default=list(DRAWS))
    parser.add_argument('--keep', type=Path, help='file of the runs that are made')


def main(given: argparse.Namespace) -> None:
    """Print the table that was asked for."""
    if given.table == 'margins':
        print_table(HEADS['margins'], margins())
        return
    kept = Kept(given.keep)
    print_table(HEADS['arms'], arms(given.runs, given.robots, given.draws, kept))
    for name, rows in (('stops', stops), ('failures', failures)):
        print()
        print_table(HEADS[name], rows(kept))
