# SPDX-License-Identifier: Apache-2.0
"""The HTML page of an identified arm: facts, torques with their residuals, tables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from blf_dsc_controller.analysis.figures import draw_panels
from blf_dsc_controller.analysis.panels import INK, MUTED, ORANGE, Line, Mark, Panel
from blf_dsc_controller.analysis.report import write_page
from blf_dsc_controller.identification.identified import Identified
from blf_dsc_controller.identification.values import OFFSET, units_of
from blf_dsc_controller.run import Floats

_PANEL = (9.0, 2.2)  # inches
_TITLE = 'Torques of the windows: measured, predicted; below each, the residual'


def write_identified(
    path: Path, found: Identified, facts: Sequence[str], tables: Sequence[str]
) -> None:
    """Write the page, with facts (paragraphs) and tables (aligned text)."""
    with TemporaryDirectory() as folder:
        picture = Path(folder, 'torques.png')
        draw_panels(picture, _TITLE, torque_panels(found), 1, _PANEL)
        write_page(
            path,
            'identified.html',
            'Identified arm',
            lines=facts,
            picture=picture,
            tables=tables,
        )


def torque_panels(found: Identified) -> list[Panel]:
    """Return two panels of each joint: its torques, and its residual on an axis of its own."""
    score = found.score
    steps = np.diff(score.time)
    jumps = np.flatnonzero(steps > 2.0 * np.median(steps)) + 1

    def broken(values: Floats) -> Floats:
        """Return values with NaN at gaps and rest, where lines break."""
        return np.insert(values, jumps, np.nan)

    time = broken(score.time)
    begin, end = score.held_back
    marks = (Mark(begin, 'held back', MUTED, until=end),)
    panels = []
    for i, joint in enumerate(found.chain.joints):
        measured = score.measured[:, i]
        predicted = score.predicted[2, :, i]
        unit = units_of(joint.kind)[OFFSET]
        torques = [
            Line('measured', time, broken(measured)),
            Line('predicted', time, broken(predicted), INK, dashed=True),
        ]
        residual = [Line('residual', time, broken(measured - predicted), ORANGE)]
        panels.append(Panel('Motion', joint.name, unit, torques, marks=marks))
        title = f'{joint.name}: residual'
        panels.append(Panel('Motion', title, unit, residual, marks=marks))
    return panels
