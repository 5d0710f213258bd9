# SPDX-License-Identifier: Apache-2.0
"""Models of real and simulated robots by several methods, on equal terms.

    python -m benchmark league FOLDER... [--urdf ur10.urdf] [--arms 3]

Folders are copies of the repositories of `recordings.SOURCES`, or any with bags and a URDF; `arms`
are those of `identification.py arms`, whose truth is known.  All methods have the first four fifths
of the motion, with the signs, the contacts and the delay that `identify` finds there, joints
weighted by their residuals, and are judged by the last fifth:

least squares  every term of friction, a coupled wrist; no bounds, hardly any prior
semidefinite   the same; physical bodies, friction not negative
figaroh        the same terms; see `rivals`
mujoco.sysid   the terms that MuJoCo has; see `rivals`
identify       terms, and widths of the prior, selected by cross-validation

The tables show torque errors in % of the rms torque, on the last fifth, and on each fifth in turn
of models that are selected and fitted without it (not of the slow mujoco.sysid); errors of
positions of rollouts in MuJoCo, in % of the way moved (see `rollouts`); for simulated arms the
share of 95 % intervals of base parameters and friction that hold the truth; and seconds of CPU.
The rivals are compared where they are installed: pip install figaroh==1.0.2 'mujoco[sysid]'
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from random_arm import (
    PERIOD,
    Truth,
    is_covered,
    measured,
    recording_of,
    reference_of,
    shake,
    truth_of,
)

from benchmark import identification, rivals
from benchmark.harness import print_table
from benchmark.recordings import SOURCES, Published, Taken, bags_in
from benchmark.rivals import Fit
from benchmark.rollouts import rollout_error, rollouts_of
from blf_dsc_controller.configuration.robot import Robot
from blf_dsc_controller.identification.identified import Identified
from blf_dsc_controller.identification.identify import identify_arm
from blf_dsc_controller.identification.prior import Prior
from blf_dsc_controller.identification.problem import Problem, problem_of
from blf_dsc_controller.identification.reading import read_recording
from blf_dsc_controller.identification.recording import Recording, joined
from blf_dsc_controller.identification.regression import fitted, regression
from blf_dsc_controller.identification.scoring import scored
from blf_dsc_controller.identification.selection import select
from blf_dsc_controller.identification.summary import interval
from blf_dsc_controller.identification.values import (
    LOAD_FRICTION,
    QUADRATIC,
    STRIBECK,
)
from blf_dsc_controller.identification.windows import HOP, WINDOW, Indices, Rows
from blf_dsc_controller.run import Floats

_WEAK = 100.0  # times the prior's deviations: hardly any prior
_MOST = 1000.0  # %, above which an error says no more
_FIFTHS = 5
_EVERY = 5  # samples of 1 ms, of simulated arms
_METHODS = ('least squares', 'semidefinite', 'figaroh', 'mujoco.sysid', 'identify')
_TABLES = {
    'torque': 'Torque error on the last fifth [% of the rms torque]',
    'fifths': 'Torque error, each fifth held out in turn [% of the rms torque]',
    'rollout': 'Position error of rollouts of 0.2 s in MuJoCo [% of the way]',
    'covered': '95 % intervals that hold the truth [%]',
    'seconds': 'CPU [s]',
}


class Entry(NamedTuple):
    """A recording, and what else is known about it."""

    taken: Taken
    recording: Recording
    truth: Truth | None = None


class Result(NamedTuple):
    """What the methods have found in a recording; a figure that is not there is NaN."""

    name: str
    figures: dict[str, dict[str, float]]  # of the keys of `_TABLES`, then of methods
    terms: str


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument('folders', nargs='*', type=Path, metavar='FOLDER')
    parser.add_argument('--urdf', default='', help='of bags in folders without a URDF')
    parser.add_argument('--arms', type=int, default=0, help='simulated arms')
    fifths = 'without the errors on each fifth, which take most of the time'
    parser.add_argument('--last-only', action='store_true', help=fifths)


def main(options: argparse.Namespace) -> None:
    """Print the tables."""
    loads: list[str] = []
    results = []
    for name in rivals.MISSING:
        print(f'{name} is not installed: left out', file=sys.stderr)
    with tempfile.TemporaryDirectory() as bags:
        for entry in _entries(options.folders, options.urdf, options.arms, Path(bags)):
            results.append(_result(entry, last_only=options.last_only))
            torque = results[-1].figures['torque'].items()
            figures = ', '.join(f'{name} {error:.2f}' for name, error in torque)
            print(f'{entry.taken.name}: {figures}', file=sys.stderr, flush=True)
            if entry.taken.loaded:
                loads.append(_weigh_loaded(entry, *entry.taken.loaded))
    for kind, title in _TABLES.items():
        _print(kind, title, results)
    print('\n'.join(['', *loads]))


def _entries(folders: list[Path], urdf: str, arms: int, bags: Path) -> Iterator[Entry]:
    for folder in folders:
        readers = (read for file, read in SOURCES.items() if (folder / file).exists())
        read = next(readers, None)
        for taken in read(folder, bags) if read else bags_in(folder, urdf):
            recording = read_recording(taken.bag, taken.robot.text, taken.joints)
            yield Entry(taken, recording)
    for seed in range(arms):
        robot = identification.random_robot(seed)
        chain = robot.chain(())
        joints = tuple(joint.name for joint in chain.joints)
        truth = truth_of(chain, seed)
        reference = reference_of(chain, 2 * seed)
        states = shake(chain, truth, reference, identification.DURATION)
        seen = measured(states, seed)[::_EVERY]
        recording = recording_of(seen, joints, _EVERY * PERIOD)
        taken = Taken(f'simulated {seed}', robot, Path(), joints)
        yield Entry(taken, recording, truth)


def _result(entry: Entry, *, last_only: bool) -> Result:
    """Return what all methods find."""
    robot = entry.taken.robot
    begin = time.process_time()
    problem = problem_of(entry.recording, robot, 'torque', None, find_signs=True)
    reading = time.process_time() - begin
    selected = select(problem.rows, problem.windows.fit, problem.G, problem.prior)
    problem = problem._replace(rows=selected.rows)
    begin = time.process_time()
    arm = identify_arm(entry.recording, robot)
    own = time.process_time() - begin
    fits, seconds = _fits(problem, selected.prior, arm, robot)
    figures = {
        'torque': _torque_errors(problem, arm, fits),
        'rollout': _rollout_errors(entry, problem, arm, fits),
        'covered': _coverage(entry, arm, fits),
        'seconds': {name: reading + each for name, each in seconds.items()},
        'fifths': {} if last_only else _of_fifths(problem),
    }
    figures['seconds']['identify'] = own
    if entry.taken.published:
        delay = float(fits['identify'].values[-1])
        theirs = _published_error(entry.taken.published, problem, robot, delay)
        figures['torque']['published'] = theirs
    return Result(entry.taken.name, figures, _terms(arm))


def _fits(
    problem: Problem, prior: Prior, arm: Identified, robot: Robot
) -> tuple[dict[str, Fit], dict[str, float]]:
    """Return what the methods find in the windows to fit, and the seconds that this takes.

    `prior` is the one that `identify` has selected from these, and `arm` what it finds in all.
    """
    rows, fit, G, full = problem.rows, problem.windows.fit, problem.G, problem.prior
    free, weak = _peers(full).values()
    equal = regression(rows, fit, G, weak)
    methods: dict[str, Callable[[], Fit | None]] = {
        'URDF': lambda: Fit(full.mean, arm.covariance),
        'least squares': lambda: _peer(rows, fit, G, free),
        'semidefinite': lambda: _peer(rows, fit, G, weak),
        'figaroh': lambda: rivals.figaroh(arm, equal, weak),
        'mujoco.sysid': lambda: rivals.mujoco_sysid(
            arm, rows, fit, equal, full, robot.gravity
        ),
        'identify': lambda: Fit(fitted(rows, fit, G, prior).values, arm.covariance),
    }
    fits: dict[str, Fit] = {}
    seconds: dict[str, float] = {}
    for name, method in methods.items():
        if name in rivals.MISSING:
            continue
        begin = time.process_time()
        found = method()
        seconds[name] = time.process_time() - begin
        if found is not None:
            fits[name] = found
    return fits, seconds


def _peer(rows: Rows, fit: Indices, G: Floats, prior: Prior) -> Fit:
    """Return the fit by a model that is taken to be right, with correlated residuals."""
    found = fitted(rows, fit, G, prior)
    products = found.problem.folds.sum(axis=0)[:, :-1, :-1]
    information = np.tensordot(HOP / found.problem.lasting, products, 1)
    H = np.linalg.inv(information + np.eye(len(information)))
    return Fit(found.values, prior.D @ H @ prior.D.T)


def _torque_errors(
    problem: Problem, arm: Identified, fits: dict[str, Fit]
) -> dict[str, float]:
    """Return the torque errors [%] on the last fifth."""
    mean = problem.prior.mean
    errors = {}
    for name, fit in fits.items():
        score = scored(problem.rows, problem.windows, problem.G, mean, fit.values)
        errors[name] = float(score.total[2])
    errors['URDF'], errors['its URDF'] = map(float, arm.score.total[:2])
    return errors


def _published_error(
    published: Published, problem: Problem, robot: Robot, delay: float
) -> float:
    """Return the torque error [%] on the last fifth of the model of the recording's authors."""
    test = problem.windows.test
    # theirs slides at once
    rows = problem.rows.with_sliding(np.zeros(problem.rows.speed.size))
    u = rows.u(delay)[test]
    off = published(rows, robot)[test] - u
    return float(100.0 * np.linalg.norm(off) / np.linalg.norm(u))


