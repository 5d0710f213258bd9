# SPDX-License-Identifier: Apache-2.0
"""Random arms that change, each with and without learning, in one table: `make changes`.

Runs the five studies of pairs, and those without learning again with other sensor noise, which
shows how many exceptions chance makes. Interrupted studies resume. Writes `changes.md`, with the
command that repeats each exception, and `changes.png`.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from harness import table_lines
from scipy.stats import binomtest

from blf_dsc_controller.cli.main import main as blf_dsc
from blf_dsc_controller.studies.monte_carlo import Study
from blf_dsc_controller.studies.report import (
    LAWS,
    Summary,
    compare,
    draw_pairs,
    exceptions,
    summarize,
)
from blf_dsc_controller.studies.runs import Columns, Store

STUDIES = {
    'monte_carlo_events': 'two links',
    'monte_carlo_panda': 'Panda',
    'monte_carlo_panda_500hz': 'Panda, 500 Hz',
    'monte_carlo_ur5e': 'UR5e',
    'monte_carlo_ur5e_500hz': 'UR5e, 500 Hz',
}
_HEADER = (
    'arm',
    'runs',
    'bound kept with learning / without',
    'broken only with / only without',
    'of those kept without, 95 % interval',
    'near the bound: error larger / smaller with',
    'largest error at most 1.3 times that without',
    'other noise instead of learning: broken only with / only without, at most 1.3 times',
    'factor: median, 99.9 %, largest',
    'rms error with / without [mrad]',
    'torque error on the next motion with / without [%]',
)


NOISE = """monte_carlo:
  ros__parameters: {{base: {base}, pairs: false, noise_seed: 1}}
/**/blf_dsc_controller:
  ros__parameters: {{learning: {{weight: 0.0}}}}
"""
"""A study without learning, with other sensor noise."""


def instead_of_learning(study: Study, results: Columns, noise: Columns) -> Summary:
    """Compare the runs without learning of a study with those that have other sensor noise.

    Only those that nothing breaks before learning would begin.
    """
    both = results | {name: noise[name] for name in noise if name in results}
    early = [both[f'{law}first_violation_s'] < study.settings.settled_after for law in LAWS]
    return compare(study, {name: values[~np.any(early, 0)] for name, values in both.items()})


def row(title: str, summary: Summary, by_noise: Summary) -> tuple[str, ...]:
    """Return the row of a study in the table."""
    pairs = summary['pairs']
    kept, factor, median = pairs['kept'], pairs['factor'], pairs['median']
    broken = len(pairs['broken_only_with'])
    interval = binomtest(broken, max(1, kept['without'])).proportion_ci(method='exact')
    share, chance = (
        100.0 * (1.0 - len(each['above']) / max(1, each['kept']['without']))
        for each in (pairs, by_noise)
    )
    counts = [len(by_noise[f'broken_only_{which}']) for which in ('with', 'without')]
    shown = (factor[name] for name in ('median', 'p99.9', 'max'))
    return (
        title,
        f'{summary["runs"]}',
        f'{kept["with"]} / {kept["without"]}',
        f'{broken} / {len(pairs["broken_only_without"])}',
        f'{100.0 * interval.low:.2f} to {100.0 * interval.high:.2f} %',
        ' / '.join(f'{count}' for count in pairs['near'].values()),
        f'{share:.2f} %',
        f'{counts[0]} / {counts[1]}, {chance:.2f} %',
        ', '.join('infinite' if value is None else f'{value:.2f}' for value in shown),
        *(
            ' / '.join(
                '-' if value is None else f'{unit * value:.3g}' for value in median[name].values()
            )
            for name, unit in (('rms_error_rad', 1e3), ('torque_error', 1e2))
        ),
    )


Found = dict[str, tuple[Study, Columns, Columns]]
"""Studies by name, with their results and those with other noise."""


def report(found: Found, folder: Path) -> str:
    """Return the table, and the command of each exception."""
    summaries = {name: summarize(study, pairs) for name, (study, pairs, _) in found.items()}
    rows = (
        row(STUDIES[name], summary, instead_of_learning(*found[name]))
        for name, summary in summaries.items()
    )
    lines = [*table_lines(_HEADER, rows)]
    for name, summary in summaries.items():
        for run, what, command in exceptions(summary['pairs'], folder / name):
            lines += ['', f'{STUDIES[name]}, run {run}: {what}', '', f'    {command}']
    return '\n'.join(lines) + '\n'


def main(arguments: list[str] | None = None) -> None:
    """Compute, print and plot the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--studies', nargs='+', choices=STUDIES, default=list(STUDIES))
    parser.add_argument('--runs', help='of each study (as configured)')
    parser.add_argument('--workers', help='of each study (one per core)')
    parser.add_argument('--out', type=Path, default=Path('out/changes'))
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    given = {f'--{name}': getattr(options, name) for name in ('runs', 'workers')}
    common = [word for pair in given.items() if pair[1] for word in pair]
    found: Found = {}
    for name in options.studies:
        noise = options.out / f'{name}_noise.yaml'
        noise.write_text(NOISE.format(base=name), encoding='utf-8')
        stores: list[Store] = []
        for config, folder in ((name, options.out / name), (str(noise), noise.with_suffix(''))):
            code = blf_dsc(['monte-carlo', '--config', config, '--out', str(folder), *common])
            if code:
                sys.exit(code)
            stores.append(Store(folder))
        pairs, others = stores
        found[name] = pairs.study, pairs.results(), others.results()
    text = report(found, options.out)
    (options.out / 'changes.md').write_text(text, encoding='utf-8')
    drawn = {STUDIES[name]: (study, pairs) for name, (study, pairs, _) in found.items()}
    draw_pairs(drawn, options.out / 'changes.png')
    print(text, end='')


if __name__ == '__main__':
    main()
