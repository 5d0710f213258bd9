# SPDX-License-Identifier: Apache-2.0
"""Whether motions that are sent make elastic arms ring, and what shaping them is worth.

    python -m benchmark shaping sent|shaped [--truths N] [--arms NAME...] [--limits A...]
                                            [--keep FILE]

Each arm learns along the motion of its file for 8 s, without a load and with 2 kg from 2 s on,
and then makes moves from rest to rest: of all joints, of one, a short one of two joints, and
back, with the acceleration limits of LIMITS and 1.5 rad/s.  True arms are those of `soft-arms`;
every run is paired with one of the same arm, load and noise.  Gains are those of the arm's file.
The law runs without its guard, which would soften gains if the arm oscillated.  Figures are of
the links:

    peak, rms    error [mrad] of any joint, and of its norm, against the reference that the law
                 follows, from the beginning of the move to 0.5 s after the reference ends
    ringing      acceleration [rad/s^2], rms of the norm between 8 and 45 Hz, in the 0.5 s after
                 the end of what was sent, and in the 0.5 s after the reference ends
    settles      how long after the end of what was sent [s] all links stay within 1 mrad of the
                 goal, and within 3 mrad; at most the 1.5 s until the next move

The moves have trapezoidal velocities, as MoveIt's TOTG sends them: points every 0.1 s with
velocities and accelerations, which the action interpolates by quintics.

`sent`: the ringing after them

`shaped`: MoveIt's motion, changed by a shaper for the lowest resonance f of the assumed arm

    slowed         the same motion, later by 1 / f
    ZV, ZVD        after two and three impulses (Singer and Seering, 1990), later by 1 / (2 f)
                   and 1 / f
    mean           its moving average over 1 / f, which limits the jerk; later by 1 / f
    minimum jerk   in the time of the motion

Cells have the median of the ratios to the motion as it is, and in how many pairs it is lower and
higher by more than 2 %; of the times until links settle the median of the differences [ms], and
in how many pairs it is sooner and later by more than 5 ms.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmark import soft_arms
from benchmark.elastic import FREE
from benchmark.harness import print_table
from benchmark.kept import Results
from benchmark.load_observer import WEIGHT
from benchmark.options import positive
from benchmark.random_arms import ROBOTS, describe
from benchmark.scaling import trapezoid_points
from blf_dsc_controller.arms.linear_loop import arm_response
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import (
    CONTROLLER,
    PLANT,
    LoopConfig,
    load_loop,
)
from blf_dsc_controller.factory.controller import begin, controller_of
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.messages.journal import Journal
from blf_dsc_controller.reference.terms import (
    hermite,
    minimum_jerk,
    pack,
    sampled,
    unpack,
)
from blf_dsc_controller.reference.trajectory import (
    Trajectory,
    TrajectoryPoint,
    plan_trajectory,
)
from blf_dsc_controller.run import Floats
from blf_dsc_controller.simulation.compiled_loop import CompiledLoop, Span
from blf_dsc_controller.simulation.loop import new_record
from sim_plant.plant import plant_of
from sim_plant.sampled_plant import Plant

LIMITS = (1.0, 2.5, 5.0, 10.0)  # rad/s^2
VELOCITY = 1.5  # rad/s
PICK_UP, LEARNED, POSED, FIRST = 2.0, 8.0, 10.0, 11.0  # s
DWELL = 1.5  # s after the end of a move that was sent
AFTER = 0.5  # s, in which ringing is looked for
BAND = 8.0, 45.0  # Hz
FAR, SHORT = 0.35, 0.05  # rad
SPACING = 0.1  # s between points
TOLERANCES = (1.0, 3.0)  # mrad
LOADS = (0.0, WEIGHT)  # kg


ARMS = {
    'ur5e': soft_arms.ARMS['ur5e'],
    'panda': soft_arms.ARMS['panda']._replace(label='Panda', plant={}),  # its file's
    'fr3': soft_arms.ARMS['fr3'],
    'ur5e_motor': soft_arms.ARMS['ur5e_motor'],
    'panda_no_loop': soft_arms.ARMS['panda_no_loop'],
}


@cache
def loop_of(name: str, load: float, truth: int) -> LoopConfig:
    """Return the loop of a true arm with a load [kg]; truth 0 is the arm that is assumed."""
    arm = ARMS[name]
    n = len(soft_arms.loop_with(arm, {}).plant.joints)
    gains = {} if name == 'panda' else soft_arms.gains_of(name)
    drawn = soft_arms.drawn(arm, truth) if truth else {}
    plant = {
        **arm.plant,
        **drawn,
        'truth.seed': truth,
        'seed': truth,
        'events.begin': [PICK_UP],
        'events.duration': [0.0],
        'events.payload': [load],
    }
    controller = {
        **gains,
        'barrier.bound': [FREE] * n,
        'limits.velocity': [2.0] * n,
        'limits.acceleration': [40.0] * n,  # nothing is stretched
    }
    return load_loop(ROBOTS[arm.robot].preset, {PLANT: plant, CONTROLLER: controller})


@cache
def resonance(name: str) -> float:
    """Return the lowest resonance [Hz] of the arm that is assumed, from torque to position."""
    loop = loop_of(name, 0.0, 0)
    arm = describe(loop.controller, loop.plant, 4)
    frequency = np.geomspace(8.0, 100.0, 1000)
    s = np.asarray(2j * np.pi * frequency, complex)
    response = arm_response(arm.links, arm.joints, arm.timing, s)
    own = np.abs(np.diagonal(response, axis1=2, axis2=3)) * frequency[:, None] ** 2
    middle = own[:, 1:-1]
    peaks = (middle > own[:, :-2]) & (middle > own[:, 2:])
    return float(frequency[1:-1][peaks.any(axis=(0, 2))].min())


# Motions.


class Move(NamedTuple):
    """A move from rest to rest: when it begins [s], its duration [s], start and goal (n,) [rad]."""

    begin: float
    duration: float
    start: Floats
    goal: Floats
    limit: float  # rad/s^2


def moves_of(config: ControllerConfig, limits: Sequence[float]) -> list[Move]:
    """Return the moves of an arm around the middle of its preset's motion."""
    home = np.array(config.reference.offset)
    n = home.size
    random = np.random.default_rng(n)
    far = home + FAR * random.choice((-1.0, 1.0), n) * random.uniform(0.5, 1.0, n)
    one = far.copy()
    one[1] = home[1]
    short = one.copy()
    short[[0, 3]] += SHORT
    places = [home, far, one, short, home]
    moves: list[Move] = []
    t = FIRST
    for limit in limits:
        for start, goal in itertools.pairwise(places):
            end = trapezoid_points(goal - start, VELOCITY, limit, SPACING)[-1].time
            moves.append(Move(t, end, start, goal, limit))
            t = round(t + end + DWELL, 3)
    return moves


