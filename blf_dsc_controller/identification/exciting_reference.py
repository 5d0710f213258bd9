# SPDX-License-Identifier: Apache-2.0
"""Search for the sum of sinusoids that excites the learning of an arm from a URDF most.

For a reference whose period is the window, the excitation matrix in the steady state is

    Phi = 1/tau_d int X_f^T X_f dt,      X_f = [H(q, dq, dq, ddq) | D] after the learning's filter

with the row weights of the learning, which adds a multiple a R of the prior's
information to it.  The search maximises, over offset, cosines and sines of each joint,
the log-determinant of (a R)^-1 (Phi + a R): how much a window shrinks the uncertainty
volume of the prior.  (The worst-determined combination is one that no motion reveals
and that is left to the prior.)
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blf_dsc_controller.arms.model import regressors_at
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.robot import parameters_of
from blf_dsc_controller.factory.estimate import prior_covariance
from blf_dsc_controller.factory.settings import settings_of_config
from blf_dsc_controller.identification.clearance import Clearance
from blf_dsc_controller.law import columns
from blf_dsc_controller.progress import steps
from blf_dsc_controller.reference.approach import MotionError
from blf_dsc_controller.reference.terms import pack, sampled, sinusoids_term

_TORQUE, _SPEED = 0.8, 0.95  # of the limits of torque, and of velocity and acceleration
_ITERATIONS = 150  # of a search
_SAMPLES_PER_HARMONIC = 64
_COARSE = 4  # samples per filtered row
_MARGIN = 1e-3  # fraction of each limit, and m of room, for peaks between samples
_PENALTY = 1e4  # on the mean square excess: limits are exceeded by a few percent
_SHRINKS = 30  # most reductions of the amplitudes, by 1 % each, to keep the limits
_SPREAD = 0.2  # standard deviation of a search's initial amplitudes


class Excitation(NamedTuple):
    """Excitation by a periodic reference in the steady state, and its use of the limits."""

    gain: float  # objective of the search
    # of the prior's deviation after a window, geometric mean over all directions
    left: float
    # (4, n) largest position, velocity, acceleration, torque, over the limit
    ratios: np.ndarray
    # (k,) least room between pairs of links and to the floor; negative: too close
    room: np.ndarray
    # mean square violation of the limits, relative, and of the room, in m
    excess: float

    @property
    def is_allowed(self) -> bool:
        """Whether the reference keeps all limits."""
        return bool(self.ratios.max() <= 1.0 and self.room.min(initial=0.0) >= 0.0)


class ExcitationProblem:
    """Excitation of a controller as a function of its periodic reference.

    `harmonics` is the highest harmonic of the window in the reference.  The torque is
    computed for the initial estimate, with and without the payload.  The links have
    this radius; the floor is at this height in the base frame [m].

    Attributes:
        reach: of the positions (n,) [rad] from their middle.
        limits: usable ones (4, n) of position from the middle, velocity, acceleration, torque.
    """

    def __init__(
        self,
        config: ControllerConfig,
        harmonics: int,
        radius: float = 0.07,
        floor: float = 0.0,
    ) -> None:
        settings = settings_of_config(config)
        chain = config.robot.chain(config.joints)
        load = config.robot.payload * parameters_of(config.robot, chain).load
        self.n = settings.n
        self.harmonics = harmonics
        self._settings = settings
        self._clearance = Clearance(chain, radius, floor)
        self._guess = np.tile(settings.initial_estimate, (2, 1))
        self._guess[1, : settings.p] += load
        self._scale = np.linalg.cholesky(prior_covariance(config))
        lower = np.array(config.limits.position_lower)
        upper = np.array(config.limits.position_upper)
        self._middle = 0.5 * (lower + upper)
        self.reach = 0.5 * (upper - lower)
        limits = config.limits
        self.limits = np.array(
            (
                self.reach - settings.barrier.bound,
                _SPEED * np.array(limits.velocity),
                _SPEED * np.array(limits.acceleration),
                _TORQUE * settings.torque.limit,
            )
        )
        self._base = 2.0 * np.pi / config.learning.window
        # (n, h) what alone would reach a limit of motion
        rates = self._base * np.arange(1, harmonics + 1)
        reached = [np.outer(self.limits[k], rates**-k) for k in range(3)]
        self._units = np.min(reached, axis=0)
        samples = _SAMPLES_PER_HARMONIC * max(harmonics, 2)
        self._times = np.arange(samples) * (config.learning.window / samples)
        omega = self._base * np.arange(samples // 2 + 1)
        # two poles in series
        self._filter = 1.0 / (1.0 + 1j * omega / settings.row.filter_pole) ** 2

    def start(self, random: np.random.Generator) -> np.ndarray:
        """Return a random x around the middle of each joint's range; see `parameters`."""
        n, h = self.n, self.harmonics
        return np.append(
            random.uniform(-0.5, 0.5, n), random.normal(0.0, _SPREAD, 2 * n * h)
        )

    def parameters(self, x: np.ndarray) -> dict[str, tuple[float, ...]]:
        """Return the parameters of `reference` for x: offsets (n,), cosines and sines (n, h).

        Offsets are in units of half the range, amplitudes in units of the one that
        alone would reach a limit of position, velocity or acceleration. Sines are
        cosines of phase -pi/2.
        """
        n, h = self.n, self.harmonics
        unit = self._units
        amplitude = np.concatenate(list(x[n:].reshape(2, n, h) * unit), axis=1)
        return {
            'offset': tuple((self._middle + self.reach * x[:n]).tolist()),
            'amplitude': tuple(amplitude.ravel().tolist()),
            'frequency': tuple(np.tile(self._base * np.arange(1, h + 1), 2).tolist()),
            'phase': tuple(np.repeat((0.0, -0.5 * np.pi), h).tolist()),
        }

    def evaluate(self, parameters: dict[str, tuple[float, ...]]) -> Excitation:
        """Return the excitation by the reference with offset, amplitude, frequency and phase."""
        motion = sampled(pack(self.n, [sinusoids_term(**parameters)]), self._times)
        q, dq, ddq = motion.transpose(1, 0, 2)
        rows = self._rows(q, dq, ddq)
        torque = np.abs(rows @ self._guess.T).max(axis=2)
        ratios = (
            np.abs(np.stack((q - self._middle, dq, ddq, torque), axis=1)) / self.limits
        )
        room = self._clearance.room(q)
        over = (ratios - 1.0 + _MARGIN, _MARGIN - room)
        excess = sum((np.maximum(each, 0.0) ** 2).sum() for each in over) / len(q)
        mu = np.linalg.eigvalsh(self._relative_excitation(dq, rows))
        gain = np.log1p(np.maximum(mu, 0.0) / self._settings.window.prior_weight).sum()
        left = float(np.exp(-0.5 * gain / len(mu)))
        return Excitation(
            float(gain), left, ratios.max(axis=0), room.min(axis=0), float(excess)
        )

    def _rows(self, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
        """Return [H(q, dq, dq, ddq) | D] (k, n, m) of a motion, as `law.columns` describes D."""
        settings = self._settings
        H = regressors_at(settings.model, q, dq, dq, ddq)
        tau = H @ settings.initial_estimate[: settings.p]
        rows = np.zeros((len(q), self.n, settings.m))
        rows[:, :, : settings.p] = H
        columns.fill_motion(settings.columns, self._times, q, dq, tau, rows)
        return rows

    def _relative_excitation(self, dq: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Return L^T Phi L (m, m), R^-1 = L L^T; its eigenvalues are those of Phi relative to R."""
        settings = self._settings
        coarse = dq[::_COARSE]
        spectrum = np.fft.rfft(rows, axis=0)[: len(coarse) // 2 + 1] / _COARSE
        X = np.fft.irfft(
            spectrum * self._filter[: len(spectrum), None, None], len(coarse), axis=0
        )
        X *= settings.row.row_weight[:, None]
        if settings.row.motion_scale > 0.0:
            X *= (np.abs(coarse) / np.hypot(coarse, settings.row.motion_scale))[
                ..., None
            ]
        X = X.reshape(-1, settings.m) @ self._scale
        return np.asarray(X.T @ X / len(coarse))


def search(problem: ExcitationProblem, seed: int, starts: int) -> np.ndarray:
    """Return the best x (see `ExcitationProblem.parameters`) found from random starting points.

    Raises:
        MotionError: no search found a reference that keeps the limits.
    """
    from scipy.optimize import approx_fprime, minimize

    def cost(x: np.ndarray) -> float:
        reached = problem.evaluate(problem.parameters(x))
        return _PENALTY * reached.excess - reached.gain

    random = np.random.default_rng(seed)
    best: np.ndarray | None = None
    most = -np.inf
    begun = f'searching from {starts} starts: up to a minute or two for each'
    for _ in steps(range(starts), starts, 'start', begun):
        x = minimize(
            cost,
            problem.start(random),
            jac=lambda x: approx_fprime(x, cost),
            method='L-BFGS-B',
            options={'maxiter': _ITERATIONS, 'ftol': 1e-6},
        ).x
        for _ in range(_SHRINKS):
            reached = problem.evaluate(problem.parameters(x))
            if reached.is_allowed:
                if reached.gain > most:
                    best, most = x, reached.gain
                break
            x[problem.n :] *= 0.99
    if best is None:
        raise MotionError(
            f'no reference found in {starts} searches keeps positions, velocities, '
            'accelerations and torques within their limits and the links clear of each other '
            'and of the floor: widen the limits, use a smaller radius or a lower floor, or '
            'search from more starts'
        )
    return best
