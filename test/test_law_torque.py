# SPDX-License-Identifier: Apache-2.0
"""The torque of the laws, term by term, and its limits: cuts, and their effect on learning."""

from __future__ import annotations

import numpy as np
import pytest
from arbitrary_case import arbitrary
from closed_loop_case import closed_loop, controller, plant, quick, recommended
from plain_law import PlainLaw

from blf_dsc_controller.law.settings import COMPENSATIONS, EFFORT, UPDATES
from blf_dsc_controller.law.torque import LEVEL_CUT, RATE_CUT, find_applied, saturate

# The window is not a multiple of the interval, and learning lasts nearly a second. For so short
# a window the condition number of Phi is 1e7; rho = 10 keeps the amplified rounding below 1e-12,
# but would spoil the inverse iteration, so every window counts as excited.
SHORT = {'window': 497, 'interval': 7, 'learning_start': 0.6, 'rho': 10.0, 'sigma': -1.0}
ROUNDING = 1e-12
AT_STATE = COMPENSATIONS.index('state')
GRADIENT = UPDATES.index('gradient')
CASES = {
    'newton': ({}, {}),
    'gradient': ({'update': GRADIENT, 'kappa': 2.0}, {}),
    "the paper's compensation": ({'compensation': AT_STATE}, {}),
    'no bias columns': ({'bias': False}, {}),
    'damping and leakage': ({'d2': np.array([300.0, 200.0]), 'eta': 0.5}, {}),
    'effort': ({'torque_source': EFFORT}, {'delay': 2, 'noise': 1e-6}),
    'torque limit': ({'torque_limit': np.array([10.0, 4.0])}, {}),
    'torque rate limit': ({'rate_limit': np.array([500.0, 0.0])}, {}),
    'both limits': (
        {'torque_limit': np.array([10.5, 4.0]), 'rate_limit': np.array([500.0, 90.0])},
        {},
    ),
    'bound that narrows': (
        {'initial_bound': np.full(2, 0.01), 'funnel_rate': 3.0},
        {'start': (2.2975, 1.690)},
    ),
    'at the ball': ({'radius': 0.9, 'Gamma': np.array([0.2, 1.0, 3.0, 0.5, 0.5])}, {}),
    'window not full': ({'window': 2000, 'learning_start': 0.5}, {}),
    'half the rate': ({}, {'sample_time': 2e-3}),
    'past the bound': ({'slope_limit': np.full(2, 5e3)}, {'start': (2.297, 1.692)}),
}


@pytest.mark.parametrize(('gains', 'arm'), CASES.values(), ids=CASES)
def test_law_matches_the_plain_one_in_closed_loop(gains, arm):
    """Torque, estimate and d^3 agree with the oracle in every sample."""
    law, arm = controller(quick(**SHORT | gains)), plant(**arm)
    plain = PlainLaw(law.settings)
    for sample in closed_loop(law, arm, 1.5):
        reference = law.signals.qr, law.signals.dqr, law.signals.ddqr
        torque = plain.update(sample.t, arm.period_ns * 1e-9, *reference, sample.measurement)
        plain.tau = law.signals.torque.copy()
        for ours, theirs in (
            (law.signals.torque, torque),
            (law.state.estimate, plain.theta),
            (law.state.disturbance, plain.d3),
        ):
            np.testing.assert_allclose(ours, theirs, rtol=0.0, atol=ROUNDING)
    assert law.state.latched[0] == 1.0
    assert plain.latched is not None


DT = 2e-3  # s: with 500 N m/s, 1 N m from sample to sample


def cut(demand, last, *, level=10.0, rate=500.0, samples=7.0, added=0.0):
    case = arbitrary(0, n=1, torque_limit=np.array([level]), rate_limit=np.array([rate]))
    case.state.samples[0] = samples
    case.state.torque[0] = last
    case.state.level_cuts[0] = case.state.rate_cuts[0] = 0.0
    case.signals.demand[0] = demand
    case.signals.added[0] = added
    saturated = saturate(case.settings, case.state, case.signals, DT)
    return case.signals.torque[0], case.signals.cuts[0], saturated, case.state


