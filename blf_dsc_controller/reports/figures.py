# SPDX-License-Identifier: Apache-2.0
"""All pictures of a run."""

from __future__ import annotations

from pathlib import Path

from blf_dsc_controller.bags.run import Run
from blf_dsc_controller.reports.parameters_figure import draw_parameters
from blf_dsc_controller.reports.tracking_figure import draw_tracking


def draw(run: Run, folder: Path) -> list[Path]:
    """Draw tracking.png, and parameters.png if something was learned, and return their paths."""
    tracking = folder / 'tracking.png'
    parameters = folder / 'parameters.png'
    draw_tracking(run, tracking)
    return [tracking, parameters] if draw_parameters(run, parameters) else [tracking]
