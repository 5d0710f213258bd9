# SPDX-License-Identifier: Apache-2.0
"""The picture of the tracking, after the paper's Fig. 2: a column of panels for each joint."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from blf_dsc_controller.analysis.envelope import envelope
from blf_dsc_controller.analysis.style import ALARM, BLUE, INK, MUTED, ORANGE, SHADE, Picture, head
from blf_dsc_controller.run import Floats, Run

_MILLI = 1e3
_PANEL = (6.2, 2.6)  # inches


def draw_tracking(run: Run, path: Path) -> None:
    """Draw what the run tells of positions, errors within their bound, and torques."""
    panels: list[Callable[[Axes, Run, int], None]] = [_position]
    if run.error is not None:
        panels.append(_error)
    if np.isfinite(run.torque).any():
        panels.append(_torque)
    picture = Picture(len(panels), len(run.joints), _title(run), _PANEL)
    for row, panel in zip(picture.axes, panels, strict=True):
        for i, axes in enumerate(row):
            panel(axes, run, i)
    picture.save(path)


def _title(run: Run) -> str:
    if run.error is None or run.bound is None:
        return f'Motion over {run.duration:.4g} s'
    verdict = 'held' if not (np.abs(run.error) >= run.bound).any() else 'VIOLATED'
    return f'Tracking over {run.duration:.4g} s: bound {verdict}'


def _position(axes: Axes, run: Run, i: int) -> None:
    axes.plot(*envelope(run.time, run.position[:, i]), color=BLUE, lw=3.2, alpha=0.55, label='$q$')
    if run.reference is not None:
        axes.plot(
            *envelope(run.time, run.reference[:, i]), color=INK, lw=1.2, ls='--', label='$q_r$'
        )
    axes.set_ylabel('position [rad]')
    head(axes, run.joints[i])


def _error(axes: Axes, run: Run, i: int) -> None:
    assert run.error is not None  # noqa: S101 - the panel is drawn only then
    error = _MILLI * run.error[:, i]
    if run.bound is not None:
        _shade(axes, run.time, _MILLI * run.bound[:, i])
        _mark_violation(axes, run, i)
    axes.plot(*envelope(run.time, error), color=BLUE, lw=1.1, label=r'$\xi_1$')
    axes.set_ylabel('error [mrad]')
    head(axes, _error_title(error[np.isfinite(error)]))


def _shade(axes: Axes, time: Floats, bound: Floats) -> None:
    changes = np.flatnonzero(np.diff(bound)) + 1
    corners = np.unique(np.concatenate([[0], changes - 1, changes, [bound.size - 1]]))
    x, y = time[corners], bound[corners]
    axes.fill_between(x, -y, y, color=SHADE, lw=0)
    axes.plot(x, y, color=MUTED, lw=1.2, ls='--', label=r'bound $\pm k_c$')
    axes.plot(x, -y, color=MUTED, lw=1.2, ls='--')


def _mark_violation(axes: Axes, run: Run, i: int) -> None:
    assert run.error is not None  # noqa: S101
    assert run.bound is not None  # noqa: S101
    outside = np.flatnonzero(np.abs(run.error[:, i]) >= run.bound[:, i])
    if outside.size:
        first = run.time[outside[0]]
        axes.axvline(first, color=ALARM, lw=1.4, label=f'outside from {first:.3f} s')


def _torque(axes: Axes, run: Run, i: int) -> None:
    axes.plot(*envelope(run.time, run.torque[:, i]), color=ORANGE, lw=1.1, label=r'$\tau$')
    if run.torque_limit is not None and np.isfinite(run.torque_limit[:, i]).any():
        limit = run.torque_limit[:, i]
        axes.plot(*envelope(run.time, limit), color=MUTED, lw=1.2, ls='--', label='limit')
        axes.plot(*envelope(run.time, -limit), color=MUTED, lw=1.2, ls='--')
    axes.set_ylabel('torque [N m]')
    known = run.torque[np.isfinite(run.torque[:, i]), i]
    head(axes, f'torque: peak {np.abs(known).max():.3g} N m' if known.size else 'torque')


def _error_title(error: Floats) -> str:
    if error.size == 0:
        return 'error'
    return f'error: max {np.abs(error).max():.3g}, rms {np.sqrt(np.mean(error**2)):.3g} mrad'
