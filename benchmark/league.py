# SPDX-License-Identifier: Apache-2.0
"""Models of real robots in one table: the same columns, rows and windows for all of them.

    .venv/bin/python benchmark/league.py FOLDER... [--urdf ur10.urdf]

Folders are copies of the repositories of `recordings.SOURCES`, or any with bags and a URDF.  The
errors are those of `blf_dsc identify`: of the torque on the last fifth of the motion, which no
model has seen, in % of its root mean square.  All models have every term of friction, a coupled
wrist, a delay, the contacts that `identify` selects, and joints weighted by their residuals:

least squares  no bounds, no prior
semidefinite   all bodies physical, friction not negative, and hardly any prior
identify       terms and widths of the prior selected by cross-validation
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
sys.path.append(str(Path(__file__).parents[1] / 'test'))

import tempfile
import time

import numpy as np
from harness import print_table
from recordings import SOURCES, Taken, bags_in

from blf_dsc_controller.arms.urdf import pseudo_inertia
from blf_dsc_controller.identification.identified import Identified, Score
from blf_dsc_controller.identification.identify import identify_arm
from blf_dsc_controller.identification.prior import prior_of
from blf_dsc_controller.identification.reading import read_recording
from blf_dsc_controller.identification.recording import Recording, joined
from blf_dsc_controller.identification.regression import fitted, regression
from blf_dsc_controller.identification.scoring import scored
from blf_dsc_controller.identification.values import (
    LOAD_FRICTION,
    QUADRATIC,
    STRIBECK,
    base_matrix,
)
from blf_dsc_controller.identification.windows import STILL, rows_of, split
from blf_dsc_controller.run import Floats

# times the prior's deviations: hardly any prior, and none
_WEAK, _NONE = 100.0, 1e4
_HEAD = (
    *('recording', 'URDF', 'published', 'least squares', 'semidefinite', 'identify'),
    *('its URDF', 'physical', 'CPU [s]', 'friction found'),
)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('folders', nargs='+', type=Path, metavar='FOLDER')
    parser.add_argument('--urdf', default='', help='of bags in folders without a URDF')
    options = parser.parse_args()
    weighed: list[str] = []
    with tempfile.TemporaryDirectory() as bags:
        taken = _taken(options.folders, options.urdf, Path(bags))
        print_table(_HEAD, (_row(each, weighed) for each in taken))
    print('\n'.join(['', *weighed]))


def _taken(folders: list[Path], urdf: str, bags: Path) -> Iterator[Taken]:
    for folder in folders:
        readers = (read for file, read in SOURCES.items() if (folder / file).exists())
        read = next(readers, None)
        yield from read(folder, bags) if read else bags_in(folder, urdf)


def _row(taken: Taken, weighed: list[str]) -> tuple[str, ...]:
    recording = read_recording(taken.bag, taken.robot.text, taken.joints)
    begin = time.process_time()
    found = identify_arm(recording, taken.robot)
    seconds = time.process_time() - begin
    if taken.loaded:
        weighed.append(_weigh_loaded(taken, recording, *taken.loaded))
    urdf, corrected, ours = found.score.total
    return (
        taken.name,
        f'{urdf:.2f}',
        _published(taken, recording, found),
        *(f'{score.total[2]:.2f}' for score in _peers(taken, recording, found)),
        f'{ours:.2f}',
        f'{corrected:.2f}',
        'yes' if _is_physical(found) else 'no',
        f'{seconds:.1f}',
        _terms(found),
    )


def _published(taken: Taken, recording: Recording, found: Identified) -> str:
    if not taken.published:
        return '-'
    rows = rows_of(recording, found.parameters.model)
    test = split(rows).test
    u = rows.u(found.values[-1])[test]
    error = taken.published(rows, taken.robot)[test] - u
    return f'{100.0 * np.linalg.norm(error) / np.linalg.norm(u):.2f}'


def _peers(
    taken: Taken, recording: Recording, found: Identified
) -> tuple[Score, Score]:
    """Return the scores of least squares and of semidefinite least squares."""
    n = len(recording.joints)
    signs = [-1.0 if name in found.reversed else 1.0 for name in recording.joints]
    recording = recording._replace(
        torque=np.asarray(recording.torque) * np.array(signs)
    )
    rows = rows_of(recording, found.parameters.model)
    windows = split(rows)
    rows.set_sliding(found.distances)
    largest = rows.largest_torque
    speed = np.maximum(rows.speed, STILL)
    full = prior_of(taken.robot, found.chain, largest, speed, load=False)
    G = base_matrix(found.parameters, n)

    def score(values: Floats) -> Score:
        return scored(rows, windows, G, full.mean, values)

    free = full.widened(np.full(full.mean.size, _NONE))
    problem = regression(rows, windows.fit, G, free)
    information = problem.A.T @ problem.A + np.eye(full.mean.size)
    plain = free.mean + free.D @ np.linalg.solve(information, problem.A.T @ problem.b)
    weak = full.widened(np.full(full.mean.size, _WEAK))
    return score(plain), score(fitted(rows, windows.fit, G, weak).values)


def _is_physical(found: Identified) -> bool:
    least = [np.linalg.eigvalsh(pseudo_inertia(body))[0] for body in found.parts.bodies]
    return bool(min(least) > 0.0)


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


def _weigh_loaded(taken: Taken, empty: Recording, bag: Path, mass: float) -> str:
    loaded = read_recording(bag, taken.robot.text, taken.joints)
    together, (boundary,) = joined(empty, loaded)
    texts = []
    for given in (boundary, float('nan')):
        found = identify_arm(together, taken.robot, picked_up=given)
        values, deviations = found.load
        interval = f'{values[0]:.3f} +- {1.96 * deviations[0]:.2g} kg'
        texts.append(f'{interval} from {found.picked_up:.1f} s on')
    return f'{taken.name} with {mass:.3f} kg: {texts[0]}; as one bag: {texts[1]}'


if __name__ == '__main__':
    main()