def sent(move: Move, config: ControllerConfig, times: Floats) -> Floats:
    """Return qr, dqr, ddqr (k, 3, n) of a move with MoveIt's points."""
    distance = move.goal - move.start
    points = tuple(
        each._replace(positions=tuple((move.start + each.positions).tolist()))
        for each in trapezoid_points(distance, VELOCITY, move.limit, SPACING)[1:]
    )
    at_rest = pack(move.goal.size, [minimum_jerk(np.zeros(1), move.start[np.newaxis])])
    trajectory = Trajectory(config.joints, points, move.begin)
    return sampled(
        plan_trajectory(trajectory, at_rest, move.begin, config).vector, times
    )


def quintic(move: Move, times: Floats) -> Floats:
    """Return qr, dqr, ddqr (k, 3, n) of minimum jerk in the time of a move."""
    ends = np.array((move.begin, move.begin + move.duration))
    term = minimum_jerk(ends, np.array((move.start, move.goal)))
    return sampled(pack(move.goal.size, [term]), times)


# Shapers: each takes and returns qr, dqr, ddqr (k, 3, n), a sample in each ms.


def delayed(fields: Floats, samples: int) -> Floats:
    """Return a motion some samples later."""
    return np.concatenate((np.repeat(fields[:1], samples, axis=0), fields))[
        : len(fields)
    ]


def impulses(fields: Floats, period: float, shares: tuple[float, ...]) -> Floats:
    """Return the motion after impulses half a period [s] apart."""
    apart = round(1e3 * 0.5 * period)
    parts = (share * delayed(fields, k * apart) for k, share in enumerate(shares))
    return np.asarray(sum(parts))


