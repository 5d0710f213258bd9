# SPDX-License-Identifier: Apache-2.0
"""Shapes of friction over the velocity v of a joint, for the law and for `identify`.

    Coulomb      s(v) = tanh(v / v_c)             smooth at rest, where the sign would jump
    Stribeck     s(v) g(v),    g(v) = exp(-(v / v_s)^2)             added at breakaway

Some of friction differs between them on purpose:

- v_c is `learning.coulomb_velocity` in the law, 0.01 rad/s or more, since its torque would chatter
  at rest if it were steeper; `identify` only looks back, and has half of that.
- At a reversal, the contacts of `identification.sliding` yield over a distance first.  The law
  follows the velocity of its reference, which has no memory, and measures each reversal.
- Load and quadratic friction are `identify`'s alone: half a minute of motion identifies them, one
  window of the learning does not.
- Simulated plants have friction of their own: a truth that is independent of what looks for it.
"""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.compiled.jit import inner, kernel
from blf_dsc_controller.numerics.elementary import exp, tanh
from blf_dsc_controller.run import Floats

STRIBECK_SPEED = 0.1
"""Scale v_s of the Stribeck friction [rad/s or m/s]."""


@inner
def sliding(velocity: float, scale: float) -> float:
    """Return s(v) = tanh(v / v_c) in [-1, 1]; `scale` is v_c, in units of the velocity."""
    return float(tanh(velocity / scale))


@inner
def fading(velocity: float, scale: float) -> float:
    """Return g(v) = exp(-(v / v_s)^2) in [0, 1]; `scale` is v_s, in units of the velocity."""
    ratio = velocity / scale
    return float(exp(-ratio * ratio))


def slidings(velocity: Floats, scale: float) -> Floats:
    """Return s (N, k) at velocities (N, k); `scale` is v_c."""
    values = np.empty(velocity.shape)
    fill_slidings(np.ascontiguousarray(velocity), scale, values)
    return values


def fadings(velocity: Floats, scale: float) -> Floats:
    """Return g (N, k) at velocities (N, k); `scale` is v_s."""
    values = np.empty(velocity.shape)
    fill_fadings(np.ascontiguousarray(velocity), scale, values)
    return values


@kernel
def fill_slidings(velocity: np.ndarray, scale: float, values: np.ndarray) -> None:
    """Fill s (N, k) at velocities (N, k)."""
    for k in range(velocity.shape[0]):
        for i in range(velocity.shape[1]):
            values[k, i] = sliding(velocity[k, i], scale)


@kernel
def fill_fadings(velocity: np.ndarray, scale: float, values: np.ndarray) -> None:
    """Fill g (N, k) at velocities (N, k)."""
    for k in range(velocity.shape[0]):
        for i in range(velocity.shape[1]):
            values[k, i] = fading(velocity[k, i], scale)
