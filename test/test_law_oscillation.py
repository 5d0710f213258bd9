# SPDX-License-Identifier: Apache-2.0
"""What the detector takes for an oscillation, and what it does not, on made-up signals."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from blf_dsc_controller.compiled.layout import size_of, view_of
from blf_dsc_controller.law import oscillation
from blf_dsc_controller.law.oscillation import State

LIMIT = 87.0  # N m, of a Panda's shoulder
NOISE = 2e-6  # rad, of an encoder of 20 bits
RESOLUTION = 6e-6  # rad


def watched(error, torque, rate=1000.0, noise=NOISE, resolution=RESOLUTION):
    """Return half waves, frequency [Hz], amplitude [N m], whether it is one, calm [s] (N, 5)."""
    one = SimpleNamespace(n=1)
    now = view_of(State)(np.zeros(size_of(State)(one)), one)
    given = np.array([[LIMIT], [noise**2], [resolution]])
    oscillation.begin(now, error[:1], torque[:1])
    seen = []
    for e, u in zip(error[1:], torque[1:], strict=True):
        state = np.array([e]), np.array([u])
        oscillation.watch(now, given[0], *state, *given[1:], 1.0 / rate)
        half = max(float(now.half[0]), 1e-9)
        is_one = oscillation.oscillates(now, 0)
        row = now.waves[0], 0.5 / half, now.amplitude[0], is_one, now.calm[0]
        seen.append(row)
    return np.array(seen)


def swing(frequency, duration=0.6, rate=1000.0, growth=0.0, size=1e-3, torque=14.0):
    """Return times, errors [rad] and torques [N m] of an oscillation, a tenth of it late."""
    t = np.arange(0.0, duration, 1.0 / rate)
    phase = 2.0 * np.pi * frequency * t
    envelope = np.exp(growth * t)
    noise = np.random.default_rng(0).normal(0.0, NOISE, t.size)
    return (
        t,
        size * envelope * np.sin(phase) + noise,
        -torque * envelope * np.cos(phase),
    )


def oscillates(seen):
    return bool(seen[:, 3].any())


def test_it_is_found_while_it_grows_within_four_periods_of_a_twentieth_of_the_limit():
    """From 0.5 N m it grows by 30 1/s: 4.4 N m after 73 ms, at 31 Hz."""
    _, error, torque = swing(31.0, growth=30.0, size=4e-5, torque=0.5)
    found = int(np.argmax(watched(error, torque)[:, 3])) * 1e-3
    assert 0.073 < found < 0.073 + 4.0 / 31.0


def test_half_waves_that_die_out_are_none():
    """A spring damped by 3 % loses 17 % in a period: a push lets it swing for long."""
    _, error, torque = swing(31.0, growth=-0.03 * 2.0 * np.pi * 31.0, torque=60.0)
    assert not oscillates(watched(error, torque))


@pytest.mark.parametrize('frequency', [184.0, 95.0])
def test_a_light_link_that_rattles_while_friction_reverses_is_none(frequency):
    """The last wrist of a UR5e in the play of its gear, in steps of its encoder of 17 bits.

    4 N m of friction reverse within 60 ms, a seventh of the limit; the torque shakes by
    2 %, or by a tenth, which is an oscillation.
    """
    t = np.arange(0.0, 1.0, 1e-3)
    step = 4.8e-5  # rad
    envelope = np.exp(-np.abs(t - 0.5) / 0.03)
    rattle = np.sin(2.0 * np.pi * frequency * t) * envelope
    q = np.rint(3e-4 * rattle / step) * step
    reversal = 2.0 / 28.0 * LIMIT * np.tanh((t - 0.48) / 0.015)
    seen = watched(q, reversal - 0.02 * LIMIT * rattle, noise=0.0, resolution=step)
    assert not oscillates(seen)
    strong = reversal - 0.1 * LIMIT * rattle
    assert oscillates(watched(q, strong, noise=0.0, resolution=step))


@pytest.mark.parametrize(
    ('noise', 'resolution'), [(2e-6, 0.0), (1e-4, 0.0), (0.0, 3.8e-4)]
)
def test_noise_is_none_however_much_torque_it_makes(noise, resolution):
    """Positions of a resting arm, with a damping of 50 N m s/rad on their differences.

    With steps of 0.38 mrad its torque has 14 N m rms, a sixth of the limit.
    """
    random = np.random.default_rng(1)
    t = np.arange(0.0, 5.0, 1e-3)
    drift = 5e-4 * np.sin(t)
    q = drift + random.normal(0.0, max(noise, 1e-7), t.size)
    if resolution > 0.0:
        q = np.rint(q / resolution) * resolution
    torque = -50.0 * np.diff(q, prepend=q[0]) / 1e-3
    sigma = max(noise, 0.3 * resolution)
    assert not oscillates(watched(q, torque, noise=sigma, resolution=resolution))