def averaged(fields: Floats, period: float) -> Floats:
    """Return the moving average over a period [s]; its derivatives are differences."""
    size = round(1e3 * period)
    T = 1e-3 * size
    out = np.empty_like(fields)
    rise = fields - delayed(fields, size)
    out[:, 1], out[:, 2] = rise[:, 0] / T, rise[:, 1] / T
    q, dq = fields[:, 0], fields[:, 1]
    # the integral over a sample, exact for cubics
    steps = 5e-4 * (q[1:] + q[:-1]) + 1e-6 / 12.0 * (dq[:-1] - dq[1:])
    whole = np.concatenate(
        (np.zeros_like(q[:1]), np.cumsum(steps - 1e-3 * q[0], axis=0))
    )
    out[:, 0] = q[0] + (whole - delayed(whole, size)) / T
    return out


def slowed(move: Move, config: ControllerConfig, times: Floats, later: float) -> Floats:
    """Return MoveIt's motion, slowed down to take some time [s] longer."""
    factor = move.duration / (move.duration + later)
    warped = move.begin + factor * (times - move.begin)
    fields = sent(move, config, warped)
    return np.asarray(fields * (factor ** np.arange(3.0))[:, np.newaxis])


def reference(
    rule: str, move: Move, config: ControllerConfig, times: Floats, frequency: float
) -> tuple[Floats, float]:
    """Return a rule's qr, dqr, ddqr (k, 3, n), and by how much [s] it ends later."""
    if rule == 'minimum jerk':
        return quintic(move, times), 0.0
    period = 1.0 / frequency
    if rule == 'slowed':
        return slowed(move, config, times, period), period
    fields = sent(move, config, times)
    if rule == MOVEIT:
        return fields, 0.0
    if rule == 'mean':
        return averaged(fields, period), period
    if rule == 'ZV':
        return impulses(fields, period, (0.5, 0.5)), 0.5 * period
    return impulses(fields, period, (0.25, 0.5, 0.25)), period


MOVEIT = 'MoveIt'
SHAPED = ('slowed', 'ZV', 'ZVD', 'mean', 'minimum jerk')


# Runs.


class Figures(NamedTuple):
    """What a move shows."""

    limit: float  # rad/s^2
    peak: float  # mrad
    rms: float  # mrad
    ringing: float  # rad/s^2, after the end of what was sent
    after: float  # rad/s^2, after the end of the reference
    resting: float  # rad/s^2, before all moves
    settles: float  # s, to 1 mrad
    nearly: float  # s, to 3 mrad


def ringing_of(acceleration: Floats, dt: float) -> float:
    """Return the rms [rad/s^2] in BAND of the norm of accelerations (k, n)."""
    k = len(acceleration)
    window = np.hanning(k)[:, np.newaxis]
    rest = acceleration - acceleration.mean(axis=0)
    power = np.abs(np.fft.rfft(rest * window, axis=0)) ** 2
    frequency = np.fft.rfftfreq(k, dt)
    inside = (frequency >= BAND[0]) & (frequency <= BAND[1])
    return float(np.sqrt(2.0 * power[inside].sum() / (k * np.sum(window**2))))


class Seen(NamedTuple):
    """The motion of the links in a run: times (k,) [s], and (k, n) each."""

    t: Floats
    links: Floats  # rad
    acceleration: Floats  # rad/s^2
    reference: Floats  # rad


def figures_of(move: Move, later: float, seen: Seen) -> Figures:
    """Return what a move shows whose reference ends some time [s] later than it was sent."""
    t, links = seen.t, seen.links
    dt = float(t[1] - t[0])
    end = move.begin + move.duration
    inside = (t >= move.begin) & (t < end + later + AFTER)
    error = 1e3 * (links - seen.reference)[inside]
    off = 1e3 * np.abs(links - move.goal).max(axis=1)

    def ringing(first: float) -> float:
        rows = (t >= first) & (t < first + AFTER)
        return ringing_of(seen.acceleration[rows], dt)

    def settles(tolerance: float) -> float:
        in_window = (t >= move.begin) & (t < end + DWELL - dt)
        return float(t[np.flatnonzero(in_window & (off > tolerance))[-1]] - end)

    return Figures(
        limit=move.limit,
        peak=float(np.abs(error).max()),
        rms=float(np.sqrt((error**2).sum(axis=1).mean())),
        ringing=ringing(end),
        after=ringing(end + later),
        resting=ringing(FIRST - AFTER),
        settles=settles(TOLERANCES[0]),
        nearly=settles(TOLERANCES[1]),
    )


