# SPDX-License-Identifier: Apache-2.0
"""The comparison of the paper as a folder: runs, figures, claims, tables, and a page of all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, fields
from pathlib import Path

from blf_dsc_controller.analysis.page import Cell, Figure, Page, Paragraph, Section, Table
from blf_dsc_controller.configuration.params_file import dump
from blf_dsc_controller.paper import tune
from blf_dsc_controller.paper.cases import CASES, SIDE_BY_SIDE
from blf_dsc_controller.paper.claims import FAILS, HOLDS, ONLY_IF, Claim, claims
from blf_dsc_controller.paper.figures import draw_figure_2, draw_figure_3, draw_robustness
from blf_dsc_controller.paper.results import (
    HEADER,
    Results,
    kept_bounds,
    run_all,
    side_by_side,
    write_csv,
    write_tables,
)
from blf_dsc_controller.supervision.config_warnings import config_warnings

PAIRS = {
    'tuned': (
        'both laws tuned by the same procedure',
        {'proposed': 'paper_tuned', 'comparison': 'comparison'},
    ),
    'low_gains': (
        "the paper's choices against a comparison with low gains",
        {'proposed': 'paper', 'comparison': 'comparison_detuned'},
    ),
    'recommended': (
        'the recommended form against the tuned comparison',
        {'recommended': 'recommended', 'comparison': 'comparison'},
    ),
}
_STYLES = {HOLDS: 'good', ONLY_IF: 'partly', FAILS: 'bad'}


def compare(folder: Path) -> list[Claim]:
    """Run every case, write the report into an empty folder and return the claims."""
    keep_configurations(folder / 'configurations')
    results = run_all()
    found = claims(results)
    write_tables(results, folder)
    names = [field.name for field in fields(Claim)]
    write_csv(folder / 'claims.csv', names, (astuple(claim) for claim in found))
    Page(
        'The paper, side by side',
        [
            Paragraph(
                'Section IV of the paper, run offline with the kernels that the ROS 2 node runs. '
                'Made by `blf_dsc paper`. Values of two joints are written joint1 / joint2.'
            )
        ],
        _sections(results, found, folder),
    ).write(folder / 'index.html')
    return found


def keep_configurations(folder: Path) -> None:
    """Write every parameter of each case as it is run."""
    folder.mkdir()
    for case in CASES:
        dump(folder / f'{case.name.replace(" ", "_")}.yaml', case.loop().by_node)


def draw(results: Results, folder: Path) -> list[Figure]:
    """Draw Fig. 2 and 3 of each pair of laws."""
    figures = []
    for name, (caption, pair) in PAIRS.items():
        runs = {label: results.run(case) for label, case in pair.items()}
        for number, draw_figure, note in (
            (2, draw_figure_2, '. Shaded: within the bound'),
            (3, draw_figure_3, ''),
        ):
            path = folder / f'figure_{number}_{name}.png'
            draw_figure(f'Fig. {number}, {caption}', runs, path)
            figures.append(Figure(path, f'Fig. {number}: {caption}{note}.'))
    return figures


def _sections(results: Results, found: Sequence[Claim], folder: Path) -> list[Section]:
    tracking, learning = draw_robustness(results, folder)
    presets = ', '.join(f'{case.label}: {case.preset}' for case in SIDE_BY_SIDE)
    header, rows = kept_bounds(results)
    return [
        Section('Claims', [_claims_table(found)]),
        Section(
            'Laws',
            [
                Table(HEADER, side_by_side(results), numeric=True),
                Paragraph(
                    f'Presets, each of which blf_dsc run --offline --config PRESET runs by '
                    f'itself: {presets}. The torque rate is the rms of the change per sample over '
                    f'the sample time.'
                ),
            ],
        ),
        Section('Configuration warnings', [Paragraph(text) for text in warnings()]),
        Section('What was equalised', [Paragraph(text) for text in equalised()]),
        Section('Figures', draw(results, folder)),
        Section(
            'Where each law breaks',
            [
                Table(header, rows, numeric=True),
                Figure(
                    tracking,
                    'Largest error of 30 s in units of the bound, which is the red line; points '
                    'at the upper edge have diverged. One condition is changed at a time.',
                ),
                Figure(
                    learning,
                    'Parameter error; grey: 1 %. Laws without a window are not in the last panel.',
                ),
            ],
        ),
        Section(
            'Files',
            [
                Paragraph(
                    f'side_by_side.csv, claims.csv, robustness.csv and metrics.json hold the '
                    f'numbers, configurations/ every parameter of the {len(results.by_case)} runs '
                    f'as files for blf_dsc run --config. Beside this page in {folder.name}/.'
                )
            ],
        ),
    ]


def _claims_table(found: Sequence[Claim]) -> Table:
    rows = [
        (
            claim.where,
            claim.says,
            claim.measured,
            Cell(claim.full_verdict, _STYLES[claim.verdict]),
            Cell(claim.command, 'code'),
        )
        for claim in found
    ]
    return Table(('where', 'says', 'measured', 'verdict', 'shown by'), rows)


def warnings() -> list[str]:
    """Configuration warnings of the side-by-side cases."""
    found = [
        f'{case.label}: {warning}'
        for case in SIDE_BY_SIDE
        for warning in config_warnings(case.loop().controller)
    ]
    return found or ['There are none.']


def equalised() -> list[str]:
    """What the compared laws have in common, and what they have not."""
    evaluations = tune.POPULATION * (tune.GENERATIONS + 1)
    sizes = ', '.join(f'{len(task.gains)} for {name}' for name, task in tune.TASKS.items())
    same = (
        'All laws have the same arm, disturbance, reference, start, first estimate (half the '
        'truth), sample time and torque limit (20 N m), and the same projection of the estimate.'
    )
    tuned = (
        f'Gains called tuned come from one procedure (python -m blf_dsc_controller.paper.tune): '
        f"scipy's differential evolution, seed {tune.SEED}, {evaluations} evaluations of two runs "
        f'of {tune.DURATION:g} s each, with exact sensors and with the sensors and delay of the '
        f'preset noisy. The objective adds the decades of the largest and the rms error and of '
        f'the parameter error; leaving the bound, and a torque that changes by more than '
        f'{tune.ROUGHEST:g} N m rms from sample to sample, cost ten times as much. '
        f'Gains searched: {sizes}; those that laws share have the same ranges.'
    )
    different = (
        'Not equal: the proposed law knows its bound, the comparison does not; the comparison '
        'needs the second derivative of the reference, the proposed law does not.'
    )
    return [same, tuned, different]
