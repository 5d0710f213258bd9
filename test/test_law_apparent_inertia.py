# SPDX-License-Identifier: Apache-2.0
"""The parts of the measured rotor inertias: band, sums of half oscillations, and J~."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from blf_dsc_controller.compiled.layout import size_of, view_of
from blf_dsc_controller.law import apparent_inertia
from blf_dsc_controller.law.apparent_inertia import Settings, State, Work

N = 2  # joints; the rotor of the second is known
DT = 1e-3  # s
SETTINGS = Settings(
    unsure=1,
    lag=0.0,
    rotor=np.array([0.4, 0.0]),
    joint=np.array([0.5, 0.5]),
    link=np.array([0.1, 0.5]),
)


def part(layout):
    """An empty state, or values of a sample."""
    sizes = SimpleNamespace(n=N)
    return view_of(layout)(np.zeros(size_of(layout)(sizes)), sizes)


def oscillating(inertia, noise=0.0):
    """Return what 0.2 s of 64 Hz show of joints of an inertia [kg m^2] in place of 0.5 kg m^2."""
    state, work = part(State), part(Work)
    random = np.random.default_rng(1)
    w = 0.4 / DT
    for k in range(200):
        # the velocity at the end of an interval, the mean torque in it
        dq = np.full(N, 0.1 * np.sin(w * k * DT)) + noise * random.normal(size=N)
        rise = 0.1 * (np.sin(w * (k + 1) * DT) - np.sin(w * k * DT))
        applied = np.full(N, inertia * rise / DT)
        if k == 0:
            apparent_inertia.begin(state, dq, applied)
            continue
        apparent_inertia.pass_band(SETTINGS, state, work, dq, applied, DT)
        if apparent_inertia.has_settled(k, DT):
            Yp = np.diag(work.acceleration)
            P0 = np.full(N, 0.5)
            apparent_inertia.update(SETTINGS, state, work, Yp, P0, DT)
    return state


@pytest.mark.parametrize(
    ('inertia', 'error'),
    [
        (0.5, 0.0),
        (0.3, -0.2),
        (0.2, -0.3),
        (0.05, -0.4),  # no rotor is lighter than none
        (0.8, 0.0),  # a heavier one is not for granted
    ],
)
def test_error_of_the_guess_is_that_of_the_inertia_in_an_oscillation(inertia, error):
    """To 0.03 kg m^2: the least sum that shows anything pulls to zero, and filters differ."""
    state = oscillating(inertia)
    assert state.error[0] == pytest.approx(error, abs=0.03)
    # (0.5 + J~) / 0.5 at J~ = 0, 0.2 at J~ = -0.4
    assert state.gain_scale[0] == pytest.approx(1.0 + 2.0 * state.error[0])
    assert state.error[1] == 0.0


def test_nothing_is_measured_where_acceleration_is_not_clear_of_noise():
    """0.05 rad/s of noise are 50 rad/s^2 a sample, as much as the acceleration."""
    assert oscillating(0.1, noise=0.05).error[0] == 0.0


HALF_ZR, HALF_ZA = 2, 3


@pytest.mark.parametrize(
    ('asked', 'work', 'kept'),
    [
        (-0.5, 1.0, True),
        (-1.9, 1.0, True),
        (-2.1, 1.0, False),  # more than twice the guess less
        (1.0, 1.0, True),
        (3.0, -1.0, False),  # against its torque
    ],
)
def test_half_oscillation_counts_if_a_drive_explains_it(asked, work, kept):
    state = part(State)
    half = [asked * SETTINGS.rotor[0], work]
    state.sums[[HALF_ZR, HALF_ZA], 0] = half
    apparent_inertia.end_half_oscillation(SETTINGS, state, 0)
    assert state.sums[:2, 0].tolist() == (half if kept else [0.0, 0.0])
    assert not state.sums[[HALF_ZR, HALF_ZA]].any()


def test_half_oscillation_ends_where_the_acceleration_changes_its_sign():
    state = part(State)
    for z, a in ((2.0, 1.0), (3.0, 2.0), (-1.0, -1.0)):
        apparent_inertia.add_to_sums(SETTINGS, state, 0, z, 0.0, a, DT)
    np.testing.assert_allclose(state.sums[1, 0], DT * (2.0 * 1.0 + 3.0 * 2.0))
    np.testing.assert_allclose(state.sums[HALF_ZA, 0], DT * 1.0)


def test_too_little_motion_shows_nothing():
    """z a below 0.05 s (rad/s^2)^2 times the inertia of 0.5 kg m^2."""
    state = part(State)
    for za, error in ((0.024, 0.0), (0.026, -0.2 * 0.026 / 0.051)):
        state.sums[:2, 0] = -0.2 * za, za
        apparent_inertia.estimate(SETTINGS, state, 0)
        assert state.error[0] == pytest.approx(error)