def references_of(
    moves: list[Move],
    rule: str,
    config: ControllerConfig,
    grid: Floats,
    frequency: float,
) -> tuple[Floats, list[float]]:
    """Return qr, dqr, ddqr (k, 3, n) on a grid [s], and by how much [s] each move ends later."""
    fields = np.zeros((grid.size, 3, len(config.joints)))
    laters = []
    begins = [*(move.begin for move in moves), np.inf]
    for move, following in zip(moves, begins[1:], strict=True):
        rows = (grid >= move.begin - 1e-9) & (grid < following - 1e-9)
        fields[rows], later = reference(rule, move, config, grid[rows], frequency)
        laters.append(later)
    return fields, laters


class Warm(NamedTuple):
    """An arm that has learned and rests, to be moved from there by each rule."""

    controller: Controller
    plant: Plant
    reference: Floats  # packed, until it rests
    saved: tuple[Floats, tuple[Floats, Mapping[str, Any]]]


@cache
def warmed(name: str, load: float, truth: int) -> Warm | None:
    """Run an arm until it rests, FIRST - AFTER [s] from the start; None: it stopped."""
    loop = loop_of(name, load, truth)
    config = loop.controller
    controller, plant = controller_of(config), plant_of(loop.plant)
    begin(controller, config, *plant.measure().reshape(3, -1)[:2])
    home = TrajectoryPoint(POSED - LEARNED, config.reference.offset)
    posed = plan_trajectory(
        Trajectory(config.joints, (home,), LEARNED),
        controller.reference_vector,
        LEARNED,
        config,
    )
    controller.reference_vector = posed.vector
    rows = range(round((FIRST - AFTER) / config.sample_time))
    record = new_record(controller, config, loop.plant, Journal(), rows)
    span = Span(rows.start, rows.stop - 1, is_end=False, observed=False)
    if not CompiledLoop(controller, plant).run(span, record.rows_to_fill()):
        return None
    return Warm(controller, plant, posed.vector, (controller.save(), plant.save()))


def run(
    name: str,
    load: float,
    truth: int,
    rule: str,
    limits: Sequence[float] = LIMITS,
) -> list[Figures]:
    """Return what each move of an arm shows under a rule; none if it stops."""
    warm = warmed(name, load, truth)
    if warm is None:
        return []
    loop = loop_of(name, load, truth)
    config, dt = loop.controller, loop.controller.sample_time
    n = len(config.joints)
    controller, plant = warm.controller, warm.plant
    controller.restore(warm.saved[0])
    plant.restore(warm.saved[1])
    moves = moves_of(config, limits)
    end = round((moves[-1].begin + moves[-1].duration + DWELL) / dt)
    rows = range(round((FIRST - AFTER) / dt), end + 1)
    record = new_record(controller, config, loop.plant, Journal(), rows)
    t = 1e-9 * record.stamps
    grid = t[np.searchsorted(t, FIRST - 1e-9) :]
    fields, laters = references_of(moves, rule, config, grid, resonance(name))
    term = hermite(grid, fields.swapaxes(0, 1))._replace(begin=float(grid[0]))
    controller.reference_vector = pack(n, [*unpack(warm.reference), term])
    span = Span(rows.start, rows.stop - 1, is_end=True, observed=False)
    if not CompiledLoop(controller, plant).run(span, record.rows_to_fill()):
        return []
    links, speeds = record.truths[:, -2 * n : -n], record.truths[:, -n:]
    acceleration = np.gradient(speeds, dt, axis=0)
    seen = Seen(t, links, acceleration, links - record.true_errors())
    return [figures_of(*each, seen) for each in zip(moves, laters, strict=True)]


_Key = tuple[str, float, int, str, tuple[float, ...]]


class Kept(Results[_Key, list[Figures]]):
    """Figures of runs, in a file if one is named."""

    def __init__(self, path: Path | None, limits: Sequence[float]) -> None:
        """Read those that the file has; each run has moves with all the limits."""
        self.limits = tuple(limits)
        super().__init__(
            path,
            lambda key: (*key[:-1], tuple(key[-1])),
            lambda values: [Figures(*each) for each in values],
        )

    def of(self, name: str, load: float, truth: int, rule: str) -> list[Figures]:
        """Return the figures of a run, from the file or computed now."""
        key = name, load, truth, rule, self.limits
        return self.get(key, lambda: run(*key))

    def of_arm(self, name: str, truths: int, rule: str) -> list[list[Figures]]:
        """Return the figures of the runs of a number of true arms with each load."""
        return [
            self.of(name, load, truth, rule)
            for truth in range(1, truths + 1)
            for load in LOADS
        ]


