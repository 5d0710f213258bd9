# SPDX-License-Identifier: Apache-2.0
"""Touch on slow motion: the interval of the external torque, and pushes during insertions.

    python -m benchmark touch [--runs 12] [--arms panda fr3 ur5e] [--each]

Gears, motors, lags and bases are those of `studies/monte_carlo_elastic_*.yaml`.  Links are up to
30 % heavier or lighter than the URDF's, and their centres of mass 1 cm off.  Friction is drawn
for each joint, 0.2 to 1.8 times what the law assumes, with up to 0.7 more at low speed, which
fades over 0.02 to 0.2 rad/s, and 4 to 30 mrad/s within which it turns round.  The arm learns for
12 s between random postures.  Then it inserts four times: it moves to a posture, rests for 1 to
6 s, and advances for 4 s with 5 to 30 mrad/s.  In the second to fourth advance something pushes
the tip for a second, in a random direction.

Each arm runs three times:

    learned     as it is
    tared       with `Controller.tare` at the end of each rest
    URDF        without learning; its residual less its mean in the last 0.3 s of each rest

*Coverage* is that of the 95 % interval in the advances before the push.  *Found* is within a
second: at the threshold by default without loads, and with all thresholds at equal false alarms,
where the URDF's observer has one limit for each joint of all arms of a kind, in proportion to the
rms of its residual there.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from benchmark.contacts import alarms, delays, threshold_at
from benchmark.harness import print_table
from benchmark.nothing_changes import (
    FRICTION,
    RANGE,
    STRIBECK,
    STRIBECK_SPEED,
    Waypoints,
    moved,
    rested,
)
from benchmark.options import add_arms
from benchmark.studies import load_study
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import load_loop
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.factory.controller import begin, controller_of
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.perception import CONTACT, DISTANCE
from blf_dsc_controller.law.samples import sample_columns
from blf_dsc_controller.messages.journal import Journal
from blf_dsc_controller.reference.trajectory import (
    Trajectory,
    TrajectoryPoint,
    plan_trajectory,
)
from blf_dsc_controller.run import Floats
from blf_dsc_controller.simulation.compiled_loop import CompiledLoop, Span
from blf_dsc_controller.simulation.loop import new_record
from blf_dsc_controller.studies.monte_carlo import draw, plant_with
from sim_plant.plant import plant_of

ARMS = ('panda', 'fr3', 'ur5e')
START, LEARNED = 2.0, 14.0  # s
REST = (1.0, 6.0)  # s
ADVANCE = 4.0  # s
TARE = 0.1  # s before the end of a rest
MEAN = 0.3  # s, over which the URDF's residual is tared
BEGIN = 1.0  # s into an advance, or up to a second later, something pushes
PUSH, RISE = 1.0, 0.01  # s
SPEED = (0.005, 0.03)  # rad/s
SLIDING = (0.004, 0.03)  # rad/s, over which friction turns at rest
FORCES = (0.0, 5.0, 10.0, 20.0)  # N, in turn
RATE = 100.0  # false alarms for each hour
PLAIN, TARED, URDF = 'learned', 'tared', 'URDF'


class Loop(NamedTuple):
    """An arm and its controller."""

    plant: PlantConfig
    controller: ControllerConfig


class Insertion(NamedTuple):
    """One advance: times since the start of the run [s]."""

    begin: float
    push: float  # the end, where nothing pushes
    end: float


class Trial(NamedTuple):
    """What an observer says in the advances of one arm."""

    arm: str
    free: Sequence[Floats]  # (k, n) N m, in each advance before the push
    covered: Floats  # (n,), share of these
    half: Floats  # (n,) N m, mean interval of these
    calm: Sequence[Floats]  # (k,) distances, likewise
    pushed: Sequence[Floats]  # (k, n) N m, in each push
    reached: Sequence[Floats]  # (k,) distances, likewise
    alarms: int  # contacts before a push
    found: Sequence[bool]  # contact in each push
    period: float  # s


def motion_of(
    config: ControllerConfig, random: np.random.Generator
) -> tuple[Trajectory, list[Insertion]]:
    """Return fast motions, and the insertions after them."""
    home = np.array(config.reference.offset)
    time, q = START, home
    zero = (0.0,) * home.size
    points = [TrajectoryPoint(time, tuple(home), zero)]

    def follow(waypoints: Waypoints) -> None:
        nonlocal time, q
        for seconds, there, dq in waypoints:
            time += seconds
            q = there
            points.append(TrajectoryPoint(time, tuple(there), tuple(dq)))

    def move() -> None:
        goal = home + random.uniform(-RANGE, RANGE, home.size)
        follow(moved(q, goal, random.uniform(0.3, 0.8)))

    while time < LEARNED:
        move()
        follow(rested(q, random.uniform(0.2, 0.6)))
    insertions = []
    for force in FORCES:
        move()
        follow(rested(q, random.uniform(*REST)))
        speed = random.uniform(*SPEED)
        share = random.uniform(-1.0, 1.0, home.size)
        way = speed * ADVANCE * share / np.abs(share).max()
        begin = time
        push = begin + BEGIN + random.uniform()
        follow(moved(q, q + way, speed))
        insertions.append(Insertion(begin, push if force else time, time))
    return Trajectory(config.joints, tuple(points), 0.0), insertions


def friction_of(arm: str, random: np.random.Generator) -> dict[str, Any]:
    """Return a friction unlike the one that the law assumes."""
    usual = load_loop(arm).plant.disturbance

    def varied(values: tuple[float, ...]) -> list[float]:
        factors = random.uniform(*FRICTION, len(values))
        return [float(each) for each in factors * values]

    def within(velocities: tuple[float, float]) -> float:
        return float(np.exp(random.uniform(*np.log(velocities))))

    return {
        'disturbance.viscous': varied(usual.viscous),
        'disturbance.coulomb': varied(usual.coulomb),
        'disturbance.stribeck': float(random.uniform(*STRIBECK)),
        'disturbance.stribeck_velocity': within(STRIBECK_SPEED),
        'disturbance.coulomb_velocity': within(SLIDING),
    }


def pushes_of(
    insertions: Sequence[Insertion], random: np.random.Generator
) -> dict[str, Any]:
    """Return the events of pushes in random directions."""
    begins = [each.push for each in insertions if each.push < each.end]
    forces: list[float] = []
    for force in FORCES[1:]:
        direction = random.normal(size=3)
        forces += (force * direction / np.linalg.norm(direction)).tolist()
    return {
        'events.begin': begins,
        'events.duration': [PUSH] * len(begins),
        'events.ramp': [RISE] * len(begins),
        'events.payload': [0.0] * len(begins),
        'events.force': forces,
    }


def loop_of(arm: str, seed: int) -> tuple[Loop, Trajectory, list[Insertion]]:
    """Return an arm of its own, what it does, and when it is pushed."""
    random = np.random.default_rng((seed, 65))
    study = load_study(f'monte_carlo_elastic_{arm}')
    controller = change(
        study.controller,
        {
            'contact.enabled': True,
            'contact.loads': False,
            'contact.reaction': 'hold',  # a contact is not learned
            'reference.type': 'hold',
        },
    )
    trajectory, insertions = motion_of(controller, random)
    given = {
        'duration': insertions[-1].end,
        'truth.mass_deviation': 0.3,
        'truth.centre_deviation': 0.01,
        **pushes_of(insertions, random),
        **friction_of(arm, random),
    }
    plant = change(plant_with(study, draw(study, seed)), given)
    return Loop(plant, controller), trajectory, insertions


def run(
    loop: Loop,
    trajectory: Trajectory,
    insertions: Sequence[Insertion],
    act: Callable[[Controller], object] | None,
) -> tuple[Floats, Any]:
    """Run the law along a motion, and let it `act` at the end of each rest.

    Return the times (k,) [s] and the columns of the samples. Raises RuntimeError if a check
    ends the run.
    """
    config = loop.controller
    controller = controller_of(config)
    record = new_record(controller, config, loop.plant, Journal())
    plant = plant_of(loop.plant)
    begin(controller, config, *plant.measure().reshape(3, -1)[:2])
    planned = plan_trajectory(trajectory, controller.reference_vector, 0.0, config)
    controller.reference_vector = planned.vector
    period = loop.plant.sample_time
    last = record.stamps.size
    cuts = [round((each.begin - TARE) / period) for each in insertions] if act else []
    compiled = CompiledLoop(controller, plant)
    for first, end in zip([0, *cuts], [*cuts, last], strict=True):
        rows = record.rows(range(first, end)).rows_to_fill()
        span = Span(first, end - 1, is_end=end == last, observed=True)
        if not compiled.run(span, rows):
            raise RuntimeError(f'a check ended the run before {end * period:.3f} s')
        if end < last and act is not None:
            act(controller)
    return record.stamps * 1e-9, sample_columns(record.samples, controller.settings)


def tared(residuals: Floats, t: Floats, insertions: Sequence[Insertion]) -> Floats:
    """Return residuals (k, n) less their mean at the end of each rest."""
    r: Floats = residuals.copy()
    for each in insertions:
        still = (t >= each.begin - TARE - MEAN) & (t < each.begin - TARE)
        r[t >= each.begin - TARE] -= r[still].mean(axis=0)
    return r


def trial_of(
    arm: str, t: Floats, samples: Any, insertions: Sequence[Insertion], *, tares: bool
) -> Trial:
    """Return what the samples say in the advances."""
    r = tared(samples.external, t, insertions) if tares else samples.external
    half = samples.external_interval
    touched = samples.contact[:, CONTACT]
    distance = samples.contact[:, DISTANCE]
    free = [(t >= each.begin) & (t < each.push) for each in insertions]
    pushed = [
        (t >= each.push) & (t < each.push + PUSH) & (t < each.end)
        for each in insertions
        if each.push < each.end
    ]
    inside = [np.abs(r[span]) <= half[span] for span in free]
    starts = [np.diff(touched[span], prepend=0.0) > 0.5 for span in free]
    return Trial(
        arm=arm,
        free=[r[span] for span in free],
        covered=np.concatenate(inside).mean(axis=0),
        half=np.concatenate([half[span] for span in free]).mean(axis=0),
        calm=[distance[span] for span in free],
        pushed=[r[span] for span in pushed],
        reached=[distance[span] for span in pushed],
        alarms=sum(int(each.sum()) for each in starts),
        found=[bool(touched[span].any()) for span in pushed],
        period=float(t[1] - t[0]),
    )


def trials(arms: Iterable[str], runs: int) -> Iterator[dict[str, Trial]]:
    """Yield so many arms, with each observer."""
    names = list(arms)
    for k in range(runs):
        arm = names[k % len(names)]
        loop, trajectory, insertions = loop_of(arm, k)
        unlearned = [0.0] * len(loop.controller.learning.initial_estimate)
        without = {'learning.weight': 0.0, 'learning.adaptation_gain': unlearned}
        urdf = loop._replace(controller=change(loop.controller, without))
        found = {}
        for name, of, act in (
            (PLAIN, loop, None),
            (TARED, loop, Controller.tare),
            (URDF, urdf, None),
        ):
            t, samples = run(of, trajectory, insertions, act)
            found[name] = trial_of(arm, t, samples, insertions, tares=name == URDF)
        yield found


def with_limits(done: Sequence[Trial]) -> list[Trial]:
    """Give trials the distances of one limit for each joint of all arms of a kind."""
    limits = {
        arm: np.sqrt(
            np.mean(
                np.concatenate(
                    [r for each in done if each.arm == arm for r in each.free]
                )
                ** 2,
                axis=0,
            )
        )
        for arm in {each.arm for each in done}
    }

    def distances(arm: str, torques: Sequence[Floats]) -> list[Floats]:
        return [(np.abs(r) / limits[arm]).max(axis=1) for r in torques]

    return [
        each._replace(
            calm=distances(each.arm, each.free),
            reached=distances(each.arm, each.pushed),
        )
        for each in done
    ]


def coverage_row(name: str, done: Sequence[Trial]) -> list[str]:
    """Return how often intervals hold zero while nothing touches the arm."""
    covered = np.concatenate([each.covered for each in done])
    half = np.concatenate([each.half for each in done])
    return [
        name,
        f'{(covered < 0.95).sum()} of {covered.size}',
        f'{covered.min():.2f}',
        f'{100.0 * covered.mean():.1f} %',
        f'{np.quantile(half, 0.1):.2f}, {np.median(half):.2f}, {np.quantile(half, 0.9):.2f}',
        f'{sum(each.alarms for each in done)}',
    ]


def delay_cell(times: Floats) -> str:
    """Return how many pushes are not found, and the median and the last of delays [s]."""
    late = np.isinf(times).sum()
    median, last = (
        f'{1e3 * each:.0f} ms' if np.isfinite(each) else '-'
        for each in (np.median(times), times.max())
    )
    return f'{late} of {times.size} ({median}, {last})'


def push_row(name: str, done: Sequence[Trial]) -> list[str]:
    """Return how many pushes are not found, and after what time."""
    free = [calm for each in done for calm in each.calm]
    period = done[0].period
    resampled = [calm for calm in free if calm.size]
    threshold = threshold_at(RATE, resampled, period)
    pushes = range(len(FORCES) - 1)
    times = [
        delays([each.reached[k] for each in done], threshold, period) for k in pushes
    ]
    missed = [
        f'{sum(not each.found[k] for each in done)} of {len(done)}' for k in pushes
    ]
    is_own = name != URDF
    count = sum(alarms(calm, threshold, round(0.2 / period)) for calm in resampled)
    return [
        name,
        *(missed if is_own else ['-'] * len(missed)),
        f'{threshold:.2f} ({count})',
        *map(delay_cell, times),
    ]


_COVERAGE = (
    *('95 % interval', 'joints below 0.95', 'least', 'mean'),
    *('half width: 10 %, median, 90 % [N m]', 'false contacts'),
)
_PUSHES = (
    'not found in a second',
    *(f'{force:g} N at 8' for force in FORCES[1:]),
    f'threshold at {RATE:g}/h',
    *(f'{force:g} N (median, last)' for force in FORCES[1:]),
)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_arms(parser, ARMS, 12, 'arms')


def print_trial(name: str, trial: Trial) -> None:
    """Print what an observer says of one arm, with the largest distances of each advance."""
    calm, reached = (
        [round(float(each.max()), 1) for each in distances]
        for distances in (trial.calm, trial.reached)
    )
    print(coverage_row(f'{trial.arm} {name}', [trial]), calm, reached, flush=True)


def main(options: argparse.Namespace) -> None:
    """Print the tables."""
    done = []
    for found in trials(options.arms, options.runs):
        done.append(found)
        if options.each:
            for name in (PLAIN, TARED):
                print_trial(name, found[name])
    by_name = {name: [found[name] for found in done] for name in (PLAIN, TARED, URDF)}
    by_name[URDF] = with_limits(by_name[URDF])
    print_table(
        _COVERAGE, [coverage_row(name, by_name[name]) for name in (PLAIN, TARED)]
    )
    print()
    print_table(_PUSHES, [push_row(name, each) for name, each in by_name.items()])
