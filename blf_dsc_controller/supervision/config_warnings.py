# SPDX-License-Identifier: Apache-2.0
"""Warnings before the start: gains, limits and windows that are valid but cannot work well.

They rest on the initial estimate of the parameters, which is a guess. doc/tuning.md derives them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.law.factory import settings_of_config
from blf_dsc_controller.law.settings import FILTERED, LINEAR, NEWTON, Settings
from blf_dsc_controller.reference.approach import reference_of
from blf_dsc_controller.reference.terms import sampled

Floats = NDArray[np.float64]

_POINTS = 400  # on the reference
_LONGEST = 120.0  # s of it
_MARGIN = 1.25  # of torque beyond what the reference needs
_PERIODS = 0.02  # by which a window may miss a whole number of periods
_CLOSE = 0.8  # of the bound
_SETTLED = 10.0  # time constants of the filter (8) ...
_FILTERED = 4.0  # ... and of the regressor's, which both sides of the identity pass


class ReferenceLoad(NamedTuple):
    """What the reference demands, followed exactly with the initial estimate."""

    torque: Floats  # largest magnitude (n,), N m
    rate: float  # largest eigenvalue of M^-1 K_p, 1/s
    excitation: Floats  # mean of H^T H (p, p)


def config_warnings(config: ControllerConfig, q: Floats | None = None) -> list[str]:
    """Warnings, a sentence each that begins with the parameter to change first.

    `q` (n,) [rad] are the measured positions at the start, if known.
    """
    settings = settings_of_config(config)
    load = reference_load(config, settings)
    found = [*_of_start(config, q), *_of_torque(config, settings, load)]
    if settings.surface != LINEAR:
        found += _of_surface(config, settings)
        if settings.kappa > 0.0 and settings.Gamma.any():
            found += [*_of_update(config, settings, load), *_of_window(config, settings, load)]
    return found


def reference_load(config: ControllerConfig, settings: Settings) -> ReferenceLoad:
    """Evaluate the dynamics along the reference, over its slowest period."""
    P = settings.initial_estimate[: settings.p]
    frequencies = [w for w in config.reference.frequency if w > 0.0]
    horizon = min(float(2.0 * np.pi / min(frequencies, default=1.0)), _LONGEST)
    if config.reference.type == 'waypoints':
        horizon = max(config.reference.times)
    H, Yp, Yr = np.zeros((3, settings.n, settings.p))
    torque, rate = np.zeros(settings.n), 0.0
    excitation = np.zeros((settings.p, settings.p))
    moments = np.linspace(0.0, horizon, _POINTS, endpoint=False)
    M = np.zeros((settings.n, settings.n))
    for q, dq, ddq in sampled(reference_of(config), moments):
        settings.model.regressor(q, dq, dq, ddq, H)
        torque = np.maximum(torque, np.abs(H @ P))
        excitation += H.T @ H / _POINTS
        for i, unit in enumerate(np.eye(settings.n)):
            settings.model.momentum_regressor(q, unit, Yp, Yr)
            M[:, i] = Yp @ P
        if np.linalg.eigvalsh(M)[0] > 0.0:
            roots = np.linalg.eigvals(np.linalg.solve(M, np.diag(settings.Kp)))
            rate = max(rate, float(np.abs(roots).max()))
    return ReferenceLoad(torque, rate, excitation)


def _of_start(config: ControllerConfig, q: Floats | None) -> Iterator[str]:
    if q is None or config.reference.type == 'hold':
        return
    ((qr, _, _),) = sampled(reference_of(config), np.zeros(1))
    for joint, error, bound in zip(config.joints, q - qr, config.barrier.widest, strict=True):
        if _CLOSE * bound <= abs(error) < bound:
            yield (
                f'barrier.bound: {joint} starts {error:+.4g} rad from the reference, close to its '
                f'bound of {bound:g} rad: the first error of the estimate may carry it out'
            )


def _of_torque(config: ControllerConfig, settings: Settings, load: ReferenceLoad) -> Iterator[str]:
    for joint, need, limit in zip(config.joints, load.torque, config.torque.limit, strict=True):
        if limit < _MARGIN * need:
            yield (
                f'torque.limit: {joint} is given {limit:g} N m, but by learning.initial_estimate '
                f'the reference alone needs up to {need:.3g} N m: no bound can be kept with less '
                f'than that, and a quarter more is wanted for errors and disturbances'
            )
    product = load.rate * config.sample_time
    if product > 1.0:
        yield (
            f'feedback.gain: K_p over the inertia is {load.rate:.3g} 1/s by '
            f'learning.initial_estimate, {product:.2g} of a sample time of '
            f'{config.sample_time:g} s: from 1 on the sampled loop has little left for a delay, '
            f'and from 2 on it chatters between the limits: lower the gain or the sample time'
        )
    fraction = float(np.max(settings.gamma * config.sample_time / np.maximum(settings.Kp, 1e-12)))
    if fraction > 0.5:
        yield (
            f'disturbance.gain: the disturbance estimate takes up {fraction:.2g} of the velocity '
            f'feedback in each sample, more than half: it will oscillate against feedback.gain'
        )


def _of_surface(config: ControllerConfig, settings: Settings) -> Iterator[str]:
    T, filtering = config.sample_time, config.surface.time_constant
    rate = float(np.max(settings.K / 2.0 + settings.mu))
    if filtering < T:
        yield (
            f'surface.time_constant: {filtering:g} s is shorter than the sample time of {T:g} s: '
            f'alpha2 then repeats every error of the measurement, and its derivative goes into '
            f'the torque'
        )
    if filtering * rate > 1.0:
        yield (
            f'surface.gain, surface.mu: K/2 + mu is {rate:.3g} 1/s, of which the filter of '
            f'{filtering:g} s can follow a quarter of {1.0 / filtering:.3g} without ringing: '
            f'lower surface.time_constant or the gains'
        )
    stiff = settings.slope_limit * T / np.maximum(settings.Kp, 1e-12)
    for joint, ratio in zip(config.joints, stiff, strict=True):
        if ratio > 2.0:
            yield (
                f'barrier.slope_limit: past the knee of its barrier {joint} is pushed back by '
                f'{ratio:.2g} times its error in a sample, and from 2 on to the other side: lower '
                f'barrier.slope_limit below 2 feedback.gain / sample_time'
            )


def _of_update(config: ControllerConfig, settings: Settings, load: ReferenceLoad) -> Iterator[str]:
    T = config.sample_time
    step, what = settings.kappa * float(settings.Gamma[: settings.p].max()) * T, 'kappa Gamma T'
    if settings.update != NEWTON:
        step *= float(np.linalg.eigvalsh(load.excitation)[-1])
        what = 'kappa Gamma lambda_max(Phi) T'
    if step > 1.0:
        yield (
            f'learning.weight: {what} is {step:.2g}: the estimate oversteps from 1 on and '
            f'diverges at 2: lower learning.weight or learning.adaptation_gain'
        )
    if settings.eta * float(settings.gamma.max()) * T > 1.0:
        yield (
            'disturbance.leakage: eta gamma T is above 1: the disturbance estimate is thrown '
            'about by its own leakage'
        )


def _of_window(config: ControllerConfig, settings: Settings, load: ReferenceLoad) -> Iterator[str]:
    learning = config.learning
    least = float(np.linalg.eigvalsh(load.excitation)[0])
    if least < settings.sigma:
        yield (
            f'learning.excitation_threshold: the reference excites the parameters by '
            f'{least:.2g} at best, below the threshold of {settings.sigma:g}: nothing will be '
            f'learned from the prediction error'
        )
    if config.reference.type == 'sinusoids':
        for frequency in config.reference.frequency:
            periods = learning.window * frequency / (2.0 * np.pi)
            if frequency > 0.0 and abs(periods - round(periods)) > _PERIODS:
                yield (
                    f'learning.window: {learning.window:g} s are {periods:.3g} periods of the '
                    f"reference's {frequency:g} rad/s: only over whole periods does a disturbance "
                    f'of that period average out'
                )
    filtered = settings.prediction == FILTERED
    pole = learning.filter_pole if filtered else learning.derivative_filter
    if learning.settling_time * pole < (_FILTERED if filtered else _SETTLED):
        yield (
            f'learning.settling_time: {learning.settling_time:g} s are too short for the filters '
            f'of the prediction error ({pole:g} rad/s): the start stays in the first windows'
        )