# Tables.


def sent_row(name: str, truths: int, kept: Kept) -> list[str]:
    """Return the row of an arm: the ringing after its moves, and at rest."""
    moves = list(itertools.chain.from_iterable(kept.of_arm(name, truths, MOVEIT)))
    ringing = [[each.resting for each in moves]] + [
        [each.after for each in moves if each.limit == limit] for limit in kept.limits
    ]
    cells = (f'{np.median(each):.2f} ({max(each):.2f})' for each in ringing)
    return [ARMS[name].label, f'{resonance(name):.0f} Hz', *cells]


def ratios(pairs: list[tuple[Figures, Figures]], field: str) -> str:
    """Return how much of a figure is left, and in how many pairs it is lower and higher."""
    each = np.array([getattr(a, field) / getattr(b, field) for a, b in pairs])
    lower, higher = 100.0 * np.mean(each < 0.98), 100.0 * np.mean(each > 1.02)
    return f'{np.median(each):.2f} ({lower:.0f}, {higher:.0f} %)'


def later_by(pairs: list[tuple[Figures, Figures]], field: str) -> str:
    """Return by how much links settle later [ms], and in how many pairs sooner and later."""
    each = 1e3 * np.array([getattr(a, field) - getattr(b, field) for a, b in pairs])
    sooner, later = 100.0 * np.mean(each < -5.0), 100.0 * np.mean(each > 5.0)
    return f'{np.median(each):+.0f} ms ({sooner:.0f}, {later:.0f} %)'


def pairs_of(
    name: str,
    truths: int,
    rule: str,
    kept: Kept,
) -> list[tuple[Figures, Figures]]:
    """Return the moves under a rule, each with MoveIt's, of runs that do not stop."""
    runs = kept.of_arm(name, truths, rule)
    others = kept.of_arm(name, truths, MOVEIT)
    return [
        pair
        for mine, other in zip(runs, others, strict=True)
        for pair in zip(mine, other, strict=False)
    ]


def pair_row(pairs: list[tuple[Figures, Figures]]) -> list[str]:
    """Return the cells of pairs."""
    errors = [ratios(pairs, each) for each in ('peak', 'rms', 'ringing', 'after')]
    return [*errors, *(later_by(pairs, each) for each in ('settles', 'nearly'))]


def shaped_rows(name: str, truths: int, kept: Kept) -> Iterator[list[str]]:
    """Compute the rows of an arm: its motion as it is, and with each shaper."""
    label, frequency = ARMS[name].label, resonance(name)
    own = [b for _, b in pairs_of(name, truths, MOVEIT, kept)]
    errors = [
        f'{np.median([getattr(each, field) for each in own]):.2f}'
        for field in ('peak', 'rms', 'ringing', 'after')
    ]
    times = [
        f'{1e3 * np.median([getattr(each, field) for each in own]):.0f} ms'
        for field in ('settles', 'nearly')
    ]
    yield [f'{label}, {frequency:.0f} Hz', 'as it is', *errors, *times]
    for rule in SHAPED:
        pairs = pairs_of(name, truths, rule, kept)
        yield [label, rule, *pair_row(pairs)]


_PAIRS = ('peak', 'rms', 'ringing', 'after', 'settles to 1 mrad', '3 mrad')


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument('table', choices=('sent', 'shaped'))
    parser.add_argument('--truths', type=positive, default=5, help='true arms (5)')
    parser.add_argument('--arms', nargs='+', choices=ARMS, default=list(ARMS))
    about = 'limits of the acceleration of the moves, one after the other [rad/s^2]'
    parser.add_argument(
        '--limits',
        nargs='+',
        type=float,
        choices=LIMITS,
        default=list(LIMITS),
        help=about,
    )
    parser.add_argument('--keep', type=Path, help='file of the runs that are made')


def main(given: argparse.Namespace) -> None:
    """Print the table that was asked for."""
    kept = Kept(given.keep, given.limits)
    if given.table == 'sent':
        limits = (f'{limit:g} rad/s^2' for limit in given.limits)
        rows = [sent_row(name, given.truths, kept) for name in given.arms]
        print_table(('arm', 'lowest resonance', 'at rest', *limits), rows)
        return
    of_arms = (shaped_rows(name, given.truths, kept) for name in given.arms)
    print_table(('arm', 'reference', *_PAIRS), itertools.chain.from_iterable(of_arms))
