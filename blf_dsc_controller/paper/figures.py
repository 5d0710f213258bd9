# SPDX-License-Identifier: Apache-2.0
"""Fig. 2 (a)-(f) and Fig. 3 as the paper draws them: the proposed law and the comparison."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from blf_dsc_controller.analysis.envelope import envelope
from blf_dsc_controller.analysis.style import (
    ALARM,
    BLUE,
    INK,
    MUTED,
    ORANGE,
    SHADE,
    Picture,
    formula,
    head,
)
from blf_dsc_controller.arms.two_link import PARAMETER_NAMES
from blf_dsc_controller.paper.metrics import Courses

_MILLI = 1e3
_TRACKING = (6.4, 2.5)  # inches
_ESTIMATES = (8.6, 2.4)
_COLOURS = (BLUE, ORANGE)
_WIDTHS = (5.0, 2.4)  # where the curves lie upon each other
_LETTERS = ('(a)', '(b)', '(c)', '(d)', '(e)', '(f)')


def draw_figure_2(
    title: str, courses: Mapping[str, Courses], bound: np.ndarray, until: float, path: Path
) -> None:
    """Positions, errors within their bound, and torques of both joints, up to a time [s]."""
    picture = Picture(3, 2, title, _TRACKING)
    for letter, axes in zip(_LETTERS, picture.axes.flat, strict=True):
        row, i = divmod(_LETTERS.index(letter), 2)
        (_positions, _errors, _torques)[row](axes, courses, i, until, float(bound[i]))
        head(axes, f'{letter} {("position", "tracking error", "torque")[row]} of joint {i + 1}')
    picture.save(path)


def _positions(
    axes: Axes, courses: Mapping[str, Courses], i: int, until: float, _bound: float
) -> None:
    for (name, one), colour, width in zip(courses.items(), _COLOURS, _WIDTHS, strict=False):
        shown = one.time <= until
        values = envelope(one.time[shown], one.position[shown, i])
        axes.plot(*values, color=colour, lw=width, label=name if i == 0 else None)
    one = next(iter(courses.values()))
    shown = one.time <= until
    reference = envelope(one.time[shown], one.reference[shown, i])
    axes.plot(*reference, color=INK, lw=1.0, ls='--', label=None if i == 0 else 'reference')
    axes.set_ylabel('[rad]')


def _errors(axes: Axes, courses: Mapping[str, Courses], i: int, until: float, bound: float) -> None:
    axes.axhspan(-_MILLI * bound, _MILLI * bound, color=SHADE, lw=0)
    for sign in (-1.0, 1.0):
        axes.axhline(sign * _MILLI * bound, color=ALARM, lw=1.1, ls='--')
    for (_, one), colour in zip(courses.items(), _COLOURS, strict=False):
        shown = one.time <= until
        values = envelope(one.time[shown], _MILLI * one.error[shown, i])
        axes.plot(*values, color=colour, lw=1.2)
    axes.set_ylabel('[mrad]')


def _torques(
    axes: Axes, courses: Mapping[str, Courses], i: int, until: float, _bound: float
) -> None:
    for (_, one), colour in zip(courses.items(), _COLOURS, strict=False):
        shown = one.time <= until
        axes.plot(*envelope(one.time[shown], one.torque[shown, i]), color=colour, lw=1.1, alpha=0.8)
    axes.set_ylabel('[N m]')


def draw_figure_3(title: str, courses: Mapping[str, Courses], path: Path) -> None:
    """Estimates of each parameter beside its true value."""
    picture = Picture(len(PARAMETER_NAMES), 1, title, _ESTIMATES)
    for j, (name, axes) in enumerate(zip(PARAMETER_NAMES, picture.axes.flat, strict=True)):
        for (label, one), colour in zip(courses.items(), _COLOURS, strict=False):
            values = envelope(one.time, one.estimate[:, j])
            axes.plot(*values, color=colour, lw=1.8, label=label if j == 0 else None)
        true = next(iter(courses.values())).truth[j]
        axes.axhline(true, color=MUTED, lw=1.2, ls='--', label='true' if j == 0 else None)
        axes.set_ylabel('[kg m²]')
        head(axes, formula(name))
    picture.save(path)
