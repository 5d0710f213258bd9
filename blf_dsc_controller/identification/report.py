# SPDX-License-Identifier: Apache-2.0
"""Page of an identified arm: measured and predicted torques with their residual, and tables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from blf_dsc_controller.analysis.page import write_page
from blf_dsc_controller.analysis.style import BLUE, INK, ORANGE, SHADE, Picture, head
from blf_dsc_controller.identification.identify import Identified

_PANEL = (9.0, 2.2)  # inches


def write_identified(
    found: Identified, path: Path, lines: Sequence[str], tables: Sequence[Sequence[str]]
) -> None:
    """Write the page with its lead of some lines, and tables as lines of text."""
    with TemporaryDirectory() as folder:
        picture = Path(folder) / 'torques.png'
        draw_torques(found, picture)
        write_page(
            path,
            'identified.html',
            'Identified arm',
            lines=lines,
            picture=picture,
            tables=['\n'.join(table).strip() for table in tables if table],
        )


def draw_torques(found: Identified, path: Path) -> None:
    """Draw the torque of each joint as measured and predicted; the part held back is shaded."""
    n = len(found.chain.joints)
    picture = Picture(n, 1, 'Torques: measured, predicted, residual', _PANEL)
    time = found.time.copy()
    jumps = np.flatnonzero(np.diff(time) > 2.0 * np.median(np.diff(time))) + 1
    time = np.insert(time, jumps, np.nan)  # breaks the lines at gaps and rest
    for i, (axes, joint) in enumerate(zip(picture.axes.flat, found.chain.joints, strict=True)):
        measured, predicted = (
            np.insert(values[:, i], jumps, np.nan)
            for values in (found.measured, found.predicted[2])
        )
        axes.axvspan(*found.held_back, color=SHADE, lw=0)
        axes.plot(time, measured, color=INK, label='measured')
        axes.plot(time, predicted, color=BLUE, label='predicted', linestyle='--')
        axes.plot(time, measured - predicted, color=ORANGE, label='residual', linewidth=0.9)
        axes.set_ylabel('N' if joint.kind == 'prismatic' else 'N m')
        head(axes, joint.name)
    picture.save(path)
