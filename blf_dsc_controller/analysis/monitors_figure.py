# SPDX-License-Identifier: Apache-2.0
"""The picture of the monitors: distance to the barrier, excitation, and the Lyapunov function.

The bound (32) is drawn at its tightest, without the mismatch eps_d.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from blf_dsc_controller.analysis.envelope import envelope
from blf_dsc_controller.analysis.estimation import latch_time
from blf_dsc_controller.analysis.style import ALARM, COLOURS, GREEN, INK, MUTED, head, save_panels
from blf_dsc_controller.messages.monitor import LYAPUNOV_BOUND, LYAPUNOV_TERMS
from blf_dsc_controller.messages.names import LAMBDA_MIN, LYAPUNOV
from blf_dsc_controller.run import Floats, Run, Series

_PANEL = (6.4, 3.2)  # inches
_MILLI = 1e3
_LEAST = 1e-12  # J and 1, the least that a logarithmic axis shows


def draw_monitors(run: Run, path: Path) -> bool:
    """Draw what the run's slow topic and its errors tell; False, and no picture, without them."""
    panels = list(_panels(run))
    if run.monitor is None or not panels:
        return False
    save_panels(path, 'Monitors', panels, _PANEL, latch_time(run))
    return True


def _panels(run: Run) -> Iterator[Callable[[Axes], None]]:
    if run.monitor is None:
        return
    if run.error is not None and run.bound is not None:
        yield partial(_distance, run, run.bound - np.abs(run.error))
    if LAMBDA_MIN in run.monitor.names:
        yield partial(_excitation, run, run.monitor)
    if LYAPUNOV_TERMS[0] in run.monitor.names:
        yield partial(_terms, run, run.monitor)
        yield partial(_bound, run, run.monitor)


def _distance(run: Run, distance: Floats, axes: Axes) -> None:
    for i, joint in enumerate(run.joints):
        values = envelope(run.time, _MILLI * distance[:, i])
        axes.plot(*values, color=COLOURS[i % len(COLOURS)], lw=1.1, label=joint)
    axes.axhline(0.0, color=ALARM, lw=1.4)
    axes.set_ylim(bottom=min(0.0, _MILLI * float(np.nanmin(distance))))
    axes.set_ylabel('$k_c - |\\xi_1|$ [mrad]')
    head(axes, f'distance to the barrier: least {_MILLI * np.nanmin(distance):.3g} mrad')


def _excitation(run: Run, monitor: Series, axes: Axes) -> None:
    time, values = run.time_of(monitor.stamp), monitor.column(LAMBDA_MIN)
    known = np.where(values > 0.0, values, np.nan)  # 0 until the first look
    axes.semilogy(*envelope(time, known), color=GREEN)
    axes.set_ylabel(r'$\lambda_{\min}(\Phi)$')
    latched = latch_time(run)
    head(axes, 'excitation' + ('' if latched is None else f'; learning from {latched:.4g} s on'))


def _terms(run: Run, monitor: Series, axes: Axes) -> None:
    time = run.time_of(monitor.stamp)
    for name, colour in zip(LYAPUNOV_TERMS, COLOURS, strict=False):
        values = monitor.column(name)
        if np.any(values > 0.0):
            positive = envelope(time, np.maximum(values, _LEAST))
            axes.semilogy(*positive, color=colour, lw=1.1, label=name.removeprefix(LYAPUNOV))
    axes.set_ylabel('terms of (29) [J]')
    head(axes, '$V$')


def _bound(run: Run, monitor: Series, axes: Axes) -> None:
    time = run.time_of(monitor.stamp)
    V, bound = monitor.select(LYAPUNOV_TERMS).sum(axis=1), monitor.column(LYAPUNOV_BOUND)
    axes.semilogy(*envelope(time, np.maximum(V, _LEAST)), color=INK, lw=1.1, label='$V$')
    known = np.isfinite(bound)
    if not known.any():
        axes.set_ylabel('V [J]')
        head(axes, r'bound (32) says nothing: $\kappa_e = 0$')
        return
    axes.semilogy(*envelope(time, bound), color=MUTED, lw=1.4, ls='--', label='bound (32)')
    axes.set_ylabel('V [J]')
    share = float(np.mean(V[known] <= bound[known]))
    head(axes, f'(32) met {100 * share:.3g} % of the time')
