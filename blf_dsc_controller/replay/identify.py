# SPDX-License-Identifier: Apache-2.0
"""The parameters of an arm from a bag: the learning alone, on recorded states and torques.

The rows X theta = u are those of the controller (see core.prediction), over the window that excites
them most:  theta = (Phi + rho I)^-1 b  with (21) and (22). The deviations are those of least
squares,  s^2 (N Phi)^-1,  with the variance s^2 of what the rows leave over, times the number of
samples that hang together in it, since filtered residuals repeat themselves: on the careful side.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from blf_dsc_controller.bags.content import NO_NAMES, NameMap, read_content
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.law.factory import begin, controller_of, estimate_names
from blf_dsc_controller.replay.errors import ShortBagError
from blf_dsc_controller.replay.states import States, answered_states
from blf_dsc_controller.replay.torques import applied_torque
from blf_dsc_controller.run import Floats

_NANO = 1e-9
_CANDIDATES = 600  # windows that are looked at


@dataclass(frozen=True)
class Identification:
    """What a window tells of m unknowns.

    Attributes:
        names: of the unknowns.
        estimate: (m,) in the units of the model; NaN for a column that was refused.
        deviation: standard deviation of each (m,).
        excitation: lambda_min(Phi).
        threshold: that the controller asks for, sigma.
        begin: of the window [s].
        end: of the window [s].
        residual: root mean square of X theta - u, N m after the filter.
        source: in words, where the torques come from.
    """

    names: tuple[str, ...]
    estimate: Floats
    deviation: Floats
    excitation: float
    threshold: float
    begin: float
    end: float
    residual: float
    source: str

    @property
    def is_excited(self) -> bool:
        """Whether the controller would learn from this window."""
        return self.excitation >= self.threshold


def identify(
    path: Path, config: ControllerConfig, namespace: str = '', names: NameMap = NO_NAMES
) -> Identification:
    """Identify the arm of a bag, whatever moved it.

    Args:
        path: folder of the bag, one of its storage files, or a ROS 1 `.bag`.
        config: model, window, columns and filters of the learning.
        namespace: of the robot to look at, if the bag holds several.
        names: of topics and joints that are called otherwise in the bag.

    Raises:
        ShortBagError: the bag ends before a window is full.
        NoTorqueError: the bag does not tell which torques acted.
        BlfDscError: the bag, or a message in it, cannot be read.
    """
    content = read_content(path, namespace, names)
    joints = names.joints_of(config.joints)
    states = answered_states(content, joints)
    applied, source = applied_torque(path, content, states, joints)
    n = len(joints)
    states.measurement[1:, 2 * n :] = applied[:-1]
    rows, active, window, start = _rows(config, states)
    if rows.shape[0] < start + 1:
        raise ShortBagError(path, states.duration, config.learning.window)
    end = _most_excited(rows, active, window, start)
    estimate, deviation, excitation, residual = _solve(
        rows[end - window : end], active, config.learning.regularization
    )
    return Identification(
        names=estimate_names(config),
        estimate=estimate,
        deviation=deviation,
        excitation=excitation,
        threshold=config.learning.excitation_threshold,
        begin=float(states.time[end - window]),
        end=float(states.time[end - 1]),
        residual=residual,
        source=source,
    )


def _rows(config: ControllerConfig, states: States) -> tuple[Floats, Floats, int, int]:
    """Rows [X | u] (N, n, m + 1), columns in use (m,), samples of a window, and of the first."""
    learning = replace(config.learning, torque_source='effort')
    held = replace(config, learning=learning, reference=replace(config.reference, type='hold'))
    controller = controller_of(held)
    settings, n = controller.settings, controller.settings.n
    rows = np.zeros((states.stamp.size, n, settings.m + 1))
    stamps = states.stamp.tolist()
    last = stamps[0] - config.sample_time_ns
    begin(controller, held, states.measurement[0, :n], states.measurement[0, n : 2 * n])
    for k, stamp in enumerate(stamps):
        controller.update(
            (stamp - stamps[0]) * _NANO, (stamp - last) * _NANO, states.measurement[k]
        )
        rows[k] = controller.signals.row
        last = stamp
    start = round(settings.learning_start / config.sample_time)
    return rows, controller.state.active.copy(), settings.window, start


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
    covariance = variance * _together(left) * np.linalg.inv(samples * Phi)
    estimate, deviation = np.full((2, active.size), np.nan)
    estimate[kept], deviation[kept] = theta, np.sqrt(np.diag(covariance))
    return estimate, deviation, float(np.linalg.eigvalsh(Phi)[0]), float(np.sqrt(np.mean(left**2)))


def _together(left: Floats) -> float:
    """Samples that hang together: 1 + 2 sum of the autocorrelation up to its first zero."""
    size = 2 ** int(np.ceil(np.log2(2 * left.shape[0])))
    spectrum = np.abs(np.fft.rfft(left, size, axis=0)) ** 2
    correlation = np.fft.irfft(spectrum.sum(axis=1))[: left.shape[0]]
    if correlation[0] <= 0.0:
        return 1.0
    correlation = correlation / correlation[0]
    negative = np.flatnonzero(correlation <= 0.0)
    end = int(negative[0]) if negative.size else correlation.size
    return float(1.0 + 2.0 * correlation[1:end].sum())
