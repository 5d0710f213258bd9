# SPDX-License-Identifier: Apache-2.0
"""The learning alone, on the recorded states and torques of any bag.

The rows X theta = u are those of the controller (see law.prediction), over the window that excites
them most:  theta = (Phi + rho I)^-1 b  with (21) and (22). The deviations are those of least
squares,  s^2 (N Phi)^-1,  with the residual variance s^2 times the correlation length of the
filtered residuals in samples, which is on the careful side.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.bags.content import NO_NAMES, NameMap
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.law.factory import estimate_names, settings_of_config
from blf_dsc_controller.replay.what_if import what_if
from blf_dsc_controller.run import Floats

_CANDIDATES = 600  # windows


class Learned(NamedTuple):
    """Estimates of m unknowns from one window."""

    names: tuple[str, ...]  # of the unknowns
    estimate: Floats  # (m,) in the units of the model; NaN for a rejected column
    deviation: Floats  # standard deviation of each (m,)
    excitation: float  # lambda_min(Phi)
    threshold: float  # of the controller on it, sigma
    begin: float  # of the window, s
    end: float  # of the window, s
    residual: float  # root mean square of X theta - u, N m after the filter
    source: str  # topic of the torques

    @property
    def is_excited(self) -> bool:
        """Whether the controller would learn from this window."""
        return self.excitation >= self.threshold


def learn(
    path: Path, config: ControllerConfig, namespace: str = '', names: NameMap = NO_NAMES
) -> Learned:
    """Learn the arm of a bag, whatever moved it; path, namespace and names as for `what_if`.

    `config` gives the model, and the window, columns and filters of the learning.

    Raises:
        BlfDscError: the bag cannot be read, ends before a window is full, or does not hold the
            applied torques.
    """
    held = replace(
        config,
        reference=replace(config.reference, type='hold'),
        safety=replace(config.safety, velocity='measured'),
    )
    found = what_if(path, held, namespace, names)
    run, rows, active = found.run, found.rows, found.active
    settings = settings_of_config(config)
    window, start = settings.window, round(settings.learning_start / config.sample_time)
    if rows.shape[0] < start + 1:
        reason = (
            f'{path} holds {run.duration:.3g} s, which is too short for a window of '
            f'{config.learning.window:.3g} s and the settling time of the filters: record longer, '
            'or reduce learning.window'
        )
        raise BlfDscError(reason)
    end = _most_excited(rows, active, window, start)
    estimate, deviation, excitation, residual = _solve(
        rows[end - window : end], active, config.learning.regularization
    )
    return Learned(
        names=estimate_names(config),
        estimate=estimate,
        deviation=deviation,
        excitation=excitation,
        threshold=config.learning.excitation_threshold,
        begin=float(run.time[end - window]),
        end=float(run.time[end - 1]),
        residual=residual,
        source=found.source,
    )


def _most_excited(rows: Floats, active: Floats, window: int, start: int) -> int:
    """End of the window with the largest lambda_min of its Phi."""
    X = rows[:, :, :-1][:, :, active != 0.0]
    sums = np.cumsum(np.einsum('kia,kib->kab', X, X), axis=0)
    ends = np.unique(np.linspace(start, rows.shape[0] - 1, _CANDIDATES).astype(np.intp))
    Phi = (sums[ends] - sums[ends - window]) / window
    return int(ends[np.argmax(np.linalg.eigvalsh(Phi)[:, 0])]) + 1


def _solve(rows: Floats, active: Floats, rho: float) -> tuple[Floats, Floats, float, float]:
    kept = active != 0.0
    X = rows[:, :, :-1][:, :, kept].reshape(-1, int(kept.sum()))
    u = rows[:, :, -1]
    samples = rows.shape[0]
    Phi, b = X.T @ X / samples, X.T @ u.ravel() / samples
    theta = np.linalg.solve(Phi + rho * np.eye(len(b)), b)
    left = (X @ theta).reshape(u.shape) - u
    variance = float(np.sum(left**2)) / max(left.size - len(b), 1)
    covariance = variance * correlation_length(left) * np.linalg.inv(samples * Phi)
    estimate, deviation = np.full((2, active.size), np.nan)
    estimate[kept], deviation[kept] = theta, np.sqrt(np.diag(covariance))
    return estimate, deviation, float(np.linalg.eigvalsh(Phi)[0]), float(np.sqrt(np.mean(left**2)))


def correlation_length(left: Floats) -> float:
    """In samples: 1 + 2 sum of the autocorrelation up to its first zero."""
    size = 2 ** int(np.ceil(np.log2(2 * left.shape[0])))
    spectrum = np.abs(np.fft.rfft(left, size, axis=0)) ** 2
    correlation = np.fft.irfft(spectrum.sum(axis=1))[: left.shape[0]]
    if correlation[0] <= 0.0:
        return 1.0
    correlation = correlation / correlation[0]
    negative = np.flatnonzero(correlation <= 0.0)
    end = int(negative[0]) if negative.size else correlation.size
    return float(1.0 + 2.0 * correlation[1:end].sum())
