# SPDX-License-Identifier: Apache-2.0
"""What reversals show of friction: their sums, the last two of them, a change of the arm."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from blf_dsc_controller.compiled.layout import size_of, view_of
from blf_dsc_controller.law import reversals
from blf_dsc_controller.law.reversals import Settings, State

SETTINGS = Settings(
    unmodelled=np.array([0.1]),
    initial=np.array([3.0]),
    variance=np.array([2.25]),
    least=np.array([1.0]),
    most=np.array([9.0]),
)
SE, BE, SS, SB, BB = range(5)


def begun():
    """The state of one joint that has not reversed yet."""
    sizes = SimpleNamespace(n=1)
    state = view_of(State)(np.zeros(size_of(State)(sizes)), sizes)
    reversals.begin(SETTINGS, state)
    return state


@pytest.mark.parametrize(
    ('last', 'before', 'expected'),
    [
        (4.0, 5.0, 4.5),  # both are above 3 N m: their mean
        (2.0, 1.0, 1.5),  # both are below
        (4.0, 2.0, 3.0),  # they contradict each other
        (4.0, 3.05, 3.0),  # one of them agrees, within 0.1 N m
    ],
)
def test_two_reversals_overrule_the_sums_if_both_contradict_them(
    last, before, expected
):
    """The sums of eight reversals, which say 3 N m as the prior does, without breakaway.

    The prior pulls to 3 N m by 0.015 (0.1 / 1.5)^2, 7e-5 of the sums.
    """
    state = begun()
    shown = state.shown
    shown.past[[SE, SS, BB], 0] = 3.0, 1.0, 1.0
    shown.coulomb[:, 0] = last, before
    reversals.overrule(SETTINGS, state, 0)
    coulomb, stribeck = reversals.learned(SETTINGS, state, 0, 0.0)
    assert coulomb == pytest.approx(expected, abs=1e-3)
    assert stribeck == 0.0


def add(state, energy, friction, push=0.0):
    """Add a row of a joint without breakaway, 0.01 s after the last, with its p s_h^2 dt.

    A `push` [N m] is as large beside the step of friction.
    """
    s = np.sqrt(energy)
    row = reversals.Row(s, 0.0, friction * s + push, 1.0)
    return reversals.add_row(SETTINGS, state, 0, row, 0.0, 0.01)


@pytest.mark.parametrize('f', [0.3, 1.0, 1.5])
def test_friction_is_that_of_least_squares_with_the_prior(f):
    """c and c k, pulled by 0.015 (f / 1.5)^2 to 3 N m, and by a tenth of that to 0."""
    settings = SETTINGS._replace(unmodelled=np.array([f]))
    state = begun()
    s, b = np.random.default_rng(3).uniform(0.1, 0.2, size=(2, 12))
    e = 5.0 * s + 2.0 * b + 0.05 * np.arange(12)
    state.shown.past[:, 0] = s @ e, b @ e, s @ s, s @ b, b @ b
    pull = 0.015 * (f / 1.5) ** 2
    A = np.array([[s @ s + pull, s @ b], [s @ b, b @ b + 0.1 * pull]])
    c, ck = np.linalg.solve(A, [s @ e + pull * 3.0, b @ e])
    assert 0.0 < ck / c < 1.0
    found = reversals.learned(settings, state, 0, 0.0)
    np.testing.assert_allclose(found, [c, ck / c], rtol=1e-9)


@pytest.mark.parametrize(
    ('be', 'k'),
    [(-1.0, 0.0), (0.0, 0.0), (4.0, 1.0), (9.0, 1.0)],  # it would have the other sign
)
def test_breakaway_is_within_its_limits_also_where_it_is_all_of_the_friction(be, k):
    """c is then that for this k: (s e + k b e) / (s^2 + 2 k s b + k^2 b^2)."""
    state = begun()
    state.shown.past[:, 0] = 1.0, be, 1.0, 0.25, 0.25
    c, stribeck = reversals.learned(SETTINGS, state, 0, 0.0)
    assert stribeck == k
    expected = (1.0 + k * be) / (1.0 + 0.5 * k + 0.25 * k * k)
    assert c == pytest.approx(expected, abs=1e-3)


def test_breakaway_stays_where_two_reversals_overrule_the_sums():
    """They have shown 4 and 5 N m, the sums 3 N m with a half of it in excess."""
    state = begun()
    ss, sb, bb = 1.0, 0.25, 0.25
    se, be = 3.0 * ss + 1.5 * sb, 3.0 * sb + 1.5 * bb
    state.shown.past[:, 0] = se, be, ss, sb, bb
    state.shown.coulomb[:, 0] = 4.0, 5.0
    reversals.overrule(SETTINGS, state, 0)
    found = reversals.learned(SETTINGS, state, 0, 0.0)
    np.testing.assert_allclose(found, [4.5, 0.5], atol=1e-3)


def test_energy_of_a_reversal_is_that_of_friction_with_breakaway():
    """(s + k b)^2, summed over rows."""
    state = begun()
    s, b = np.random.default_rng(4).uniform(size=(2, 5))
    state.shown.present[[SS, SB, BB], 0] = s @ s, s @ b, b @ b
    for k in (0.0, 0.3, 1.0):
        energy = reversals.energy(state.shown, 0, k)
        assert energy == pytest.approx(np.sum((s + k * b) ** 2))


@pytest.mark.parametrize(('c', 'allowed'), [(0.0, 1.0), (3.0, np.hypot(1.0, 6.0))])
def test_trust_is_a_half_where_the_misfit_is_what_the_shape_may_be_wrong_by(c, allowed):
    """a: half of the unmodelled 2 N m, and twice the friction that is known."""
    settings = SETTINGS._replace(unmodelled=np.array([2.0]), initial=np.array([c]))
    state = begun()
    state.shown.present[[SE, SS], 0] = 5.0 * 0.1, 0.1
    for misfit, trust in ((0.0, 1.0), (1.0, 0.5), (3.0, 0.1)):
        state.shown.torque[:] = 5.0**2 * 0.1 + misfit**2 * allowed**2 * 0.1
        found = reversals.trust(settings, state, 0, 0.0)
        assert found == pytest.approx(trust)


def test_twice_the_noise_is_no_misfit():
    """Of 1.5 N m rms, over 0.2 of p int dt; ten times that, 4.5, is one: a^2 is 36, of 0.1."""
    state = begun()
    state.usual[:, 0] = 1.5**2 * 7.0, 7.0
    state.shown.present[[SE, SS], 0] = 5.0 * 0.1, 0.1
    state.shown.span[:] = 0.2
    for times, trust in ((1.0, 1.0), (2.0, 1.0), (12.0, 3.6 / (3.6 + 4.5))):
        state.shown.torque[:] = 5.0**2 * 0.1 + times * 1.5**2 * 0.2
        found = reversals.trust(SETTINGS, state, 0, 0.0)
        assert found == pytest.approx(trust, rel=1e-3)


def test_torque_before_a_reversal_counts_less_the_earlier_it_was():
    """It fades by a tenth of a second; rows are 0.01 s apart."""
    for rows in (1, 5, 20):
        state = begun()
        for k in range(rows + 1):
            e = 3.0 if k == 0 else 0.0
            row = reversals.Row(1.0 if k == rows else 0.0, 0.0, e, 1.0)
            reversals.add_torque(state, 0, row, 0.01)
        assert state.shown.torque[0] == pytest.approx(9.0 * np.exp(-0.1 * rows))
        span = np.exp(-0.1 * np.arange(rows + 1)).sum()
        assert state.shown.span[0] == pytest.approx(span)


def test_noise_is_that_of_the_last_seconds_away_from_reversals():
    """Of 1 N m, and then of 2 N m for 20 s; e^-5 of the first is left after 4 s each."""
    state = begun()
    for e in (1.0, 2.0):
        for _ in range(2000):
            reversals.add_torque(state, 0, reversals.Row(0.0, 0.0, e, 0.01), 0.01)
    noise = state.usual[0, 0] / state.usual[1, 0]
    assert noise == pytest.approx(4.0 - 3.0 * np.exp(-5.0), rel=1e-3)
    assert not state.shown.torque.any()


def test_one_reversal_that_is_more_than_all_replaces_them():
    state = begun()
    state.shown.past[[SE, SS], 0] = 3.0 * 0.5, 0.5
    state.shown.coulomb[:] = 3.0
    state.shown.present[[SE, SS], 0] = 3.02 * 2.0, 2.0
    share = reversals.counted(SETTINGS, state, 0, 0.0)
    reversals.close(SETTINGS, state, 0, 0.0)
    np.testing.assert_allclose(
        state.shown.past[[SE, SS], 0], [share * 6.04, share * 2.0]
    )


def test_reversal_that_is_over_leaves_nothing_to_the_next():
    state = begun()
    for _ in range(10):
        add(state, 0.008, 4.0)
    assert state.shown.torque[0] > 0.0
    reversals.close(SETTINGS, state, 0, 0.0)
    assert state.shown.past[SS, 0] == pytest.approx(0.08, rel=0.1)
    for part in ('present', 'torque', 'span'):
        assert not getattr(state.shown, part).any()


def test_reversal_shows_its_friction_once():
    """Once p int s_h^2 dt is 0.05, half a reversal."""
    state = begun()
    shown = state.shown
    assert not add(state, 0.045, 4.0)
    assert shown.coulomb[:, 0].tolist() == [3.0, 3.0]
    assert add(state, 0.02, 4.0)
    np.testing.assert_allclose(shown.coulomb[:, 0], [4.0, 3.0])
    assert not add(state, 0.01, 4.0)
    np.testing.assert_allclose(shown.coulomb[:, 0], [4.0, 3.0])


@pytest.mark.parametrize(('friction', 'shown'), [(40.0, 9.0), (-2.0, 1.0)])
def test_reversal_shows_friction_within_its_limits(friction, shown):
    state = begun()
    assert add(state, 0.06, friction)
    assert state.shown.coulomb[:, 0].tolist() == [shown, 3.0]


@pytest.mark.parametrize(('first', 'last'), [(0, 3.0), (8, 3.0), (15, 4.0)])
def test_reversal_in_which_something_pushes_is_not_learned(first, last):
    """40 N m in 3 rows before it, in it, and after it, where it has shown 4 N m already.

    Friction, assumed to be 3 N m, may be 6 N m off in its shape.
    """
    state = begun()
    for k in range(-300, 20):
        reverses = 0.008 if 5 <= k < 15 else 0.0
        add(state, reverses, 4.0, push=40.0 if first <= k < first + 3 else 0.0)
    assert reversals.energy(state.shown, 0, 0.0) == pytest.approx(0.08)
    assert reversals.trust(SETTINGS, state, 0, 0.0) < 0.01
    np.testing.assert_allclose(state.shown.coulomb[:, 0], [last, 3.0])
    assert reversals.learned(SETTINGS, state, 0, 0.0) == (pytest.approx(3.0), 0.0)
    reversals.close(SETTINGS, state, 0, 0.0)
    assert not state.shown.past.any()


def test_push_long_before_a_reversal_or_after_it_is_not_of_it():
    """1 s away: ten times what is compared around it."""
    state = begun()
    for k in range(230):
        reverses = 0.008 if 100 <= k < 110 else 0.0
        add(state, reverses, 4.0, push=0.0 if 3 <= k < 220 else 40.0)
    assert reversals.trust(SETTINGS, state, 0, 0.0) > 0.9
    assert state.shown.coulomb[0, 0] == pytest.approx(4.0, abs=0.1)
    found, _ = reversals.learned(SETTINGS, state, 0, 0.0)
    assert found == pytest.approx(4.0, abs=0.1)


def test_noise_is_no_reason_not_to_count_a_reversal():
    """Of 5 N m rms, by which its 4 N m are learned as well as the noise lets them."""
    state = begun()
    noise = np.random.default_rng(0).normal(0.0, 5.0, 1200)
    for k in range(1200):
        reverses = 0.008 if 1000 <= k < 1010 else 0.0
        add(state, reverses, 4.0, push=noise[k])
    assert reversals.trust(SETTINGS, state, 0, 0.0) > 0.5


def test_friction_whose_shape_is_another_still_counts():
    """Where breakaway, say, adds half of c to every other row."""
    state = begun()
    for k in range(10):
        add(state, 0.008, 4.0 if k % 2 else 2.0)
    assert reversals.trust(SETTINGS, state, 0, 0.0) > 0.9


def test_beginning_of_a_reversal_shows_nothing_and_is_kept_for_it():
    """Its sums are too small to tell friction from breakaway, or from anything else."""
    state = begun()
    add(state, 0.01, 8.0)
    assert reversals.learned(SETTINGS, state, 0, 0.0) == (pytest.approx(3.0), 0.0)
    reversals.close(SETTINGS, state, 0, 0.0)
    assert not state.shown.past.any()
    assert reversals.energy(state.shown, 0, 0.0) == pytest.approx(0.01)


def test_sums_of_past_reversals_forget_what_is_older_than_eight():
    """Friction that differs by less than what is unmodelled is averaged."""
    state = begun()
    shown = state.shown
    for friction, expected in ((5.0, 5.0), (5.08, 5.08)):
        for _ in range(40):
            shown.present[[SE, SS], 0] = 0.125 * friction, 0.125
            shown.coulomb[:] = friction
            reversals.close(SETTINGS, state, 0, 0.0)
            assert not shown.present.any()
            assert shown.past[SS, 0] <= 1.0 + 1e-12
        found, _ = reversals.learned(SETTINGS, state, 0, 0.0)
        assert found == pytest.approx(expected, abs=0.005)


@pytest.mark.parametrize(
    ('ago', 'coulomb', 'last'),
    [
        (0.1, 3.0, 3.0),  # s since a reversal with 8 N m has ended
        (0.4, 8.0, 8.0),
    ],
)
def test_reversal_that_ended_as_the_arm_changed_is_taken_back(ago, coulomb, last):
    state = begun()
    state.shown.present[[SE, SS], 0] = 0.125 * 8.0, 0.125
    state.shown.coulomb[0] = 8.0
    reversals.close(SETTINGS, state, 0, 0.0)
    for _ in range(round(100 * ago)):
        reversals.keep(state, 0.01)
    reversals.take_back(state, np.zeros(1))
    found, _ = reversals.learned(SETTINGS, state, 0, 0.0)
    assert found == pytest.approx(coulomb, abs=0.01)
    assert state.shown.coulomb[0, 0] == last
