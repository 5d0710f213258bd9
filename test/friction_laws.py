# SPDX-License-Identifier: Apache-2.0
"""Laws of friction, with viscous and Coulomb friction of their own, to be added to a motion."""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.identification.sliding import sliding_direction

_SMOOTH = 0.005  # rad/s or m/s, of tanh


def _coulomb(_q, v, coulomb, _random):
    return coulomb * np.tanh(v / _SMOOTH)


def _stribeck(_q, v, coulomb, random):
    """20 to 80 % more at low speed, which fades as a Gaussian of 0.02 to 0.2 rad/s."""
    scale = random.uniform(0.02, 0.2, coulomb.size)
    more = random.uniform(0.2, 0.8, coulomb.size)
    fading = np.exp(-((v / scale) ** 2))
    return coulomb * np.tanh(v / _SMOOTH) * (1.0 + more * fading)


def _elastic(q, v, coulomb, random):
    """As LuGre's: contacts yield over 0.2 to 4 mrad, and fade exponentially."""
    distance = random.uniform(2e-4, 4e-3, coulomb.size)
    scale = random.uniform(0.02, 0.2, coulomb.size)
    more = random.uniform(0.2, 0.8, coulomb.size)
    fading = np.exp(-np.abs(v) / scale)
    return coulomb * sliding_direction(q, v, distance) * (1.0 + more * fading)


LAWS = {'Coulomb': _coulomb, 'Stribeck': _stribeck, 'elastic': _elastic}
"""Torques (N, n) of positions and speeds (N, n), and Coulomb friction (n,)."""


def with_friction(law, states, viscous, coulomb, seed):
    """Return states (N, 3, n) of a motion without friction, with the torques for it added.

    The torque of a state is that of the period before it.
    """
    random = np.random.default_rng(seed)
    q, v = states[:, 0], states[:, 1]
    friction = viscous * v + LAWS[law](q, v, coulomb, random)
    added = states.copy()
    added[1:, 2] += 0.5 * (friction[1:] + friction[:-1])
    return added
