# SPDX-License-Identifier: Apache-2.0
"""Changes and weights that are not there: arms, motions and friction unlike those of the law.

    python -m benchmark nothing-changes [--runs 24] [--arms panda ur5e ...] [--each]

Links are up to 30 % heavier or lighter than the URDF's.  Friction is drawn for each joint, 0.2 to
1.8 times what the law assumes, with up to 0.7 more at low speed, which fades over 0.02 to 0.2
rad/s.  The rigid FR3 has no torque loop, and efforts with friction, as its law is told.
The motions are those that people have, with rests:

    trapezoids  from posture to posture, with trapezoidal velocities
    pick        pick and place, by way of postures above, the same ones in every cycle
    jogging     one joint at a time, at constant speed
    insertion   fast between postures, and then 5 to 30 mrad/s for seconds

Each run is made twice: with an empty hand and nothing that changes, and with one load of 2 kg
that is picked up half-way.  Of some arms alone, the runs are those that the whole table has of
them.  A reading is what the law says it holds, each tenth of a second where
it says something; it is outside if its 95 % interval does not hold the truth.  *Certain* are
readings to 5 % (50 g), which `load.tell_drive` declares.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np

from benchmark.harness import print_table
from benchmark.options import add_arms
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import (
    CONTROLLER,
    PLANT,
    LoopConfig,
    load_loop,
)
from blf_dsc_controller.factory.controller import begin, controller_of
from blf_dsc_controller.law.samples import sample_columns
from blf_dsc_controller.law.weighing import DEVIATION, MASS
from blf_dsc_controller.messages.journal import Journal
from blf_dsc_controller.progress import print_notice
from blf_dsc_controller.reference.retargeting import TrajectoryError
from blf_dsc_controller.reference.trajectory import (
    Trajectory,
    TrajectoryPoint,
    plan_trajectory,
)
from blf_dsc_controller.run import Floats
from blf_dsc_controller.simulation.compiled_loop import CompiledLoop, Span
from blf_dsc_controller.simulation.loop import Record, new_record
from blf_dsc_controller.supervision.drive_load import widest_interval
from sim_plant.plant import plant_of

ARMS = ('panda', 'ur5e', 'fr3', 'panda_rigid', 'ur5e_rigid', 'fr3_rigid')
RIGID = {'fr3_rigid': 'fr3'}
DURATION, PICK_UP, RAMP = 32.0, 16.0, 0.2  # s
LOAD = 2.0  # kg
READINGS = 0.1  # s
SETTLED = 1.0  # s after the pick-up: readings before are of both
WRONG = 0.1  # kg
FRICTION = (0.2, 1.8)  # times the assumed one
STRIBECK = (0.0, 0.7)
STRIBECK_SPEED = (0.02, 0.2)  # rad/s
RANGE = 0.6  # rad, of postures about that of the preset

Waypoints = Iterator[tuple[float, Floats, Floats]]
"""Seconds since the point before, position and velocity of each."""


TIME, HELD, WEIGHED, INTERVAL = range(4)
"""Columns of readings: when, what is held, the mass found, and half of its interval."""


class Found(NamedTuple):
    """What a run says; a reading has the truth beside it."""

    changes: Floats  # s
    contacts: int
    readings: Floats  # (k, 4): TIME [s], HELD, WEIGHED and half INTERVAL [kg]


def moved(q: Floats, goal: Floats, speed: float) -> Waypoints:
    """Yield the points of a motion to `goal` with trapezoidal velocities."""
    way = goal - q
    longest = float(np.abs(way).max())
    seconds = longest / speed
    ramp = min(0.25, seconds)
    velocity = way / seconds
    yield ramp, q + 0.5 * ramp * velocity, velocity
    if seconds > ramp:
        yield seconds - ramp, goal - 0.5 * ramp * velocity, velocity
    yield ramp, goal, 0.0 * velocity


def rested(q: Floats, seconds: float) -> Waypoints:
    """Yield the end of a rest."""
    yield seconds, q, 0.0 * q


def trapezoids(random: np.random.Generator, home: Floats) -> Waypoints:
    """Yield motions between random postures."""
    q = home
    while True:
        goal = home + random.uniform(-RANGE, RANGE, home.size)
        yield from moved(q, goal, random.uniform(0.2, 1.0))
        q = goal
        yield from rested(q, random.uniform(0.2, 2.0))


def pick(random: np.random.Generator, home: Floats) -> Waypoints:
    """Yield cycles of pick and place: down and up at two places, with short rests."""
    above = home + random.uniform(-RANGE, RANGE, (2, home.size))
    below = above + random.uniform(-0.25, 0.25, (2, home.size))
    fast, slow = random.uniform(0.5, 1.0), random.uniform(0.1, 0.3)
    wait = random.uniform(0.2, 1.0)
    q = home
    while True:
        for place in range(2):
            for goal, speed in (
                (above[place], fast),
                (below[place], slow),
                (above[place], slow),
            ):
                yield from moved(q, goal, speed)
                q = goal
                yield from rested(q, wait)


def jogging(random: np.random.Generator, home: Floats) -> Waypoints:
    """Yield motions of one joint at a time."""
    q = home
    while True:
        goal = q.copy()
        joint = random.integers(home.size)
        goal[joint] = home[joint] + random.uniform(-RANGE, RANGE)
        yield from moved(q, goal, random.uniform(0.05, 0.5))
        q = goal
        yield from rested(q, random.uniform(0.3, 2.0))


def insertion(random: np.random.Generator, home: Floats) -> Waypoints:
    """Yield fast motions to a posture, and slow ones from there and back."""
    q = home
    while True:
        goal = home + random.uniform(-RANGE, RANGE, home.size)
        yield from moved(q, goal, random.uniform(0.3, 0.8))
        speed, seconds = random.uniform(0.005, 0.03), random.uniform(2.0, 4.0)
        inside = goal + speed * seconds * random.uniform(-1.0, 1.0, home.size)
        for q, end, rate in ((goal, inside, speed), (inside, goal, 4.0 * speed)):
            yield from rested(q, random.uniform(0.3, 1.0))
            yield from moved(q, end, rate)
        q = goal
        yield from rested(q, random.uniform(0.3, 1.0))


MOTIONS: dict[str, Callable[[np.random.Generator, Floats], Waypoints]] = {
    'trapezoids': trapezoids,
    'pick': pick,
    'jogging': jogging,
    'insertion': insertion,
}


def trajectory_of(config: ControllerConfig, motion: str, seed: int) -> Trajectory:
    """Return a motion about the centre of a preset's reference, to the end of a run."""
    random = np.random.default_rng(seed)
    n = len(config.joints)
    time = 2.0
    home = np.array(config.reference.offset)
    points = [TrajectoryPoint(time, tuple(home), (0.0,) * n)]
    for seconds, q, dq in MOTIONS[motion](random, home):
        time += seconds
        points.append(TrajectoryPoint(time, tuple(q), tuple(dq)))
        if time > DURATION:
            return Trajectory(config.joints, tuple(points), 0.0)
    raise AssertionError