@pytest.mark.parametrize(
    ('demand', 'last', 'torque', 'cuts'),
    [
        (3.5, 3.0, 3.5, 0.0),
        (4.0, 3.0, 4.0, 0.0),
        (5.0, 3.0, 4.0, RATE_CUT),
        (-5.0, 3.0, 2.0, RATE_CUT),
        (12.0, 9.5, 10.0, LEVEL_CUT),
        (12.0, 5.0, 6.0, LEVEL_CUT + RATE_CUT),
        (-12.0, -9.0, -10.0, LEVEL_CUT),
        (13.0, 14.0, 10.0, LEVEL_CUT + RATE_CUT),  # the level was lowered below the last torque
    ],
)
def test_torque_saturates_at_its_level_and_at_its_rate(demand, last, torque, cuts):
    applied, reported, saturated, state = cut(demand, last)
    assert (applied, reported) == (torque, cuts)
    assert bool(saturated) is (cuts > 0.0)
    assert state.level_cuts[0] == (cuts in {LEVEL_CUT, LEVEL_CUT + RATE_CUT})
    assert state.rate_cuts[0] == (cuts in {RATE_CUT, LEVEL_CUT + RATE_CUT})


@pytest.mark.parametrize(
    ('demand', 'command', 'cuts'),
    [
        (12.0, 6.0, LEVEL_CUT),  # the whole torque is at its limit
        (-7.0, -10.0, LEVEL_CUT),  # the command is: with the 4 N m of the drive, -6 N m
        (9.0, 5.0, 0.0),
        (7.5, 4.0, RATE_CUT),  # the rate is that of the command
    ],
)
def test_limits_hold_for_the_command_and_for_the_whole_torque(demand, command, cuts):
    last = {RATE_CUT: 5.0}.get(cuts, command)
    got = cut(demand, last, rate=1000.0 if cuts != RATE_CUT else 500.0, added=4.0)
    assert got[:2] == (command, cuts)
    mirrored = cut(-demand, -last, rate=1000.0 if cuts != RATE_CUT else 500.0, added=-4.0)
    assert mirrored[:2] == (-command, cuts)


@pytest.mark.parametrize('source', ['command', 'effort without the drive', 'whole effort'])
def test_applied_torque_has_the_mean_of_what_the_drive_adds_at_both_ends(source):
    changes = {'torque_source': EFFORT * (source != 'command'), 'drive': 0}
    case = arbitrary(3, effort_is_whole=int(source == 'whole effort'), **changes)
    settings, state, signals = case
    measurement = np.arange(9.0)
    base = state.torque.copy() if source == 'command' else measurement[6:]
    added = 0.0 if source == 'whole effort' else 0.5 * (state.added + signals.added)
    expected = base + added
    find_applied(settings, state, signals, measurement)
    np.testing.assert_array_equal(signals.applied, expected)
    np.testing.assert_array_equal(state.added, signals.added)


def test_rate_limit_is_off_at_zero_and_for_the_first_torque():
    assert cut(9.0, -9.0, rate=0.0)[:2] == (9.0, 0.0)
    assert cut(9.0, 0.0, samples=0.0)[:2] == (9.0, 0.0)
    for rate in (500.0, 0.0):  # NaN must not turn into a torque that looks valid
        assert np.isnan(cut(np.nan, 3.0, rate=rate)[0])


def test_loop_keeps_the_rate_limit_and_counts_every_cut_by_joint():
    rates = np.array([450.0, 80.0])
    law = controller(recommended(rate_limit=rates))  # which hardly disturbs the loop
    torques, cuts = [], []
    for _ in closed_loop(law, plant(), 2.0):
        torques.append(law.sample.torque.copy())
        cuts.append(law.sample.cuts.copy())
    steps = np.abs(np.diff(torques, axis=0))

    assert np.all(steps <= rates * 1e-3 * (1.0 + 1e-12))
    np.testing.assert_allclose(steps.max(axis=0), rates * 1e-3)
    np.testing.assert_array_equal(law.state.rate_cuts, np.sum(np.array(cuts) == RATE_CUT, axis=0))
    assert law.state.rate_cuts.min() > 0.0
    np.testing.assert_array_equal(law.state.level_cuts, 0.0)
