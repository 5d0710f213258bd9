# SPDX-License-Identifier: Apache-2.0
"""Models of real and simulated robots by several methods, on equal terms.

    .venv/bin/python benchmark/league.py FOLDER... [--urdf ur10.urdf] [--arms 3]

Folders are copies of the repositories of `recordings.SOURCES`, or any with bags and a URDF; `arms`
are those of `identification.py arms`, whose truth is known.  All methods have the first four fifths
of the motion, with the signs, the contacts and the delay that `identify` finds there, joints
weighted by their residuals, and are judged by the last fifth:

least squares  every term of friction, a coupled wrist; no bounds, no prior
semidefinite   the same terms; physical bodies, friction not negative, hardly any prior
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
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
sys.path.append(str(Path(__file__).parents[1] / 'test'))

import tempfile
import time
from typing import NamedTuple

import identification
import numpy as np
import rivals
from harness import print_table
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
from recordings import SOURCES, Taken, bags_in
from rivals import Fit
from rollouts import rollout_error, rollouts_of

from blf_dsc_controller.identification.identified import Identified
from blf_dsc_controller.identification.identify import identify_arm
from blf_dsc_controller.identification.prior import Prior
from blf_dsc_controller.identification.problem import Problem, problem_of
from blf_dsc_controller.identification.reading import read_recording
from blf_dsc_controller.identification.recording import Recording, joined
from blf_dsc_controller.identification.regression import fitted, regression
from blf_dsc_controller.identification.scoring import scored
from blf_dsc_controller.identification.selection import select
from blf_dsc_controller.identification.values import (
    LOAD_FRICTION,
    QUADRATIC,
    STRIBECK,
)
from blf_dsc_controller.identification.windows import WINDOW

# times the prior's deviations: hardly any prior, and none
_WEAK, _NONE = 100.0, 1e4
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


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('folders', nargs='*', type=Path, metavar='FOLDER')
    parser.add_argument('--urdf', default='', help='of bags in folders without a URDF')
    parser.add_argument('--arms', type=int, default=0, help='simulated arms')
    fifths = 'without the errors on each fifth, which take most of the time'
    parser.add_argument('--last-only', action='store_true', help=fifths)
    options = parser.parse_args()
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
    seconds = {'URDF': time.process_time() - begin}
    rows, windows, G, full = problem.rows, problem.windows, problem.G, problem.prior
    selected = select(rows, windows.fit, G, full)
    trained = fitted(rows, windows.fit, G, selected.prior)
    begin = time.process_time()
    arm = identify_arm(entry.recording, robot)
    own = time.process_time() - begin
    free, weak = _peers(full).values()
    equal = regression(rows, windows.fit, G, weak)
    gravity = robot.gravity
    methods: dict[str, Callable[[], Fit | None]] = {
        'least squares': lambda: Fit(*fitted(rows, windows.fit, G, free)[:2]),
        'semidefinite': lambda: Fit(*fitted(rows, windows.fit, G, weak)[:2]),
        'figaroh': lambda: rivals.figaroh(arm, equal, weak),
        'mujoco.sysid': lambda: rivals.mujoco_sysid(
            arm, rows, windows.fit, equal, full, gravity
        ),
    }
    fits: dict[str, Fit | None] = {'URDF': Fit(full.mean, arm.covariance)}
    for name, method in methods.items():
        if name not in rivals.MISSING:
            begin = time.process_time()
            fits[name] = method()
            seconds[name] = seconds['URDF'] + time.process_time() - begin
    seconds['identify'] = own
    fits['identify'] = Fit(trained.values, arm.covariance)
    delay = float(trained.values[-1])
    motions = rollouts_of(
        entry.recording._replace(torque=rows.torque), rows, windows.test, delay
    )
    figures: dict[str, dict[str, float]] = {kind: {} for kind in _TABLES}
    figures['seconds'] = seconds
    for name, fit in fits.items():
        if fit is None:
            continue
        values = fit.values
        error = scored(rows, windows, G, full.mean, values).total[2]
        figures['torque'][name] = error
        figures['rollout'][name] = rollout_error(
            arm, values, rows, windows, motions, gravity
        )
        if entry.truth:
            of_all = arm.values if name == 'identify' else values
            other = arm._replace(values=of_all, covariance=fit.covariance)
            covered = 100.0 * float(np.mean(is_covered(other, entry.truth)))
            figures['covered'][name] = covered
    if entry.taken.published:
        rows.set_sliding(np.zeros(rows.speed.size))  # theirs slides at once
        test = windows.test
        u = rows.u(delay)[test]
        off = entry.taken.published(rows, robot)[test] - u
        figures['torque']['published'] = float(
            100.0 * np.linalg.norm(off) / np.linalg.norm(u)
        )
    if not last_only:
        figures['fifths'] = _of_fifths(problem)
    figures['torque']['URDF'], figures['torque']['its URDF'] = arm.score.total[:2]
    return Result(entry.taken.name, figures, _terms(arm))


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
            values = fitted(rows, fit, G, prior).values
            off = rows.torques(test, (G @ values)[:-1]) - rows.u(values[-1])[test]
            squares[name] = squares.get(name, 0.0) + float(np.sum(off**2))
        total += float(np.sum(rows.u(0.0)[test] ** 2))
    return {name: 100.0 * np.sqrt(each / total) for name, each in squares.items()}


def _peers(full: Prior) -> dict[str, Prior]:
    """Return the priors of least squares, and of semidefinite least squares."""
    free = full.widened(np.full(full.mean.size, _NONE))._replace(cones=[])
    weak = full.widened(np.full(full.mean.size, _WEAK))
    return {'least squares': free, 'semidefinite': weak}


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
        values, deviations = found.load
        interval = f'{values[0]:.3f} +- {1.96 * deviations[0]:.2g} kg'
        texts.append(f'{interval} from {found.picked_up:.1f} s on')
    return f'{taken.name} with {mass:.3f} kg: {texts[0]}; as one bag: {texts[1]}'


if __name__ == '__main__':
    main()
