# SPDX-License-Identifier: Apache-2.0
"""Lyapunov function (29), term by term, and the bound (32) on it, where the truth is known."""

from math import nan

import numpy as np

from blf_dsc_controller.arms.model import inertia_matrices
from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.law import barrier
from blf_dsc_controller.law.adaptation import NEWTON
from blf_dsc_controller.law.state import REFERENCE, Sample, Settings, Signals, State

_POSTURES = 181


@inner
def error_term(settings: Settings, state: State, signals: Signals) -> float:
    """Return the weighted barrier potential (3) of xi1 [J]; w z1^2 / 2 without a barrier."""
    total, xi1 = 0.0, signals.xi1
    for i in range(settings.n):
        if settings.has_barrier == 0:
            total += 0.5 * settings.barrier.weight[i] * xi1[i] ** 2
        else:
            total += state.rotors.gain_scale[i] * barrier.joint_potential(
                settings.barrier, signals.barrier, xi1[i], signals.bound[i], i
            )
    return total


@inner
def fill_energies(
    settings: Settings, state: State, signals: Signals, sample: Sample
) -> None:
    """Compute the terms of (29) for the telemetry sample; NaN where the truth is unknown.

    After the error's: xi2^T M xi2 / 2, where M xi2 = Yp(q, xi2) P; P~^T Gamma^-1 P~ / 2
    of the parameters that are adapted (Gamma_j > 0); (tau_dist - d^3)^2 / (2 gamma) of
    the joints whose d^3 is adapted (gamma > 0), all in J.
    """
    n = settings.n
    p = settings.p
    V = sample.lyapunov
    V[0] = error_term(settings, state, signals)
    for k in range(1, 4):
        V[k] = 0.0 if settings.truth.known == 1 else nan
    if settings.truth.known == 0:
        return
    P, momentum = settings.truth.parameters, signals.scratch.momentum
    settings.model.momentum_regressor(signals.q, signals.xi2, momentum.Yp, momentum.Yr)
    for i in range(n):
        for j in range(p):
            V[1] += 0.5 * signals.xi2[i] * momentum.Yp[i, j] * P[j]
    for j in range(p):
        if settings.adaptation.adaptation_gain[j] > 0.0:
            error = P[j] - state.estimate[j]
            V[2] += 0.5 * error * error / settings.adaptation.adaptation_gain[j]
    for i in range(n):
        if settings.disturbance.gain[i] > 0.0:
            error = signals.truth.disturbance[i] - state.disturbance[i]
            V[3] += (
                0.5
                * error
                * error
                / (state.rotors.gain_scale[i] * settings.disturbance.gain[i])
            )


def largest_inertia(settings: Settings) -> float:
    """Return the largest eigenvalue of M(q) [kg m^2] for the true parameters.

    Of postures with equal joint angles, one of which is the stretched planar arm.
    """
    postures = np.linspace(-np.pi, np.pi, _POSTURES)[:, np.newaxis] * np.ones(
        settings.n
    )
    M = inertia_matrices(settings.model, settings.truth.parameters, postures)
    return float(np.linalg.eigvalsh(M).max())


def decay_rate(settings: Settings) -> float:
    """Return kappa_e of (32) [1/s]; 0 if (32) is void: eta, gamma or kappa 0, or unknown truth.

    It is void for other forms than the paper's, too: with compensation along the
    reference, or with the handover to d^3, V of (29) need not fall (doc/stability.md).
    A Newton step replaces sigma, the smallest eigenvalue of Phi_e, by sigma / (sigma +
    rho).
    """
    if settings.has_barrier == 0 or settings.truth.known == 0:
        return 0.0
    if settings.compensation == REFERENCE or settings.disturbance.bumpless == 1:
        return 0.0
    sigma = settings.excitation.excitation_threshold
    if settings.adaptation.update == NEWTON:
        sigma /= sigma + settings.window.regularization
    slowest = float(settings.adaptation.adaptation_gain[: settings.p].min())
    of = settings.disturbance
    return min(
        float(settings.surface.gain.min()),
        2.0 * float(settings.feedback.gain.min()) / largest_inertia(settings),
        2.0 * settings.adaptation.weight * sigma * slowest,
        of.leakage * float(of.gain.min()),
    )


def exponential_bound(settings: Settings, t: Array, V: Array, holds: Array) -> Array:
    """Return the bound (32) on V [J] from the latch T_e on, at its tightest: without eps_d.

        V(t) <= V(T_e) exp(-kappa_e (t - T_e)) + theta / kappa_e (1 - exp(-kappa_e (t - T_e)))
        theta = eta d3^T d3 / 2

    The printed theta is divided by kappa_e once too often.  d3 is the largest known
    disturbance.

    At times t (k,) [s], `holds` tells whether a window is latched and all errors are
    within the knee, past which K V1 is lost: the bound begins anew each time, and is
    NaN elsewhere.
    """
    rate = decay_rate(settings)
    if rate == 0.0:
        return np.full(t.size, nan)
    constant, amplitude = np.abs(settings.truth.disturbance[:2])
    floor = (
        0.5
        * settings.disturbance.leakage
        * float(np.sum((constant + amplitude) ** 2))
        / rate
    )
    begins = holds & ~np.append(False, holds[:-1])
    begin = np.maximum.accumulate(np.where(begins, np.arange(t.size), 0))
    decay = np.exp(-rate * (t - t[begin]))
    return np.where(holds, V[begin] * decay + floor * (1.0 - decay), nan)