def loop_of(arm: str, seed: int, load: float, **more: Any) -> LoopConfig:
    """Return an arm with links and friction of its own, and `more` of `disturbance`."""
    random = np.random.default_rng(seed)
    preset = RIGID.get(arm, arm)
    usual = load_loop(preset).plant.disturbance

    def varied(values: tuple[float, ...]) -> list[float]:
        factors = random.uniform(*FRICTION, len(values))
        return [float(each) for each in factors * values]

    held = [load] if load else []
    plant: dict[str, Any] = {
        'duration': DURATION,
        'seed': seed,
        'truth.seed': 1000 + seed,
        'truth.mass_deviation': 0.3,
        'truth.centre_deviation': 0.01,
        'disturbance.viscous': varied(usual.viscous),
        'disturbance.coulomb': varied(usual.coulomb),
        'disturbance.stribeck': float(random.uniform(*STRIBECK)),
        'disturbance.stribeck_velocity': float(
            np.exp(random.uniform(*np.log(STRIBECK_SPEED)))
        ),
        'sensor.incomplete_states': 0,
        'events.begin': [PICK_UP] * len(held),
        'events.duration': [0.0] * len(held),
        'events.ramp': [RAMP] * len(held),
        'events.payload': held,
    }
    plant |= {f'disturbance.{name}': value for name, value in more.items()}
    controller: dict[str, Any] = {'contact.enabled': True}
    if arm in RIGID:
        plant['joint.stiffness'] = []
        plant |= {'actuator.loop_gain': 0.0, 'actuator.loop_damping': 0.0}
        controller |= {
            'robot.torque_loop': False,
            'robot.viscous': list(usual.viscous),
            'robot.coulomb': list(usual.coulomb),
        }
    return load_loop(preset, {PLANT: plant, CONTROLLER: controller})


