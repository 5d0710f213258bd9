# SPDX-License-Identifier: Apache-2.0
"""References chosen to teach: the sum of sinusoids that excites the learning most.

The least eigenvalue of the excitation matrix says how well the worst known combination of
parameters and disturbance columns can be told from a window.  For a reference whose period is the
window it is, in the steady state,

    Phi = 1/tau_d int X_f^T X_f dt,      X_f = [H(q, dq, dq, ddq) | D] behind the learning's filter

which Parseval's theorem gives from the harmonics of X.  It is maximised over offset, cosines and
sines of each joint, as far as joints and motors allow; the torque is that of a guess at P.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.law.factory import settings_of_config
from blf_dsc_controller.law.rows import rows_along
from blf_dsc_controller.law.settings import pack
from blf_dsc_controller.reference.errors import ExcitationError
from blf_dsc_controller.reference.terms import sampled, sinusoids_vector

_LOOKS_PER_HARMONIC = 64
_MARGIN = 1e-3  # of each limit, for what happens between two looks
_ITERATIONS = 150
_SPREAD = 0.4  # rad, of the amplitudes that a search starts from


@dataclass(frozen=True)
class Course:
    """What a periodic reference asks for and teaches, in the steady state.

    Attributes:
        lambda_min: least eigenvalue of Phi.
        ratios: largest position, velocity, acceleration and torque of each joint against its limit
            (4, n).
    """

    lambda_min: float
    ratios: np.ndarray


@dataclass(frozen=True)
class Series:
    """A sum of harmonics of the window: offset (n,), cosines and sines (n, h) [rad]."""

    base: float  # rad/s, of the first harmonic
    offset: np.ndarray
    cosines: np.ndarray
    sines: np.ndarray

    def rounded(self, digits: int) -> Series:
        """The same to so many digits of a radian."""
        parts = (np.round(part, digits) for part in (self.offset, self.cosines, self.sines))
        return Series(self.base, *parts)

    @property
    def parameters(self) -> dict[str, tuple[float, ...]]:
        """The same as parameters of `reference`: cosines, then sines as cosines of phase -pi/2."""
        harmonics = self.base * np.arange(1, self.cosines.shape[1] + 1)
        amplitude = np.concatenate((self.cosines, self.sines), axis=1)
        quarter = np.repeat((0.0, -0.5 * np.pi), harmonics.size)
        return {
            'offset': tuple(self.offset.tolist()),
            'amplitude': tuple(amplitude.ravel().tolist()),
            'frequency': tuple(np.tile(harmonics, 2).tolist()),
            'phase': tuple(quarter.tolist()),
        }


class Excitation:
    """Judges periodic references for a controller.

    Args:
        config: of the controller: model, columns, filter, window and limits.
        guess: parameters P (p,) that the torque is reckoned with.
        share: part of the torque limit that may be used.
        harmonics: highest harmonic of the window in the reference.
    """

    def __init__(
        self, config: ControllerConfig, guess: np.ndarray, share: float, harmonics: int
    ) -> None:
        self._settings = settings_of_config(config)
        self._vector = pack(self._settings)
        self._guess = guess
        self._torque = share * self._settings.torque_limit
        limits = config.limits
        lower, upper = np.array(limits.position_lower), np.array(limits.position_upper)
        self._middle, self._reach = 0.5 * (lower + upper), 0.5 * (upper - lower)
        self._speed, self._change = np.array(limits.velocity), np.array(limits.acceleration)
        self.base = 2.0 * np.pi / config.learning.window
        self.harmonics = harmonics
        looks = _LOOKS_PER_HARMONIC * max(harmonics, 2)
        self._times = np.arange(looks) * (config.learning.window / looks)
        omega = self.base * np.arange(looks // 2 + 1)
        # Two poles in a row: the power of a harmonic falls by the fourth power of the first one.
        self._gain = 1.0 / (1.0 + (omega / self._settings.pole) ** 2) ** 2
        self._gain[1:] *= 2.0  # the harmonics of negative frequency

    @property
    def n(self) -> int:
        """Number of joints."""
        return self._settings.n

    def course(self, parameters: dict[str, tuple[float, ...]]) -> Course:
        """Judge a reference, given as the parameters offset, amplitude, frequency and phase."""
        motion = sampled(sinusoids_vector(**parameters), self._times)
        rows = np.zeros((self._times.size, self._settings.n, self._settings.m))
        rows_along(self._vector, self._times, motion, rows)
        torque = rows[:, :, : self._settings.p] @ self._guess
        peaks = (
            np.abs(motion[:, 0] - self._middle).max(axis=0) / self._reach,
            np.abs(motion[:, 1]).max(axis=0) / self._speed,
            np.abs(motion[:, 2]).max(axis=0) / self._change,
            np.abs(torque).max(axis=0) / self._torque,
        )
        return Course(float(np.linalg.eigvalsh(self._phi(rows))[0]), np.array(peaks))

    def _phi(self, rows: np.ndarray) -> np.ndarray:
        harmonics = np.fft.rfft(rows, axis=0) / self._times.size
        return np.asarray(
            np.einsum('k,kij,kil->jl', self._gain, harmonics.conj(), harmonics, optimize=True).real
        )

    def series(self, x: np.ndarray) -> Series:
        """Series of a vector: offsets (n,), cosines (n, h), sines (n, h)."""
        n, h = self.n, self.harmonics
        cosines, sines = x[n:].reshape(2, n, h)
        return Series(self.base, x[:n], cosines, sines)


def excite(excitation: Excitation, seed: int, starts: int) -> tuple[Series, Course]:
    """Find the reference that excites most, of searches from so many random ones.

    Raises:
        ExcitationError: none of them keeps the limits.
    """
    from scipy.optimize import minimize

    random = np.random.default_rng(seed)
    n, h = excitation.n, excitation.harmonics

    def course(x: np.ndarray) -> Course:
        return excitation.course(excitation.series(x).parameters)

    def cost(x: np.ndarray) -> float:
        return float(-np.log(max(course(x).lambda_min, 1e-12)))

    def slack(x: np.ndarray) -> np.ndarray:
        return 1.0 - _MARGIN - course(x).ratios.ravel()

    best: tuple[Series, Course] | None = None
    for _ in range(starts):
        start = np.concatenate(
            (random.uniform(-np.pi, np.pi, n), random.normal(0.0, _SPREAD, 2 * n * h))
        )
        found = minimize(
            cost,
            start,
            method='SLSQP',
            constraints={'type': 'ineq', 'fun': slack},
            options={'maxiter': _ITERATIONS, 'ftol': 1e-6},
        )
        reached = course(found.x)
        keeps = bool(np.all(reached.ratios <= 1.0))
        if keeps and (best is None or reached.lambda_min > best[1].lambda_min):
            best = excitation.series(found.x), reached
    if best is None:
        raise ExcitationError(starts)
    return best
