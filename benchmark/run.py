# SPDX-License-Identifier: Apache-2.0
"""Run all benchmarks, with interleaved measurements, and write a table.

Usage: python benchmark/run.py [GROUP ...]   (--help lists the groups)
"""

from __future__ import annotations

import argparse
import datetime as dt
import importlib
import importlib.metadata
import platform
from itertools import groupby
from pathlib import Path

from harness import Ratio, table_lines

from blf_dsc_controller import __version__

_GROUPS = {  # module and function of each
    'offline': ('offline', 'measure'),
    'montecarlo': ('offline', 'measure_study'),
    'growth': ('growth', 'measure'),
    'replay': ('offline', 'measure_replay'),
    'node': ('nodes', 'measure'),
    'startup': ('nodes', 'measure_start'),
}
_HERE = Path(__file__).parent
_PACKAGES = ('numpy', 'numba', 'scipy', 'mujoco', 'pin', 'ros-jazzy-rclpy')


def machine() -> str:
    """Describe the machine and the versions, without the host name."""
    model = 'unknown processor'
    for line in Path('/proc/cpuinfo').read_text().splitlines():
        if line.startswith('model name'):
            model = line.split(':', 1)[1].strip()
    cores = sum(
        line.startswith('processor') for line in Path('/proc/cpuinfo').read_text().split('\n')
    )
    versions = [f'Python {platform.python_version()}', f'blf_dsc_controller {__version__}']
    for package in _PACKAGES:
        try:
            versions.append(f'{package} {importlib.metadata.version(package)}')
        except importlib.metadata.PackageNotFoundError:
            versions.append(f'{package} absent')
    return f'{model}, {cores} cores, {platform.system()}; ' + ', '.join(versions)


def table(rows: list[Ratio]) -> str:
    """Return Markdown with a table for each group."""
    lines: list[str] = []
    for group, members in groupby(rows, key=lambda row: row.group):
        cells = (
            (
                row.what,
                f'**{row.median:.3g}**',
                f'{row.low:.3g} to {row.high:.3g}',
                row.baseline,
                row.note,
            )
            for row in members
        )
        heads = ('what', 'ratio', 'range', 'to', '')
        lines += ['', f'## {group}', '', *table_lines(heads, cells)]
    return '\n'.join(lines) + '\n'


def main() -> None:
    """Run the groups and write RESULTS.md."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument('groups', nargs='*', metavar='GROUP', help=', '.join(_GROUPS))
    options.add_argument('--out', type=Path, default=_HERE, help='folder for the results')
    chosen = options.parse_args()
    chosen.out.mkdir(parents=True, exist_ok=True)
    rows: list[Ratio] = []
    for name in chosen.groups or _GROUPS:
        print(f'measuring: {name}', flush=True)
        module, function = _GROUPS[name]
        for row in getattr(importlib.import_module(module), function)():
            print(f'  {row.what}: {row.median:.3g} times {row.baseline}  {row.note}', flush=True)
            rows.append(row)
    today = dt.datetime.now(dt.timezone.utc).date()
    text = (
        '# Results of the benchmarks\n\n'
        f'Written by `make bench` on {today}. Every figure is a ratio of two things measured in '
        'turns in\nthe same run: median and range of its rounds. Absolute times are notes about '
        f'one machine.\n\n{machine()}\n' + table(rows)
    )
    (chosen.out / 'RESULTS.md').write_text(text, encoding='utf-8')
    print(f'written: {chosen.out / "RESULTS.md"}')


if __name__ == '__main__':
    main()
