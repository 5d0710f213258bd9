# SPDX-License-Identifier: Apache-2.0
"""Report of studies: lines for the terminal, and a table of several studies of pairs."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.studies.pairs_picture import draw_pairs
from blf_dsc_controller.studies.runs import Store
from blf_dsc_controller.studies.summary import (
    ALLOWED,
    Summary,
    summarize,
)
from blf_dsc_controller.writing import write_text


def format_report(summary: Summary, folder: Path) -> str:
    """Format a summary for the terminal, with a command to repeat the worst run."""
    outcomes = (
        f'{count} {outcome}' for outcome, count in summary['outcomes'].items() if count
    )
    share, low, high = map(_percent, summary['kept'].values())
    runs = {'the worst': [each['run'] for each in summary['worst']]}
    lines = [
        f'{share} of the runs kept the bound (95 % confidence: {low} to {high})',
        f'outcomes    {", ".join(outcomes)}',
    ]
    if summary['pairs'] is not None:
        lines += [f'{title}: {figure}' for title, figure in summary['table'].items()]
        runs['bound broken only with learning'] = summary['pairs']['broken_only_with']
        runs[f'error above {ALLOWED:g} times that without'] = summary['pairs']['above']
    lines += [
        f'{what}: {", ".join(map(str, each))}' for what, each in runs.items() if each
    ]
    worst = runs['the worst'][0]
    out = shlex.quote(f'{folder.name}-run-{worst}')
    command = f'blf_dsc monte-carlo --reproduce {shlex.quote(str(folder))} {worst} --out {out}'
    return '\n'.join([*lines, f'one again   {command}'])


def _percent(fraction: float) -> str:
    return f'{100 * fraction:.4g} %'


def write_comparison(stores: Sequence[Store], folder: Path) -> str:
    """Write changes.png and changes.md for studies of pairs; return the table."""
    found = {store.folder.name: (store.study, store.results()) for store in stores}
    rows = []
    for name, (study, results) in found.items():
        if not study.settings.pairs:
            raise BlfDscError(f'{name} holds no pairs: its study needs pairs: true')
        summary = summarize(study, results)
        rows.append({'study': name, 'runs': f'{summary["runs"]}'} | summary['table'])
    draw_pairs(found, folder / 'changes.png')
    lines = [rows[0], ['---'] * len(rows[0]), *(row.values() for row in rows)]
    text = ''.join(f'| {" | ".join(line)} |\n' for line in lines)
    write_text(folder / 'changes.md', text)
    return text