def recorded(loop: LoopConfig, motion: str, seed: int) -> Record:
    """Run the law along a motion, or that of the preset, without supervision."""
    config = loop.controller
    if motion in MOTIONS:
        holding = dataclasses.replace(config.reference, type='hold')
        config = dataclasses.replace(config, reference=holding)
    record = new_record(controller_of(config), config, loop.plant, Journal())
    plant = plant_of(loop.plant)
    controller = record.controller
    begin(controller, config, *plant.measure().reshape(3, -1)[:2])
    if motion in MOTIONS:
        trajectory = trajectory_of(config, motion, seed)
        planned = plan_trajectory(trajectory, controller.reference_vector, 0.0, config)
        controller.reference_vector = planned.vector
    span = Span(0, record.stamps.size - 1, is_end=True, observed=True)
    CompiledLoop(controller, plant).run(span, record.rows_to_fill())
    return record


def found(record: Record, load: float) -> Found:
    """Return what a run says."""
    samples = sample_columns(record.samples, record.controller.settings)
    t = record.stamps * 1e-9
    changes = t[1:][np.diff(samples.changes[:, 0]) > 0.0]
    touched = samples.contact[:, 0]
    every = max(1, round(READINGS / record.config.sample_time))
    mass, half = samples.load[::every, [MASS, DEVIATION]].T
    times = t[::every]
    truth = np.where(times < PICK_UP, 0.0, load)
    clear = (times < PICK_UP) | (times > PICK_UP + SETTLED) | (load == 0.0)
    known = clear & np.isfinite(mass)
    readings = np.stack((times, truth, mass, half), axis=1)[known]
    return Found(changes, int(np.sum(np.diff(touched) > 0.5)), readings)


def outside(readings: Floats) -> Floats:
    """Return which readings (k, 4) have an interval (k,) that does not hold the truth."""
    return np.asarray(
        np.abs(readings[:, WEIGHED] - readings[:, HELD]) > readings[:, INTERVAL]
    )


def certain(readings: Floats) -> Floats:
    """Return which readings (k, 4) have an interval (k,) narrow enough to be declared."""
    return np.asarray(readings[:, INTERVAL] < widest_interval(readings[:, WEIGHED]))


class Pair(NamedTuple):
    """An arm with a motion, twice: empty, and with a load half-way."""

    arm: str
    motion: str
    seed: int
    empty: Found
    loaded: Found


