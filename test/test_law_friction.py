# SPDX-License-Identifier: Apache-2.0
"""The parts of the learned friction: its compensation and its evidence."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from blf_dsc_controller.arms.friction import STRIBECK_SPEED
from blf_dsc_controller.compiled.layout import size_of, view_of
from blf_dsc_controller.law import friction, reversals
from blf_dsc_controller.law.friction import Settings, State, Work

N = 1  # joints; theta = (a parameter, Coulomb friction)
F = 0.1  # N m, unmodelled
SETTINGS = Settings(
    viscous=0,
    coulomb=1,
    first_viscous=1,
    first_coulomb=1,
    learns=1,
    bumpless=1,
    coulomb_velocity=0.02,
    lag=0.0,
    pole=20.0,
    reversals=reversals.Settings(
        unmodelled=np.array([F]),
        initial=np.array([3.0]),
        variance=np.array([2.25]),
        least=np.array([1.0]),
        most=np.array([9.0]),
    ),
    gain=np.array([2.0]),
)


def part(layout):
    """An empty state, or values of a sample."""
    sizes = SimpleNamespace(n=N)
    return view_of(layout)(np.zeros(size_of(layout)(sizes)), sizes)


def learned_case(learned):
    """A joint in motion, of which all evidence agrees with what is learned [N m]."""
    state, work = part(State), part(Work)
    state.reversals.shown.coulomb[:] = learned
    work.sign[:] = 1.0
    return state, work


def compensation(state, work, learned, settings=SETTINGS):
    return friction.coulomb_torque(settings, state, work, learned, 0)


@pytest.mark.parametrize(
    ('evidence', 'value', 'expected'),
    [
        (None, 0.0, 1.0),  # all agrees with 1 N m, in place of the assumed 3 N m
        # Up to the dead band of 0.1 N m, the compensation is the nearest to 3 N m:
        ('coulomb', (2.0, 1.0), 1.9),  # the last reversal showed 2 N m
        ('coulomb', (1.0, 2.0), 1.9),  # the one before did
        ('coulomb', (9.0, 1.0), 3.0),  # no more than is assumed
        ('coulomb', (0.5, 1.0), 1.0),  # less is no reason to go away from it
        ('observer_drift', (0.5,), 1.4),
        ('observer_drift', (-0.5,), 1.0),
        ('drift_extremes', (-0.5, 0.0), 1.0),
        ('drift_extremes', (0.0, 0.5), 1.4),
    ],
)
def test_friction_is_compensated_within_the_evidence(evidence, value, expected):
    state, work = learned_case(1.0)
    if evidence:
        part_of = getattr(
            state.reversals.shown if evidence == 'coulomb' else state, evidence
        )
        part_of[:] = np.reshape(value, part_of.shape)
    assert compensation(state, work, 1.0) == pytest.approx(expected)
    work.sign[:] = -1.0
    assert compensation(state, work, 1.0) == pytest.approx(-expected)


def test_least_drift_lowers_what_is_compensated():
    """9 N m are learned in place of 3 N m; d^3 once fell by 2 N m."""
    state, work = learned_case(9.0)
    assert compensation(state, work, 9.0) == 9.0
    state.drift_extremes[0] = -2.0
    assert compensation(state, work, 9.0) == pytest.approx(7.1)
    # A law that hands nothing over to d^3 uses what it learns.
    at_once = SETTINGS._replace(bumpless=0)
    assert compensation(state, work, 9.0, at_once) == 9.0


def test_breakaway_is_relative_to_the_learned_friction():
    state, work = learned_case(9.0)
    state.breakaway[:] = 0.5
    state.shape_lags[1, 0] = -0.4  # b = s exp(-(v / v_s)^2), at the measured velocity
    estimate = np.array([0.0, 9.0])
    found = friction.breakaway_torque(SETTINGS, state, estimate, 0)
    assert found == pytest.approx(9.0 * 0.5 * -0.4)
    without = SETTINGS._replace(coulomb=0)
    assert friction.breakaway_torque(without, state, estimate, 0) == 0.0
    work.stribeck[:] = 1.0
    assert compensation(state, work, 9.0) == pytest.approx(1.5 * 9.0)


def after_a_reversal(seconds, friction_of):
    """The state so long after a joint has reversed whose friction [N m] is that of a time [s]."""
    state, work, dt = part(State), part(Work), 0.01
    friction.begin(SETTINGS, state)
    state.drift_extremes[:, 0] = -1.0, 1.0
    for k in range(round(seconds / dt)):
        s = state.shape_lags[0, 2, 0] = 1.0 if k else -1.0
        work.unexplained[:] = s * friction_of(k * dt)
        friction.measure_reversals(SETTINGS, state, work, k == 0, dt)
    return state


@pytest.mark.parametrize(('seconds', 'is_kept'), [(0.01, True), (0.02, False)])
def test_reversal_that_shows_its_friction_forgets_earlier_drift(seconds, is_kept):
    """It does so with the first row of the step."""
    state = after_a_reversal(seconds, lambda _: 5.0)
    assert state.drift_extremes.any() == is_kept


@pytest.mark.parametrize(
    ('at', 'shown', 'kept'),
    [
        (0.01, 9.0, 3.0),  # the reversal had just begun, and is forgotten as a whole
        (0.19, 4.2, 3.0),
        (0.22, 4.47, 5.0),  # it had shown its friction 0.15 s ago
        (0.49, 4.99, 5.0),  # it is long over
    ],
)
def test_rows_of_a_change_show_no_friction(at, shown, kept):
    """20 N m come on `at` seconds after a joint with 5 N m reverses, and are found 0.1 s later."""
    state = after_a_reversal(at + 0.1, lambda t: 5.0 + 20.0 * (t >= at))
    found = state.reversals.shown
    assert found.coulomb[0, 0] == pytest.approx(shown, abs=0.01)
    reversals.take_back(state.reversals, state.breakaway)
    assert found.coulomb[0, 0] == pytest.approx(kept, abs=0.01)
    assert found.present.any() == (kept == 5.0)
    # another change, found at once: nothing of the first comes back
    reversals.keep(state.reversals, 1.0)
    reversals.take_back(state.reversals, state.breakaway)
    assert found.coulomb[0, 0] == pytest.approx(kept, abs=0.01)


@pytest.mark.parametrize(('factor', 'extremes'), [(1.0, [0.0, 0.5]), (-1.0, [-0.5, 0])])
def test_drift_of_the_observer_is_counted_along_the_motion_until_the_joint_reverses(
    factor, extremes
):
    state, work = part(State), part(Work)
    for sign, step in ((1.0, 0.3), (0.5, 0.2), (-0.5, 5.0), (-1.0, -0.4)):
        work.sign[:] = sign
        friction.follow_motion(SETTINGS, state, work)
        friction.follow_observer(state, work, 0, factor * step)
    # 0.3 and 0.2 N m along the first motion, nothing between, 0.4 along the second
    assert state.observer_drift[0] == pytest.approx(factor * 0.4)
    np.testing.assert_allclose(state.drift_extremes[:, 0], extremes)
    assert state.direction[0] == -1.0


@pytest.mark.parametrize(('moved', 'is_closed'), [(0.0, False), (1.0, True)])
def test_reversal_is_closed_as_the_next_begins(moved, is_closed):
    """Not while its joint is slow."""
    state, work = part(State), part(Work)
    friction.begin(SETTINGS, state)
    state.moves[:] = moved
    state.reversals.shown.present[[0, 2], 0] = 3.0 * 0.125, 0.125
    work.sign[:] = 0.5
    friction.follow_motion(SETTINGS, state, work)
    assert state.reversals.shown.past.any() == is_closed
    assert state.reversals.shown.present.any() != is_closed
    assert state.moves[0] == 0.0


def test_friction_is_that_at_the_velocity_when_the_torque_acts():
    """1.5 samples of 2 ms and half of 10 ms later: 8 ms."""
    settings = SETTINGS._replace(viscous=1, first_viscous=0, lag=0.01)
    state, work = learned_case(4.0)
    dqr, ddqr, H = np.array([0.01]), np.array([1.0]), np.full((1, 2), 7.0)
    theta = np.array([0.0, 4.0])
    friction.fill_compensation(settings, state, work, theta, dqr, ddqr, H, 0.002)
    np.testing.assert_allclose(H, [[0.018, 7.0]])
    np.testing.assert_allclose(work.sign, np.tanh(0.018 / 0.02))
    np.testing.assert_allclose(work.torque, 4.0 * np.tanh(0.018 / 0.02))


def test_shapes_are_means_over_the_interval_behind_both_poles():
    """As a row of the torque is, of a joint that begins to move, and then moves on."""
    state, dt = part(State), 0.01
    gain = 1.0 - np.exp(-20.0 * dt)
    first, second = np.zeros(2), np.zeros(2)
    for mean in (0.5, 1.0, 1.0):
        friction.filter_shapes(SETTINGS, state, np.array([1.0]), dt)
        b = np.exp(-((1.0 / STRIBECK_SPEED) ** 2))
        first += gain * (mean * np.array([1.0, b]) - first)
        second += gain * (first - second)
        np.testing.assert_allclose(state.shape_lags[:, 0, 0], [1.0, b])
        np.testing.assert_allclose(state.shape_lags[:, 2, 0], second)


def test_high_pass_leaves_nothing_of_what_lasts_and_begins_at_rest():
    lags, gain = np.zeros((2, 1)), 0.1
    assert friction.high_pass(lags, 0, gain, 3.0, begins=True) == 0.0
    assert friction.high_pass(lags, 0, gain, 4.0, begins=False) == pytest.approx(0.81)
    for _ in range(300):
        left = friction.high_pass(lags, 0, gain, 4.0, begins=False)
    assert left == pytest.approx(0.0, abs=1e-9)
    friction.high_pass(lags, 0, gain, 9.0, begins=False)
    assert friction.high_pass(lags, 0, gain, 5.0, begins=True) == 0.0


def test_what_is_unexplained_is_the_torque_less_all_but_the_own_column():
    row, theta = np.array([2.0, 3.0, 5.0, 40.0]), np.array([1.0, 4.0, 2.0])
    for own, expected in ((0, 18.0), (1, 28.0), (2, 26.0)):
        assert friction.unexplained(row, theta, own) == expected


def test_time_since_the_latch_is_that_of_the_window_that_is_latched():
    state = part(State)
    times = [friction.update_since_latch(state, now, 0.5) for now in (1, 1, 0, 0, 1)]
    assert times == [0.5, 1.0, 0.0, 0.0, 0.5]


@pytest.mark.parametrize(
    ('shown', 'active', 'gain', 'expected'),
    [
        (5.0, 1.0, 2.0, (5.0, 0.0)),
        (50.0, 1.0, 2.0, (9.0, 0.0)),  # the most that it can be
        (-5.0, 1.0, 2.0, (1.0, 0.0)),  # the least
        (5.0, 0.0, 2.0, (7.0, 0.3)),  # its column was rejected
        (5.0, 1.0, 0.0, (7.0, 0.3)),  # it is not learned
    ],
)
def test_estimate_returns_to_what_reversals_show(shown, active, gain, expected):
    settings = SETTINGS._replace(gain=np.array([gain]))
    state = part(State)
    state.reversals.shown.past[[0, 2, 4], 0] = shown, 1.0, 1.0
    state.breakaway[:] = 0.3
    estimate = np.array([4.0, 7.0])
    friction.return_estimate(settings, state, np.array([1.0, active]), estimate)
    assert estimate[0] == 4.0
    assert estimate[1] == pytest.approx(expected[0], abs=1e-3)
    assert state.breakaway[0] == expected[1]


def test_change_of_the_friction_is_taken_from_the_disturbance_estimate():
    """Their sum does not change: it is the torque."""
    state, work = learned_case(4.0)
    work.torque[:] = compensation(state, work, 4.0)
    state.reversals.shown.coulomb[:] = 5.0
    disturbance = np.array([0.7])
    friction.transfer_learned(SETTINGS, state, work, np.array([0.0, 5.0]), disturbance)
    assert work.torque[0] == pytest.approx(5.0)
    assert disturbance[0] + work.torque[0] == pytest.approx(0.7 + 4.0)


def test_learned_friction_moves_the_estimate_unless_its_column_was_rejected():
    state, work = part(State), part(Work)
    # sums of s e, s^2 and b^2: 4 N m, and no breakaway
    state.reversals.shown.past[[0, 2, 4], 0] = 4.0, 1.0, 1.0
    rate = np.zeros(2)
    estimate = np.array([0.0, 3.0])
    for active, expected in ((0.0, 0.0), (1.0, 1.0)):
        mask = np.array([1.0, active])
        friction.follow_reversals(SETTINGS, state, work, mask, estimate, rate)
        assert rate[1] == pytest.approx(expected, abs=1e-3)
    state.breakaway[:] = 0.2
    friction.follow_reversals(SETTINGS, state, work, mask, estimate, rate)
    friction.adapt_breakaway(SETTINGS, state, work, 0.001)
    # back to k = 0, at a rate of 2 / s
    left = 0.2 - 0.001 * 2.0 * 0.2
    assert state.breakaway[0] == pytest.approx(left)
    mask[1] = 0.0
    friction.follow_reversals(SETTINGS, state, work, mask, estimate, rate)
    friction.adapt_breakaway(SETTINGS, state, work, 0.001)
    assert state.breakaway[0] == pytest.approx(left)