def _rollout_errors(
    entry: Entry,
    problem: Problem,
    arm: Identified,
    fits: dict[str, Fit],
) -> dict[str, float]:
    """Return the errors [%] of rollouts by the measured torques on the last fifth."""
    rows, windows = problem.rows, problem.windows
    at_once = rows.with_sliding(np.zeros(rows.speed.size))
    recording = entry.recording._replace(torque=rows.torque)
    delay = float(fits['identify'].values[-1])
    motions = rollouts_of(recording, rows, windows.test, delay)
    gravity = entry.taken.robot.gravity
    errors = {}
    for name, fit in fits.items():
        slid = at_once if fit.at_once else rows
        loaded = slid.with_load((problem.G @ fit.values)[: rows.p])
        errors[name] = rollout_error(arm, fit.values, loaded, windows, motions, gravity)
    return errors


def _coverage(entry: Entry, arm: Identified, fits: dict[str, Fit]) -> dict[str, float]:
    """Return the share of intervals [%] that hold the truth, if it is known."""
    if entry.truth is None:
        return {}
    found = {}
    for name, fit in fits.items():
        values = arm.values if name == 'identify' else fit.values
        other = arm._replace(values=values, covariance=fit.covariance)
        found[name] = 100.0 * float(np.mean(is_covered(other, entry.truth)))
    return found


