# SPDX-License-Identifier: Apache-2.0
"""The slow topic `~/monitor`: how far the guarantees of the law hold, a few times a second.

Where the truth is known: the Lyapunov function (29) term by term, and the bound (32) on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import exp, nan

import numpy as np

from blf_dsc_controller.law.sample import Sample
from blf_dsc_controller.law.settings import LINEAR, NEWTON, Settings
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.encoders import JointStateEncoder
from blf_dsc_controller.messages.names import DISTANCE, LAMBDA_MIN, LATCHED, LYAPUNOV, RATIO

LYAPUNOV_TERMS = tuple(
    LYAPUNOV + term for term in ('barrier', 'velocity', 'parameters', 'disturbance')
)
LYAPUNOV_BOUND = LYAPUNOV + 'bound'

_POSTURES = 181


def largest_inertia(settings: Settings) -> float:
    """Largest eigenvalue of M(q) [kg m^2] over all postures, by the true parameters."""
    n, p = settings.n, settings.p
    Yp, Yr = np.zeros((2, n, p))
    largest = 0.0
    for angle in np.linspace(-np.pi, np.pi, _POSTURES):
        M = np.zeros((n, n))
        for i, unit in enumerate(np.eye(n)):
            settings.model.momentum_regressor(np.full(n, angle), unit, Yp, Yr)
            M[:, i] = Yp @ settings.true_parameters
        largest = max(largest, float(np.linalg.eigvalsh(M)[-1]))
    return largest


def decay_rate(settings: Settings) -> float:
    """kappa_e of (32) [1/s]; 0, so that (32) says nothing, where eta, gamma or kappa is zero.

    A Newton step replaces sigma, the least eigenvalue of Phi_e, by sigma / (sigma + rho).
    """
    if settings.surface == LINEAR or settings.truth_known == 0:
        return 0.0
    sigma = settings.sigma
    if settings.update == NEWTON:
        sigma /= sigma + settings.rho
    return min(
        float(settings.K.min()),
        2.0 * float(settings.Kp.min()) / largest_inertia(settings),
        2.0 * settings.kappa * sigma * float(settings.Gamma[: settings.p].min()),
        settings.eta * float(settings.gamma.min()),
    )


class ExponentialBound:
    """(32) from the latch T_e on, at its tightest: without the mismatch eps_d.

        V(t) <= V(T_e) exp(-kappa_e (t - T_e)) + theta / kappa_e (1 - exp(-kappa_e (t - T_e)))
        theta = eta d3^T d3 / 2

    The printed theta is divided by kappa_e once too often.  d3 is the largest disturbance known.

    Attributes:
        rate: kappa_e [1/s]; at 0 there is no bound.
        floor: theta / kappa_e [J], which V may stay below for ever.
    """

    def __init__(self, settings: Settings) -> None:
        self.rate = decay_rate(settings)
        constant, amplitude = np.abs(settings.true_disturbance[:2])
        theta = 0.5 * settings.eta * float(np.sum((constant + amplitude) ** 2))
        self.floor = theta / self.rate if self.rate > 0.0 else nan
        self._begin: tuple[float, float] | None = None

    def at(self, t: float, V: float, latched: bool) -> float:  # noqa: FBT001
        """Bound at the time t [s], where V [J] is; NaN before the latch and without a rate."""
        if self.rate == 0.0 or not latched:
            return nan
        if self._begin is None:
            self._begin = t, V
        begin, V_e = self._begin
        decay = exp(-self.rate * (t - begin))
        return V_e * decay + self.floor * (1.0 - decay)


class Monitor:
    """Builds the messages of `~/monitor`.

    Args:
        joints: names of the n joints.
        estimates: names of the m entries of theta^.
        settings: of the law.
    """

    def __init__(self, joints: Sequence[str], estimates: Sequence[str], settings: Settings) -> None:
        names = [what + joint for what in (RATIO, DISTANCE) for joint in joints]
        names += [*estimates, LAMBDA_MIN, LATCHED]
        self._ceiling = None
        if settings.truth_known == 1:
            names += [*LYAPUNOV_TERMS, LYAPUNOV_BOUND]
            self._ceiling = ExponentialBound(settings)
        self._encoder = JointStateEncoder(names, ('position',))
        self._start: int | None = None

    def message(
        self, stamp: int, sample: Sample, ratio: np.ndarray, bound: np.ndarray
    ) -> tuple[topics.Topic, bytes]:
        """Message of a telemetry sample.

        Args:
            stamp: of the sample [ns].
            sample: telemetry of the law.
            ratio: largest |xi1| / k_c so far (n,).
            bound: present k_c (n,) [rad].
        """
        distance = bound - np.abs(sample.xi1)
        values = [*ratio, *distance, *sample.estimate, sample.lambda_min[0], sample.latched[0]]
        if self._ceiling is not None:
            self._start = stamp if self._start is None else self._start
            V = float(sample.lyapunov.sum())
            t = (stamp - self._start) * 1e-9
            values += [*sample.lyapunov, self._ceiling.at(t, V, bool(sample.latched[0]))]
        return topics.MONITOR, self._encoder.encode(stamp, values)
