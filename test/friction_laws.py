# SPDX-License-Identifier: Apache-2.0
"""Laws of friction, with viscous and Coulomb friction of their own, to be added to a motion."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from blf_dsc_controller.identification.sliding import sliding_direction

_SMOOTH = 0.005  # rad/s or m/s, of tanh


def _coulomb(motion, friction, _random):
    _, v, _ = motion
    viscous, coulomb = friction
    return viscous * v + coulomb * np.tanh(v / _SMOOTH)


def _stribeck(motion, friction, random):
    """20 to 80 % more at low speed, which fades as a Gaussian of 0.02 to 0.2 rad/s."""
    _, v, _ = motion
    viscous, coulomb = friction
    n = coulomb.size
    scale = random.uniform(0.02, 0.2, n)
    more = random.uniform(0.2, 0.8, n)
    fading = np.exp(-((v / scale) ** 2))
    return viscous * v + coulomb * np.tanh(v / _SMOOTH) * (1.0 + more * fading)


def _elastic(motion, friction, random):
    """As LuGre's: contacts yield over 0.2 to 4 mrad, and fade exponentially."""
    q, v, _ = motion
    viscous, coulomb = friction
    n = coulomb.size
    distance = random.uniform(2e-4, 4e-3, n)
    scale = random.uniform(0.02, 0.2, n)
    more = random.uniform(0.2, 0.8, n)
    fading = np.exp(-np.abs(v) / scale)
    return viscous * v + coulomb * sliding_direction(q, v, distance) * (
        1.0 + more * fading
    )


def _rational(motion, friction, random):
    """20 to 80 % more at low speed, which fades as 1 / (1 + (v / v_s)^2): Hess and Soom."""
    _, v, _ = motion
    viscous, coulomb = friction
    n = coulomb.size
    scale = random.uniform(0.02, 0.2, n)
    more = random.uniform(0.2, 0.8, n)
    fading = 1.0 / (1.0 + (v / scale) ** 2)
    return viscous * v + coulomb * np.tanh(v / _SMOOTH) * (1.0 + more * fading)


def _asymmetric(motion, friction, random):
    """Up to 20 % more in one direction, and less in the other."""
    _, v, _ = motion
    viscous, coulomb = friction
    more = random.uniform(-0.2, 0.2, coulomb.size)
    sign = np.tanh(v / _SMOOTH)
    return (viscous * v + coulomb * sign) * (1.0 + more * sign)


def _load(motion, friction, random):
    """Grows by 3 to 12 % of the torque that the gear transmits."""
    _, v, torque = motion
    viscous, coulomb = friction
    more = random.uniform(0.03, 0.12, coulomb.size)
    return viscous * v + (coulomb + more * np.abs(torque)) * np.tanh(v / _SMOOTH)


LAWS: dict[str, Callable[..., np.ndarray]] = {
    'Coulomb': _coulomb,
    'Stribeck': _stribeck,
    'elastic': _elastic,
    'rational': _rational,
    'asymmetric': _asymmetric,
    'load': _load,
}
"""Torques (N, n) of positions, speeds, torques (N, n), viscous and Coulomb friction (n,)."""


def with_friction(law, states, viscous, coulomb, seed):
    """Return states (N, 3, n) of a motion without friction, with the torques for it added.

    The torque of a state is that of the period before it.
    """
    random = np.random.default_rng(seed)
    motion = (states[:, 0], states[:, 1], states[:, 2])
    friction = LAWS[law](motion, (viscous, coulomb), random)
    added = states.copy()
    added[1:, 2] += 0.5 * (friction[1:] + friction[:-1])
    return added
