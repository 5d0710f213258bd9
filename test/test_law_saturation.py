# SPDX-License-Identifier: Apache-2.0
"""The limits on the torque and on its rate: cuts, their counts and their effect on learning."""

from __future__ import annotations

import numpy as np
import pytest
from arbitrary_case import arbitrary
from closed_loop_case import closed_loop, controller, plant, quick, recommended, record

from blf_dsc_controller.law.saturation import LEVEL_CUT, RATE_CUT, saturate

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


def test_any_change_is_allowed_without_a_rate_limit():
    assert cut(9.0, -9.0, rate=0.0)[:2] == (9.0, 0.0)


def test_rate_limit_does_not_apply_to_the_first_torque():
    assert cut(9.0, 0.0, samples=0.0)[:2] == (9.0, 0.0)


def test_nan_demand_stays_nan():
    """It must not turn into a torque that looks valid."""
    assert np.isnan(cut(np.nan, 3.0)[0])
    assert np.isnan(cut(np.nan, 3.0, rate=0.0)[0])


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


def test_tracking_error_does_not_adapt_while_one_joint_is_saturated():
    law = controller(quick(rate_limit=np.array([0.1, 0.0])))
    loop = closed_loop(law, plant(), 0.3)
    next(loop)
    estimate, disturbance = law.state.estimate.copy(), law.state.disturbance.copy()
    for _ in loop:
        assert law.sample.cuts[0] >= RATE_CUT
    np.testing.assert_array_equal(law.state.estimate, estimate)
    np.testing.assert_array_equal(law.state.disturbance, disturbance)


@pytest.mark.parametrize(
    'changes',
    [{'rate_limit': np.array([400.0, 150.0])}, {'torque_limit': np.array([10.5, 4.0])}],
    ids=['rate', 'level'],
)
def test_learning_uses_the_applied_torque(changes):
    """Many samples are cut; learning from their demanded torque would make P^ wrong."""
    law = controller(recommended(**changes))
    run = record(law, plant(), 12.0)
    assert np.maximum(law.state.level_cuts, law.state.rate_cuts).max() > 30.0
    assert run.parameter_error[-1] < 0.01