def pairs(arms: Iterable[str], runs: int) -> Iterator[Pair]:
    """Yield those of so many pairs that are of the `arms`; all arms and motions are in turn."""
    names = list(arms)
    motions = list(MOTIONS)
    for k in range(runs):
        arm = ARMS[k % len(ARMS)]
        if arm not in names:
            continue
        motion = motions[(k + k // len(ARMS)) % len(motions)]
        try:
            both = [
                found(recorded(loop_of(arm, k, load), motion, k), load)
                for load in (0.0, LOAD)
            ]
        except TrajectoryError as error:  # drawn too near a limit
            print_notice(f'{arm} {motion} {k} is left out: {error}')
            continue
        yield Pair(arm, motion, k, *both)


def delay_of(run: Found) -> float:
    """Return how long after the pick-up the next change was found [s]; NaN: never."""
    after = run.changes[run.changes >= PICK_UP]
    return float(after[0] - PICK_UP) if after.size else np.nan


def share(part: Floats) -> str:
    """Return the share of true values, and how many there are."""
    return f'{100.0 * part.mean():.1f} % of {part.size}' if part.size else '-'


def grams(values: Floats) -> str:
    """Return a median and the largest of some masses, in g."""
    if not values.size:
        return '-'
    return f'{1e3 * np.median(values):.0f}, {1e3 * values.max():.0f}'


def empty_row(name: str, runs: list[Found]) -> list[str]:
    """Return what runs say in which nothing changes."""
    changes = np.array([run.changes.size for run in runs])
    readings = np.concatenate([run.readings for run in runs])
    wrong = [np.abs(run.readings[outside(run.readings), WEIGHED]) for run in runs]
    heavy = [each.max(initial=0.0) > WRONG for each in wrong]
    told = readings[certain(readings)]
    return [
        name,
        f'{len(runs)}',
        f'{changes.sum() * 600.0 / (DURATION * len(runs)):.1f} (in {(changes > 0).sum()})',
        share(outside(readings)),
        f'{1e3 * np.concatenate(wrong).max(initial=0.0):.0f} g',
        f'{sum(heavy)}',
        share(outside(told)),
        f'{1e3 * np.abs(told[:, 2]).max(initial=0.0):.0f} g',
        f'{sum(run.contacts for run in runs)}',
    ]


def loaded_row(name: str, runs: list[Found]) -> list[str]:
    """Return what runs say in which a load is picked up half-way."""
    delays = np.array([delay_of(run) for run in runs])
    is_found = delays[delays < 2.0]
    changes = sum(run.changes.size for run in runs)
    held = [run.readings[run.readings[:, TIME] > PICK_UP] for run in runs]
    cells = []
    for seconds in (3.0, 8.0):
        at = [
            abs(of[of[:, TIME] >= PICK_UP + seconds][:1, WEIGHED] - LOAD)
            for of in held
            if of.size
        ]
        half = [
            of[of[:, TIME] >= PICK_UP + seconds][:1, INTERVAL] for of in held if of.size
        ]
        cells.append(
            f'{grams(np.concatenate(at))} (± {grams(np.concatenate(half)).split(",")[0]})'
            if at
            else '-'
        )
    readings = np.concatenate(held)
    told = readings[certain(readings)]
    times = (
        f'{np.median(is_found):.2f}, {is_found.max():.2f} s' if is_found.size else '-'
    )
    return [
        name,
        f'{len(runs)}',
        f'{is_found.size}: {times}',
        f'{changes - is_found.size}',
        *cells,
        share(outside(readings)),
        share(outside(told)),
        f'{sum(run.contacts for run in runs)}',
    ]


_EMPTY = (
    *('nothing changes', 'runs', 'changes in 10 min', 'outside', 'worst outside'),
    *('runs > 100 g', 'certain: outside', 'largest', 'contacts'),
)
_LOADED = (
    *('2 kg', 'runs', 'found within 2 s: median, last', 'other changes'),
    *('error after 3 s: median, largest [g]', 'after 8 s', 'outside'),
    *('certain: outside', 'contacts'),
)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_arms(parser, ARMS, 24, 'pairs')


def main(options: argparse.Namespace) -> None:
    """Print the tables."""
    done = []
    for pair in pairs(options.arms, options.runs):
        done.append(pair)
        if options.each:
            name = f'{pair.arm} {pair.motion} {pair.seed}'
            print(empty_row(name, [pair.empty]), flush=True)
            print(loaded_row(name, [pair.loaded]), flush=True)
    groups = [
        *((name, [p for p in done if p.arm == name]) for name in options.arms),
        *((name, [p for p in done if p.motion == name]) for name in MOTIONS),
        ('all', done),
    ]
    groups = [(name, chosen) for name, chosen in groups if chosen]
    print_table(
        _EMPTY, [empty_row(name, [p.empty for p in chosen]) for name, chosen in groups]
    )
    print()
    print_table(
        _LOADED,
        [loaded_row(name, [p.loaded for p in chosen]) for name, chosen in groups],
    )
