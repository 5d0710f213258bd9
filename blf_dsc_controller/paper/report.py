# SPDX-License-Identifier: Apache-2.0
"""The whole study: run everything, draw it, judge the claims, and write the folder."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from blf_dsc_controller.configuration.params_file import dump
from blf_dsc_controller.paper import page, tune
from blf_dsc_controller.paper.cases import SIDE_BY_SIDE, VARIATIONS
from blf_dsc_controller.paper.claims import claims
from blf_dsc_controller.paper.evidence import Claim
from blf_dsc_controller.paper.figures import draw_figure_2, draw_figure_3
from blf_dsc_controller.paper.metrics import Courses
from blf_dsc_controller.paper.robustness_figure import draw_robustness
from blf_dsc_controller.paper.runs import Outcome, run_all
from blf_dsc_controller.paper.sweeps import SWEEPS
from blf_dsc_controller.paper.tables import HEADER, kept_bounds, side_by_side, write_tables
from blf_dsc_controller.supervision.config_warnings import config_warnings

TITLE = 'The paper, side by side'

PAIRS = (
    (
        'tuned',
        'both laws tuned by the same procedure',
        {'proposed': 'paper_tuned', 'comparison': 'comparison'},
    ),
    (
        'low_gains',
        "the paper's choices against a comparison with low gains",
        {'proposed': 'paper', 'comparison': 'comparison_detuned'},
    ),
    (
        'recommended',
        'the recommended form against the tuned comparison',
        {'recommended': 'recommended', 'comparison': 'comparison'},
    ),
)
_TRACKING_UNTIL = 10.0  # s


def study(folder: Path) -> list[Claim]:
    """Run the study into an empty folder and return its claims."""
    keep_configurations(folder / 'configurations')
    outcomes = run_all(
        SIDE_BY_SIDE + VARIATIONS, [case for sweep in SWEEPS for case in sweep.cases()]
    )
    found = claims(outcomes)
    write_tables(outcomes, found, folder)
    write_metrics(outcomes, folder / 'metrics.json')
    captions = draw(outcomes, folder)
    page.write_page(folder / 'index.html', TITLE, *content(outcomes, found, folder, captions))
    return found


def keep_configurations(folder: Path) -> None:
    """Write every parameter of each case, and of each run of the sweeps, as it is run."""
    folder.mkdir()
    sweeps = [case for sweep in SWEEPS for case in sweep.cases()]
    for case in (*SIDE_BY_SIDE, *VARIATIONS, *sweeps):
        dump(folder / f'{case.name.replace(" ", "_")}.yaml', case.loop().by_node)


def write_metrics(outcomes: Mapping[str, Outcome], path: Path) -> None:
    """Write the numbers of every run as JSON."""
    plain = {
        name: outcome.metrics.plain() if outcome.metrics else {'failure': outcome.failure}
        for name, outcome in sorted(outcomes.items())
    }
    path.write_text(json.dumps(plain, indent=1) + '\n', encoding='utf-8')


def draw(outcomes: Mapping[str, Outcome], folder: Path) -> dict[Path, str]:
    """Draw all pictures; paths and captions."""
    bound = np.array(SIDE_BY_SIDE[0].loop().controller.barrier.bound)
    captions = {}
    for name, caption, pair in PAIRS:
        courses = {label: _courses(outcomes, case) for label, case in pair.items()}
        figure_2, figure_3 = folder / f'figure_2_{name}.png', folder / f'figure_3_{name}.png'
        draw_figure_2(f'Fig. 2, {caption}', courses, bound, _TRACKING_UNTIL, figure_2)
        draw_figure_3(f'Fig. 3, {caption}', courses, figure_3)
        captions[figure_2] = f'Fig. 2 (a)-(f): {caption}. Red: the bound.'
        captions[figure_3] = f'Fig. 3: {caption}.'
    tracking, learning = draw_robustness(outcomes, folder)
    captions[tracking] = (
        'Largest error of 30 s in units of the bound, which is the red line; what lies at the '
        'upper edge has lost the arm. One condition is changed at a time.'
    )
    captions[learning] = (
        'Parameter error; grey: 1 %. The laws without a window are not in the last panel.'
    )
    return captions


def _courses(outcomes: Mapping[str, Outcome], name: str) -> Courses:
    courses = outcomes[name].courses
    assert courses is not None, name  # noqa: S101 - they are kept for all side-by-side cases
    return courses


def content(
    outcomes: Mapping[str, Outcome],
    found: list[Claim],
    folder: Path,
    captions: Mapping[Path, str],
) -> list[str]:
    """Sections of the page."""
    pictures = {path: page.picture(path, caption) for path, caption in captions.items()}
    figures = [picture for path, picture in pictures.items() if path.name.startswith('figure')]
    robust = [picture for path, picture in pictures.items() if path.name.startswith('robust')]
    names = ', '.join(f'{case.label}: {case.preset}' for case in SIDE_BY_SIDE)
    return [
        page.paragraphs(
            'Section IV of the paper, run offline with the kernels that the ROS 2 node runs. '
            'Made by the command paper_study. Numbers of two joints are written joint1 / joint2.'
        ),
        page.section('Claims', page.claims_table(found)),
        page.section(
            'Laws',
            page.table(HEADER, side_by_side(outcomes)),
            page.paragraphs(
                f'Presets, each of which closed_loop --offline --config PRESET runs by itself: '
                f'{names}. The torque rate is the rms of the change per sample over the sample '
                f'time.'
            ),
        ),
        page.section('Warnings before the start', page.paragraphs(*warnings())),
        page.section('What was equalised', page.paragraphs(*equalised())),
        page.section('Figures', *figures),
        page.section('Where each law breaks', page.table(*kept_bounds(outcomes)), *robust),
        page.section(
            'Files',
            page.paragraphs(
                f'side_by_side.csv, claims.csv, robustness.csv and metrics.json hold the numbers, '
                f'configurations/ every parameter of the {len(outcomes)} runs as files that '
                f'closed_loop takes with --config. Beside this page in {folder.name}/.'
            ),
        ),
    ]


def warnings() -> list[str]:
    """What the feasibility checks say of the side-by-side cases."""
    found = [
        f'{case.label}: {warning}'
        for case in SIDE_BY_SIDE
        for warning in config_warnings(case.loop().controller)
    ]
    return found or ['None of these configurations is warned of.']


def equalised() -> list[str]:
    """What the compared laws have in common, in words."""
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
