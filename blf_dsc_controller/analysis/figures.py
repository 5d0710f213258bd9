# SPDX-License-Identifier: Apache-2.0
"""All pictures of a run."""

from __future__ import annotations

from pathlib import Path

from blf_dsc_controller.analysis.monitors_figure import draw_monitors
from blf_dsc_controller.analysis.parameters_figure import draw_parameters
from blf_dsc_controller.analysis.tracking_figure import draw_tracking
from blf_dsc_controller.run import Run


def draw(run: Run, folder: Path) -> list[Path]:
    """Draw tracking.png and what else the run tells of, and return the paths.

    parameters.png if something was learned, monitors.png if the monitors were recorded.
    """
    written = [folder / 'tracking.png']
    draw_tracking(run, written[0])
    for name, picture in (
        ('parameters.png', draw_parameters),
        ('monitors.png', draw_monitors),
    ):
        if picture(run, folder / name):
            written.append(folder / name)
    return written
