# SPDX-License-Identifier: Apache-2.0
"""Checks of joint states, stamps and samples: each single fault is flagged."""

from __future__ import annotations

from math import inf, nan

import numpy as np
import pytest
from closed_loop_case import controller, plant, recommended
from hypothesis import given
from hypothesis import strategies as st

from blf_dsc_controller.configuration.controller import Safety
from blf_dsc_controller.supervision.checks import OUTSIDE, SUSPECT, check_sample, is_valid_state
from blf_dsc_controller.supervision.state_check import StateCheck
from blf_dsc_controller.supervision.supervisor import Reason

DT = 1e-3


@pytest.fixture
def law():
    """A controller that has processed one sample, inside its bound and below its limit."""
    law = controller(recommended())
    law.update(0.0, DT, plant().measure())
    return law


def verdict(law, ratio=None, kept=None, error_ratio=1.0):
    vectors = law.settings_vector, law.state_vector, law.signals_vector, law.sample_vector
    ratio = np.zeros(2) if ratio is None else ratio
    return check_sample(*vectors, error_ratio, ratio, np.zeros(7) if kept is None else kept)


def test_estimates_of_a_valid_sample_are_kept(law):
    ratio, kept = np.array([0.9, 0.0]), np.zeros(7)
    assert verdict(law, ratio, kept) == 0
    np.testing.assert_array_equal(kept, [*law.state.estimate, *law.state.disturbance])
    # The largest ratio so far stays; a smaller one is overtaken.
    assert ratio[0] == 0.9
    assert ratio[1] == abs(law.sample.xi1[1]) / law.sample.bound[1]


@pytest.mark.parametrize('bad', [nan, inf, -inf])
@pytest.mark.parametrize(
    ('part', 'name', 'i'),
    [('state', 'estimate', 4), ('state', 'disturbance', 1), ('signals', 'demand', 0)],
)
def test_values_that_are_not_finite_are_suspect_and_not_kept(law, part, name, i, bad):
    getattr(getattr(law, part), name)[i] = bad
    kept = np.full(7, 3.0)
    assert verdict(law, kept=kept) & SUSPECT
    assert (kept == 3.0).all()


def test_a_demand_past_the_limit_is_suspect(law):
    law.signals.demand[1] = -np.nextafter(20.0, 21.0)
    assert verdict(law) == SUSPECT


@pytest.mark.parametrize('error', [0.002, -0.0021, nan])
def test_an_error_past_the_bound_is_outside_and_suspect_if_it_is_to_stop(law, error):
    law.sample.xi1[0] = error
    assert verdict(law) == OUTSIDE | SUSPECT
    assert verdict(law, error_ratio=2.0) & SUSPECT == (SUSPECT if np.isnan(error) else 0)
    assert verdict(law, error_ratio=0.0) == OUTSIDE


def test_the_nan_of_a_rejected_column_is_no_fault(law):
    law.sample.estimate[4] = nan
    assert verdict(law) == 0


@pytest.mark.parametrize('value', [nan, inf, 50.1])
def test_a_state_is_valid_if_finite_and_slow(value):
    still = np.zeros(2)
    assert is_valid_state(still, still, 50.0)
    assert not is_valid_state(still, np.array([0.0, -value]), 50.0)
    assert is_valid_state(still, np.array([50.0, 0.0]), 50.0)
    if value != 50.1:
        assert not is_valid_state(np.array([value, 0.0]), still, 50.0)


STILL = np.zeros(2)
SAFETY = Safety()
# Repeated, early, usual, jittering, missed and much too late; now and then backwards.
STEPS = st.sampled_from([0, 1, 499_999, 500_001, 1_000_000, 1_000_001, 1_499_999, 1_500_001])
RARE_STEPS = st.sampled_from([2_000_000, 3_000_000, 41_000_000, 50_000_000, -1_000_000])


class FullCheck(StateCheck):
    """Checks each stamp in full."""

    def _is_next(self, _stamp):
        return False


@given(steps=st.lists(STEPS | RARE_STEPS | st.just(1_000_000), max_size=60))
def test_the_short_check_of_a_stamp_is_the_full_one(steps):
    short, full = StateCheck(['joint1', 'joint2'], DT), FullCheck(['joint1', 'joint2'], DT)
    stamp = 1_000_000_000
    for step in steps:
        stamp += step
        faults = [one.check(SAFETY, stamp, STILL, STILL) for one in (short, full)]
        assert faults[0] == faults[1]
        assert vars(short) == vars(full)


def test_velocities_are_checked_after_the_short_check_too():
    states = StateCheck(['joint1', 'joint2'], DT)
    assert states.check(SAFETY, 1_000_000_000, STILL, STILL) is None
    too_fast = np.array([0.0, 2.0 * SAFETY.velocity_limit])
    fault = states.check(SAFETY, 1_001_000_000, STILL, too_fast)
    assert fault is not None
    assert fault.reason is Reason.VELOCITY
