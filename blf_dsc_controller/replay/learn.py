# SPDX-License-Identifier: Apache-2.0
"""The learning alone, on the recorded states and torques of any bag.

The rows X theta = u are those of the controller (see law.prediction), over the window that excites
them most:  theta = (Phi + rho I)^-1 b  with (21) and (22). The deviations do not assume that the
residuals are independent: A^-1 S A^-1 / N^2 with A = Phi + rho I and S the sum over blocks of the
window of g g^T, where g is the sum of X^T (X theta - u) in a block (Liang and Zeger, Longitudinal
data analysis using generalized linear models, 1986). The part of an unmodelled torque that is
correlated with the columns of X biases the estimates, which no deviation shows.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.arms.batch import inertia_matrices
from blf_dsc_controller.arms.model import ArmModel
from blf_dsc_controller.bags.content import NO_NAMES, NameMap
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.law.factory import estimate_names, model_of
from blf_dsc_controller.replay.what_if import read_states, run_over
from blf_dsc_controller.run import Floats

_CANDIDATES = 600  # windows
_BLOCKS = 20  # of a window
_POSITIONS = 50  # at which the inertia matrix is checked
_POOR = 0.2  # of the torque, largest accepted residual
_LASTING = 0.05  # of the window, longest correlation length of noise


class Learned(NamedTuple):
    """Estimates of m unknowns from one window."""

    names: tuple[str, ...]  # of the unknowns
    estimate: Floats  # (m,) in the units of the model; NaN for a rejected column
    deviation: Floats  # standard deviation of each (m,)
    excitation: float  # lambda_min(Phi)
    threshold: float  # sigma, the threshold of the controller on it
    begin: float  # of the window, s
    end: float  # of the window, s
    residual: float  # root mean square of X theta - u, N m after the filter
    torque: float  # root mean square of u, likewise
    correlation: float  # correlation length of the residual, s
    least_inertia: float  # smallest eigenvalue of the inertia matrix in the window, in its unit
    source: str  # topic of the torques
    left_out: int  # states that are not finite, or without a known torque

    @property
    def is_excited(self) -> bool:
        """Whether the controller would learn from this window."""
        return self.excitation >= self.threshold

    @property
    def notes(self) -> Iterator[str]:
        """Errors that the deviations cannot show."""
        if self.correlation > _LASTING * (self.end - self.begin):
            yield (
                f'note: the residual is a torque that lasts ({self.correlation:.2g} s), not noise: '
                'what is correlated with a column biases the estimate beyond its interval'
            )

    @property
    def doubts(self) -> Iterator[str]:
        """Why the estimates should not be trusted."""
        if not self.is_excited:
            yield 'DO NOT TRUST these estimates: the motion does not show all of them'
        if self.least_inertia <= 0.0:
            yield (
                'UNPHYSICAL: the smallest eigenvalue of the inertia matrix is '
                f'{self.least_inertia:.3g}; are joints, signs or units swapped?'
            )
        if self.residual > _POOR * self.torque:
            yield (
                f'RESIDUAL TOO LARGE: {100.0 * self.residual / self.torque:.0f} % of the torque is '
                'not explained; are these the torques of these joints, in N m, with gravity?'
            )


def learn(
    path: Path, config: ControllerConfig, namespace: str = '', names: NameMap = NO_NAMES
) -> Learned:
    """Learn an arm from a bag, whatever moved it; path, namespace and names as for `what_if`.

    `config` gives the model, and the window, columns and filters of the learning.

    Raises:
        BlfDscError: the bag cannot be read, ends before a window is full, or does not hold the
            applied torques.
    """
    recorded = read_states(path, config, namespace, names)
    stamp, sample_time = recorded.states.stamp, config.sample_time
    if stamp.size > 1:
        sample_time = float(np.median(np.diff(stamp))) * 1e-9
    # Use a reference at rest: the recorded one is unknown, and its speed would weight the rows.
    held = replace(
        config,
        sample_time=sample_time,
        reference=replace(config.reference, type='hold'),
        safety=replace(config.safety, velocity='measured'),
        learning=replace(config.learning, motion_scale=0.0),
    )
    learning = config.learning
    window = round(learning.window / sample_time)
    start = window + round(learning.settling_time / sample_time)
    if stamp.size < start + 1:
        reason = (
            f'{path} holds {(stamp[-1] - stamp[0]) * 1e-9:.3g} s, which is too short for a window '
            f'of {learning.window:.3g} s and the settling time of the filters: record longer, '
            'or reduce learning.window'
        )
        raise BlfDscError(reason)
    found = run_over(recorded, held)
    run, rows, active = found.run, found.rows, found.active
    end = _most_excited(rows, active, window, start)
    chosen = slice(end - window, end)
    X, u = rows[chosen, :, :-1][:, :, active != 0.0], rows[chosen, :, -1]
    Phi, theta, covariance = _solve(X, u, learning.regularization)
    estimate, deviation = np.full((2, active.size), np.nan)
    estimate[active != 0.0], deviation[active != 0.0] = theta, np.sqrt(np.diag(covariance))
    left = X @ theta - u
    return Learned(
        names=estimate_names(config),
        estimate=estimate,
        deviation=deviation,
        excitation=float(np.linalg.eigvalsh(Phi)[0]),
        threshold=learning.excitation_threshold,
        begin=float(run.time[end - window]),
        end=float(run.time[end - 1]),
        residual=float(np.sqrt(np.mean(left**2))),
        torque=float(np.sqrt(np.mean(u**2))),
        correlation=correlation_length(left) * sample_time,
        least_inertia=_least_inertia(model_of(config), estimate, run.position[chosen]),
        source=recorded.source,
        left_out=recorded.left_out,
    )


def _most_excited(rows: Floats, active: Floats, window: int, start: int) -> int:
    """Return the end of the window whose Phi has the largest lambda_min."""
    X = rows[:, :, :-1][:, :, active != 0.0]
    sums = np.cumsum(np.einsum('kia,kib->kab', X, X), axis=0)
    ends = np.unique(np.linspace(start, rows.shape[0] - 1, _CANDIDATES).astype(np.intp))
    Phi = (sums[ends] - sums[ends - window]) / window
    return int(ends[np.argmax(np.linalg.eigvalsh(Phi)[:, 0])]) + 1


def _solve(X: Floats, u: Floats, rho: float) -> tuple[Floats, Floats, Floats]:
    """Return Phi (m, m), theta (m,) and its covariance (m, m) of rows X (N, n, m), u (N, n)."""
    N, m = X.shape[0], X.shape[2]
    Phi = np.einsum('kia,kib->ab', X, X) / N
    inverse = np.linalg.pinv(Phi + rho * np.eye(m), hermitian=True)
    theta = inverse @ np.einsum('kia,ki->a', X, u) / N
    scores = np.einsum('kia,ki->ka', X, X @ theta - u)
    g = np.array([block.sum(axis=0) for block in np.array_split(scores, _BLOCKS)])
    S = g.T @ g * _BLOCKS / (_BLOCKS - 1)
    return Phi, theta, inverse @ S @ inverse / N**2


def _least_inertia(model: ArmModel, estimate: Floats, q: Floats) -> float:
    """Return the smallest eigenvalue of M at some of q (N, n), by the estimate (m,) of P and d."""
    P = estimate[: model.p]
    some = q[:: max(1, q.shape[0] // _POSITIONS)]
    return float(np.linalg.eigvalsh(inertia_matrices(model, P, some)).min())


def correlation_length(left: Floats) -> float:
    """Return 1 + 2 sum of the autocorrelation up to its first zero, in samples."""
    size = 2 ** int(np.ceil(np.log2(2 * left.shape[0])))
    spectrum = np.abs(np.fft.rfft(left, size, axis=0)) ** 2
    correlation = np.fft.irfft(spectrum.sum(axis=1))[: left.shape[0]]
    if correlation[0] <= 0.0:
        return 1.0
    correlation = correlation / correlation[0]
    negative = np.flatnonzero(correlation <= 0.0)
    end = int(negative[0]) if negative.size else correlation.size
    return float(1.0 + 2.0 * correlation[1:end].sum())
