# SPDX-License-Identifier: Apache-2.0
"""Ten thousand arms that change at random, each with and without learning: `make changes`.

Runs the study `config/monte_carlo_events.yaml` twice, with the same arms and events. Prints how
many runs kept the bound, and each run that kept it only with or only without learning; plots them
in `changes.png`. An interrupted study resumes.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter

from blf_dsc_controller.analysis.style import ALARM, BLUE, INK, MUTED, ORANGE, Picture, head
from blf_dsc_controller.cli.main import main as blf_dsc
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.monte_carlo.runs import KEPT, Columns
from blf_dsc_controller.monte_carlo.statistics import worst_ratio
from blf_dsc_controller.monte_carlo.store import Store
from blf_dsc_controller.monte_carlo.study import Study, load_study, write_study

WITH, WITHOUT = 'with', 'without'
PRESET = Path(__file__).parents[1] / 'config/monte_carlo_events.yaml'


def studies(config: Path, overrides: dict[str, Any]) -> dict[str, Study]:
    """Return the study of a file, with and without composite learning."""
    study = load_study(config, overrides)
    without = change(study.controller, {'learning.weight': 0.0})
    return {WITH: study, WITHOUT: dataclasses.replace(study, controller=without)}


def computed(study: Study, folder: Path) -> Columns:
    """Return the results of a study in a folder, computing those that are missing."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    file = folder.with_suffix('.yaml')
    write_study(study, file)
    code = blf_dsc(['monte-carlo', '--config', str(file), '--out', str(folder)])
    if code:
        sys.exit(code)
    return Store(folder).results()


def exceptions(results: dict[str, Columns]) -> dict[str, list[int]]:
    """Return the runs that kept the bound only with learning, and only without."""
    kept = {name: each['outcome'] == KEPT for name, each in results.items()}
    return {
        WITH: np.flatnonzero(kept[WITH] & ~kept[WITHOUT]).tolist(),
        WITHOUT: np.flatnonzero(kept[WITHOUT] & ~kept[WITH]).tolist(),
    }


def report(study: Study, results: dict[str, Columns], folder: Path) -> str:
    """Return a text: runs that kept the bound, and each run that differs, with its events."""
    lines = []
    for name, each in results.items():
        kept = int((each['outcome'] == KEPT).sum())
        lines.append(f'{name} learning: {kept} of {each["outcome"].size} runs kept the bound')
    for name, runs in exceptions(results).items():
        lines.append(f'kept only {name} learning: {len(runs)}')
        for run in runs:
            drawn = [
                f'{one.column.removeprefix("plant.events.")} {results[name][one.column][run]:.4g}'
                for one in study.variations
                if one.distribution.name != 'choice'
            ]
            lines.append(f'  run {run}: {", ".join(drawn)}')
            other = folder / (WITHOUT if name == WITH else WITH)
            lines.append(f'    blf_dsc monte-carlo --reproduce {other} {run}')
    return '\n'.join(lines) + '\n'


def draw(study: Study, results: dict[str, Columns], path: Path) -> None:
    """Plot the largest errors with and without learning against each other, and the rms errors."""
    shares = [
        f'{100 * (each["outcome"] == KEPT).mean():.4g} % {name}' for name, each in results.items()
    ]
    runs = results[WITH]['outcome'].size
    title = f'{runs} arms that change: the bound was kept by {" and ".join(shares)} learning'
    picture = Picture(1, 2, title, (6.2, 3.8), share_time=False)
    largest, rms = picture.axes[0]

    ratios = {name: worst_ratio(study, each) for name, each in results.items()}
    lost = (results[WITH]['outcome'] != KEPT) | (results[WITHOUT]['outcome'] != KEPT)
    top = 1.05 * max(1.0, *(each[np.isfinite(each)].max() for each in ratios.values()))
    for chosen, colour, size in ((~lost, BLUE, 3.0), (lost, ALARM, 7.0)):
        x, y = (np.minimum(ratios[name][chosen], top) for name in (WITHOUT, WITH))
        largest.plot(x, y, '.', ms=size, color=colour, alpha=0.5, mew=0)
    largest.plot([0.0, top], [0.0, top], color=MUTED, lw=1.0, label='equal')
    largest.axhline(1.0, color=INK, ls='--', lw=1.0, label='bound')
    largest.axvline(1.0, color=INK, ls='--', lw=1.0)
    largest.set_xlabel(r'max $|\xi_1| \; / \; k_c$ without learning')
    largest.set_ylabel('with learning')
    head(largest, 'largest error of each run')

    for (name, each), colour in zip(results.items(), (BLUE, ORANGE), strict=True):
        squares = sum(each[f'rms_error_rad.{joint}'] ** 2 for joint in study.plant.joints)
        _histogram(rms, 1e3 * np.sqrt(squares), f'{name} learning', colour)
    rms.set_xlabel(rf'rms $\xi_1$ of both joints from {study.settings.settled_after:g} s on [mrad]')
    rms.set_ylabel('fraction of runs')
    head(rms, 'rms error')
    picture.save(path)


def _histogram(axes: Axes, values: np.ndarray, label: str, colour: str) -> None:
    known = values[np.isfinite(values) & (values < 1.0)]
    weights = np.full(known.size, 1.0 / max(1, values.size))
    bins = np.linspace(0.0, 0.25, 61).tolist()
    axes.hist(known, bins, weights=weights, histtype='stepfilled', color=colour, alpha=0.25)
    axes.hist(known, bins, weights=weights, histtype='step', color=colour, lw=1.4, label=label)
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f'{100 * value:g} %'))


def main(arguments: list[str] | None = None) -> None:
    """Compute, print and plot the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--config', type=Path, default=PRESET)
    parser.add_argument('--runs', type=int)
    parser.add_argument('--out', type=Path, default=Path('out/changes'))
    options = parser.parse_args(arguments)
    overrides = {} if options.runs is None else {'runs': options.runs}
    both = studies(options.config, overrides)
    results = {name: computed(study, options.out / name) for name, study in both.items()}
    text = report(both[WITH], results, options.out)
    (options.out / 'changes.txt').write_text(text, encoding='utf-8')
    draw(both[WITH], results, options.out / 'changes.png')
    print(text, end='')


if __name__ == '__main__':
    main()