def _of_fifths(problem: Problem) -> dict[str, float]:
    """Return the torque errors [%] of methods, each fifth of the motion held out in turn."""
    rows, G, full = problem.rows, problem.G, problem.prior
    squares: dict[str, float] = {}
    total = 0.0
    for test in np.array_split(problem.windows.moving, _FIFTHS):
        first, last = rows.time[test[[0, -1]]]
        time = rows.time[problem.windows.moving]
        apart = (time < first - WINDOW) | (time > last + WINDOW)
        fit = problem.windows.moving[apart]
        selected = select(rows, fit, G, full)
        for name, prior in {**_peers(full), 'identify': selected.prior}.items():
            found = fitted(selected.rows, fit, G, prior)
            values, own = found.values, found.rows
            off = own.torques(test, (G @ values)[:-1]) - own.u(values[-1])[test]
            squares[name] = squares.get(name, 0.0) + float(np.sum(off**2))
        total += float(np.sum(rows.u(0.0)[test] ** 2))
    return {name: 100.0 * np.sqrt(each / total) for name, each in squares.items()}


def _peers(full: Prior) -> dict[str, Prior]:
    """Return the priors of least squares, and of semidefinite least squares."""
    weak = full.widened(np.full(full.mean.size, _WEAK))
    bounds = [cone._replace(power=0.0) for cone in weak.cones]
    return {
        'least squares': weak._replace(cones=[]),
        'semidefinite': weak._replace(cones=bounds),
    }


def _print(kind: str, title: str, results: list[Result]) -> None:
    """Print one of the tables; the best of each row is bold."""
    columns = [
        name
        for name in _METHODS
        if any(name in result.figures[kind] for result in results)
    ]
    if kind in {'torque', 'rollout'}:
        columns.insert(0, 'URDF')
    if kind == 'torque':
        columns.insert(1, 'published')
        columns.append('its URDF')
    heads = ['recording', *columns, *(['friction found'] if kind == 'torque' else [])]
    rows = []
    for result in results:
        figures = result.figures[kind]
        if not figures:
            continue
        texts = {name: f'{figure:.2f}' for name, figure in figures.items()}
        known = [
            float(texts[name])
            for name in _METHODS
            if texts.get(name, 'nan') not in {'nan', 'inf'}
        ]
        least = min(known, default=0.0)
        cells = [
            _cell(
                texts.get(name, ''), least, bold=name in _METHODS and kind != 'covered'
            )
            for name in columns
        ]
        rows.append(
            (result.name, *cells, *([result.terms] if kind == 'torque' else []))
        )
    if rows:
        print(f'\n{title}\n')
        print_table(heads, rows)


def _cell(text: str, least: float, *, bold: bool) -> str:
    if not text or text == 'nan':
        return '-'
    if float(text) > _MOST:
        return f'> {_MOST:.0f}'
    return f'**{text}**' if bold and float(text) <= least else text


def _terms(found: Identified) -> str:
    names = {LOAD_FRICTION: 'load', STRIBECK: 'Stribeck', QUADRATIC: 'quadratic'}
    texts = []
    for term, name in names.items():
        joints = np.flatnonzero(found.parts.terms[term]) + 1
        if joints.size:
            texts.append(f'{name} {", ".join(map(str, joints))}')
    if found.parts.coupling.any():
        texts.append('coupled wrist')
    return '; '.join(texts) or '-'


def _weigh_loaded(entry: Entry, bag: Path, mass: float) -> str:
    taken = entry.taken
    loaded = read_recording(bag, taken.robot.text, taken.joints)
    together, (boundary,) = joined(entry.recording, loaded)
    texts = []
    for given in (boundary, float('nan')):
        found = identify_arm(together, taken.robot, picked_up=given)
        if found.carried is not None:
            value, deviation = (float(each[0]) for each in found.load)
            found_mass = interval(value, deviation, '.3f')
            texts.append(f'{found_mass} kg {found.carried.when}')
    return f'{taken.name} with {mass:.3f} kg: {texts[0]}; as one bag: {texts[1]}'
