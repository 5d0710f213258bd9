# SPDX-License-Identifier: Apache-2.0
"""Search for the sum of sinusoids that excites the learning most.

The minimum eigenvalue of the excitation matrix says how well the worst determined combination of
parameters and disturbance columns can be identified from a window.  For a reference whose period is
the window it is, in the steady state,

    Phi = 1/tau_d int X_f^T X_f dt,      X_f = [H(q, dq, dq, ddq) | D] behind the learning's filter

which follows from the harmonics of X by Parseval's theorem.  It is maximised over offset, cosines
and sines of each joint within the limits of joints and torque; the torque is that of a guess of P.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blf_dsc_controller.compiled.layout import pack as pack_settings
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.law.factory import settings_of_config
from blf_dsc_controller.law.prediction import rows_along
from blf_dsc_controller.reference.limits import MotionError
from blf_dsc_controller.reference.terms import pack, sampled, sinusoids_term

_SAMPLES_PER_HARMONIC = 64
_MARGIN = 1e-3  # of each limit, for peaks between two samples
_ITERATIONS = 150
_SPREAD = 0.4  # rad, of the amplitudes that a search starts from


class Excitation(NamedTuple):
    """Excitation by a periodic reference in the steady state, and how it uses the limits."""

    lambda_min: float  # minimum eigenvalue of Phi
    ratios: np.ndarray  # (4, n) largest position, velocity, acceleration, torque over its limit


class ExcitationProblem:
    """Excitation of a controller as a function of its periodic reference.

    The torque is computed with the parameters `guess` (p,) and limited to `torque_fraction` of the
    configured limit; `harmonics` is the highest harmonic of the window in the reference.
    """

    def __init__(
        self, config: ControllerConfig, guess: np.ndarray, torque_fraction: float, harmonics: int
    ) -> None:
        self._settings = settings_of_config(config)
        self._vector = pack_settings(self._settings)
        self._guess = guess
        limits = config.limits
        lower, upper = np.array(limits.position_lower), np.array(limits.position_upper)
        self._middle = 0.5 * (lower + upper)
        torque = torque_fraction * self._settings.torque_limit
        self._limits = (0.5 * (upper - lower), limits.velocity, limits.acceleration, torque)
        self.n = self._settings.n
        self.harmonics = harmonics
        self._base = 2.0 * np.pi / config.learning.window
        samples = _SAMPLES_PER_HARMONIC * max(harmonics, 2)
        self._times = np.arange(samples) * (config.learning.window / samples)
        omega = self._base * np.arange(samples // 2 + 1)
        # Two poles in series: the power of a harmonic falls by the fourth power of one pole's gain.
        self._gain = 1.0 / (1.0 + (omega / self._settings.pole) ** 2) ** 2
        self._gain[1:] *= 2.0  # the harmonics of negative frequency

    def parameters(self, x: np.ndarray) -> dict[str, tuple[float, ...]]:
        """Parameters of `reference` for x: offsets (n,), cosines (n, h) and sines (n, h) [rad].

        Sines are cosines of phase -pi/2.
        """
        n, h = self.n, self.harmonics
        amplitude = np.concatenate(list(x[n:].reshape(2, n, h)), axis=1)
        return {
            'offset': tuple(x[:n].tolist()),
            'amplitude': tuple(amplitude.ravel().tolist()),
            'frequency': tuple(np.tile(self._base * np.arange(1, h + 1), 2).tolist()),
            'phase': tuple(np.repeat((0.0, -0.5 * np.pi), h).tolist()),
        }

    def evaluate(self, parameters: dict[str, tuple[float, ...]]) -> Excitation:
        """Excitation by the reference with parameters offset, amplitude, frequency and phase."""
        settings = self._settings
        motion = sampled(pack(self.n, [sinusoids_term(**parameters)]), self._times)
        rows = np.zeros((self._times.size, settings.n, settings.m))
        rows_along(self._settings.model, self._vector, self._times, motion, rows)
        torque = rows[:, :, : settings.p] @ self._guess
        values = (motion[:, 0] - self._middle, motion[:, 1], motion[:, 2], torque)
        ratios = [
            np.abs(value).max(axis=0) / limit
            for value, limit in zip(values, self._limits, strict=True)
        ]
        X = np.fft.rfft(rows, axis=0) / self._times.size
        Phi = np.einsum('k,kij,kil->jl', self._gain, X.conj(), X, optimize=True).real
        return Excitation(float(np.linalg.eigvalsh(Phi)[0]), np.array(ratios))


def search(problem: ExcitationProblem, seed: int, starts: int) -> np.ndarray:
    """Best x (see `ExcitationProblem.parameters`) of searches from random starting points.

    Raises:
        MotionError: none of the searches found a reference that keeps the limits.
    """
    from scipy.optimize import minimize

    random = np.random.default_rng(seed)
    n, h = problem.n, problem.harmonics

    def evaluate(x: np.ndarray) -> Excitation:
        return problem.evaluate(problem.parameters(x))

    def cost(x: np.ndarray) -> float:
        return float(-np.log(max(evaluate(x).lambda_min, 1e-12)))

    def slack(x: np.ndarray) -> np.ndarray:
        return 1.0 - _MARGIN - evaluate(x).ratios.ravel()

    best, most = None, -np.inf
    for _ in range(starts):
        start = (random.uniform(-np.pi, np.pi, n), random.normal(0.0, _SPREAD, 2 * n * h))
        found = minimize(
            cost,
            np.concatenate(start),
            method='SLSQP',
            constraints={'type': 'ineq', 'fun': slack},
            options={'maxiter': _ITERATIONS, 'ftol': 1e-6},
        )
        lambda_min, ratios = evaluate(found.x)
        if np.all(ratios <= 1.0) and lambda_min > most:
            best, most = found.x, lambda_min
    if best is None:
        raise MotionError(
            f'no reference was found, in {starts} searches, that keeps positions, velocities, '
            'accelerations and torques within their limits: allow a larger fraction of the '
            'torque, widen limits, or search from more starts'
        )
    return np.asarray(best)
