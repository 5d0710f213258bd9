# SPDX-License-Identifier: Apache-2.0
"""What the detector takes for an oscillation, and what it does not, on made-up signals."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from blf_dsc_controller.compiled.layout import size_of, view_of
from blf_dsc_controller.law import oscillation
from blf_dsc_controller.law.oscillation import FEW, WAVES, State

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


@pytest.mark.parametrize(
    ('rate', 'frequency'),
    [(1000.0, 9.0), (1000.0, 31.0), (1000.0, 200.0), (500.0, 60.0), (250.0, 31.0)],
)
def test_an_oscillation_has_its_frequency_and_the_amplitude_of_its_torque(
    rate, frequency
):
    """Within 5 %: a sample more or less in four half periods of 200 Hz would be 5 %.

    The high pass takes a fifth of the torque at 9 Hz.
    """
    _, error, torque = swing(frequency, 1.0, rate)
    _, found, amplitude, is_one, _ = watched(error, torque, rate)[-1]
    assert is_one
    assert found == pytest.approx(frequency, rel=0.05)
    assert 0.7 * 14.0 < amplitude < 1.1 * 14.0


def test_an_arm_is_calm_until_the_third_half_wave():
    """One or two are no cause of a stop: any push makes them."""
    _, error, torque = swing(31.0)
    seen = watched(error, torque)
    third = int(np.argmax(seen[:, 0] >= FEW))
    assert seen[:third, 0].max() == FEW - 1
    assert np.isinf(seen[:third, 4]).all()
    assert seen[third, 4] < 1.5e-3  # a sample


def test_it_is_found_while_it_grows_within_four_periods_of_a_twentieth_of_the_limit():
    """From 0.5 N m it grows by 30 1/s: 4.4 N m after 73 ms, at 31 Hz."""
    _, error, torque = swing(31.0, growth=30.0, size=4e-5, torque=0.5)
    found = int(np.argmax(watched(error, torque)[:, 3])) * 1e-3
    assert 0.073 < found < 0.073 + 4.0 / 31.0


def test_half_waves_that_die_out_are_none():
    """A spring damped by 3 % loses 17 % in a period: a push lets it swing for long."""
    _, error, torque = swing(31.0, growth=-0.03 * 2.0 * np.pi * 31.0, torque=60.0)
    assert not oscillates(watched(error, torque))


def test_a_slower_motion_beneath_changes_nothing():
    """A reversal of 20 mrad at 0.5 Hz, as of a load that is picked up."""
    t, error, torque = swing(31.0)
    slow = 0.02 * np.sin(np.pi * t)
    seen = watched(error + slow, torque + 30.0 * np.sin(np.pi * t))
    assert oscillates(seen)
    assert seen[-1, 1] == pytest.approx(31.0, rel=0.05)
    assert not oscillates(watched(slow, 30.0 * np.sin(np.pi * t)))


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


def test_ripple_at_a_steady_speed_is_none():
    """30 cycles a turn at 2 rad/s are 9.5 Hz, of 1.6 % of the limit."""
    t, error, torque = swing(9.5, 3.0, size=2e-4, torque=0.016 * LIMIT)
    assert not oscillates(watched(error, torque))
    assert t.size == error.size


def test_a_tone_of_the_reference_is_none():
    """12 Hz with 15 N m: the arm follows it within noise and a thousandth of a degree."""
    _, error, torque = swing(12.0, 3.0, size=3e-6, torque=15.0)
    assert not oscillates(watched(error, torque))


def test_a_step_and_a_jump_are_none():
    """A pushed arm that returns within 30 ms, and a reading 3 mrad off for one sample."""
    t = np.arange(0.0, 1.0, 1e-3)
    error = 5e-3 * np.exp(-t / 0.03) * (t > 0.0)
    error[500] += 3e-3
    assert not oscillates(watched(error, -1e4 * error))


def reports(waves, amplitude):
    """Return the samples, of 600 at 1 kHz, in which an oscillation is reported."""
    one = SimpleNamespace(n=1)
    now = view_of(State)(np.zeros(size_of(State)(one)), one)
    oscillation.begin(now, np.zeros(1), np.zeros(1))
    limit = np.array([LIMIT])
    assert not oscillation.count_down(now, limit, 1e-3)
    now.waves[0], now.amplitude[0] = waves, amplitude
    return [k for k in range(600) if oscillation.count_down(now, limit, 1e-3)]


def test_an_oscillation_is_reported_at_once_and_again_while_it_lasts():
    """Every 0.25 s, but in each sample once it has half of the torque limit."""
    assert reports(WAVES, 14.0) == pytest.approx([0, 250, 500], abs=2)
    assert reports(WAVES, 0.6 * LIMIT) == [*range(600)]
    assert reports(WAVES - 1, 0.6 * LIMIT) == []


def test_an_oscillation_that_grows_is_found_two_half_waves_earlier():
    """By 2.2 in a period; one of the same torque that lasts has to go on."""
    _, error, torque = swing(31.0, growth=25.0, size=2e-4, torque=6.0)
    grows = watched(error, torque)
    found = int(np.argmax(grows[:, 3]))
    assert grows[found, 0] == WAVES - 2
    _, error, torque = swing(31.0)
    lasts = watched(error, torque)
    assert lasts[int(np.argmax(lasts[:, 3])), 0] == WAVES
