# SPDX-License-Identifier: Apache-2.0
"""The bound (32) on the Lyapunov function of the law `paper`, whose arm is known."""

from __future__ import annotations

from math import nan

import numpy as np

from blf_dsc_controller.arms.model import inertia_matrices
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.factory.estimate import model_of
from blf_dsc_controller.factory.gains import law_gains
from blf_dsc_controller.run import Floats

_POSTURES = 181


def largest_inertia(config: ControllerConfig, P: tuple[float, ...]) -> float:
    """Return the largest eigenvalue of M(q) [kg m^2] for the true parameters P.

    Of postures with equal joint angles, one of which is the stretched arm.
    """
    angles = np.linspace(-np.pi, np.pi, _POSTURES)[:, np.newaxis]
    q = angles * np.ones(len(config.joints))
    M = inertia_matrices(model_of(config), np.array(P), q)
    return float(np.linalg.eigvalsh(M).max())


def decay_rate(config: ControllerConfig, P: tuple[float, ...]) -> float:
    """Return kappa_e of (32) [1/s]; 0 if (32) is void: eta, gamma or kappa 0.

    P are the true parameters.
    """
    gains = law_gains(config)
    damped = 2.0 * min(gains.feedback) / largest_inertia(config, P)
    excited = 2.0 * gains.learning_weight * gains.excitation_threshold
    learned = excited * min(gains.adaptation)
    leaked = gains.leakage * min(config.disturbance.gain)
    return min(*gains.surface, damped, learned, leaked)


def exponential_bound(
    config: ControllerConfig, rate: float, largest: float, t: Floats, V: Floats
) -> Floats:
    """Return the bound (32) on V [J] (k,) at times t (k,) [s] since T_e, V[0] at T_e.

        V(t) <= V(T_e) exp(-kappa_e t) + theta / kappa_e (1 - exp(-kappa_e t))
        theta = eta d3^T d3 / 2

    kappa_e is the `rate`, and d3 `largest` [N m] on each joint.  The printed theta is
    divided by kappa_e once too often; eps_d is left out.
    """
    if rate == 0.0:
        return np.full(t.size, nan)
    n = len(config.joints)
    floor = 0.5 * law_gains(config).leakage * n * largest**2 / rate
    decay = np.exp(-rate * t)
    return np.asarray(V[0] * decay + floor * (1.0 - decay))
