# SPDX-License-Identifier: Apache-2.0
"""The loop, the node and the wire against their peers, each measured in turns.

python -m benchmark bench [GROUP ...] [--out FOLDER]
"""

from __future__ import annotations

import argparse
import datetime as dt
import importlib
from itertools import groupby
from pathlib import Path

from benchmark.harness import Ratio, machine, print_table

_GROUPS = {  # module and function of each
    'offline': ('offline', 'measure'),
    'growth': ('offline', 'measure_growth'),
    'guarded': ('guarded', 'measure'),
    'node': ('nodes', 'measure'),
    'startup': ('nodes', 'measure_start'),
    'wire': ('wire', 'measure'),
}
_HERE = Path(__file__).parent


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument(
        'groups', nargs='*', type=_group, metavar='GROUP', help=', '.join(_GROUPS)
    )
    parser.add_argument(
        '--out',
        type=Path,
        help='folder for RESULTS.md (benchmark, if all are measured)',
    )


def _group(name: str) -> str:
    if name not in _GROUPS:
        raise argparse.ArgumentTypeError(f'got {name}: give of {", ".join(_GROUPS)}')
    return name


def main(options: argparse.Namespace) -> None:
    """Run the groups and write RESULTS.md."""
    out = options.out or (None if options.groups else _HERE)
    rows: list[Ratio] = []
    for name in options.groups or _GROUPS:
        print(f'measuring: {name}', flush=True)
        module, function = _GROUPS[name]
        for row in getattr(importlib.import_module(f'benchmark.{module}'), function)():
            print(
                f'  {row.what}: {row.median:.3g} times {row.baseline}  {row.note}',
                flush=True,
            )
            rows.append(row)
    if out is not None:
        _write(rows, out)


def _write(rows: list[Ratio], out: Path) -> None:
    """Write RESULTS.md into a folder, which loses what it had."""
    out.mkdir(parents=True, exist_ok=True)
    today = dt.datetime.now(dt.timezone.utc).date()
    with (out / 'RESULTS.md').open('w', encoding='utf-8') as file:
        file.write(
            '# Results of the benchmarks\n\n'
            f'Written by `make bench` on {today}. Every figure is a ratio of two things measured '
            'in turns in\nthe same run: median and range of its rounds. Absolute times are notes '
            f'about one machine.\n\n{machine()}\n'
        )
        for group, members in groupby(rows, key=lambda row: row.group):
            file.write(f'\n## {group}\n\n')
            cells = (
                (
                    row.what,
                    f'**{row.median:.3g}**',
                    f'{row.low:.3g} to {row.high:.3g}',
                    *row[-2:],
                )
                for row in members
            )
            print_table(('what', 'ratio', 'range', 'to', ''), cells, file)
    print(f'written: {file.name}')
