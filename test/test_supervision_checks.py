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
from blf_dsc_controller.law.checks import INVALID, OUTSIDE, SUSPECT, check_sample
from blf_dsc_controller.law.settings import EFFORT
from blf_dsc_controller.supervision.checks import SampleCheck, StateCheck
from blf_dsc_controller.supervision.supervisor import Reason

DT = 1e-3


@pytest.fixture
def law():
    """A controller that has processed one sample, inside its bound and below its limit."""
    law = controller(recommended())
    law.checks.velocity_limit[0] = 50.0
    law.update(0.0, DT, plant().measure())
    assert law.flags == 0
    return law


def verdict(law, error_ratio=1.0):
    law.checks.error_ratio[0] = error_ratio
    return check_sample(law.settings, law.checks, law.state, law.signals, law.sample)


def test_estimates_of_a_valid_sample_are_kept(law):
    law.checks.ratio[:], law.checks.kept[:] = (0.9, 0.0), 0.0
    assert verdict(law) == 0
    np.testing.assert_array_equal(law.checks.kept, [*law.state.estimate, *law.state.disturbance])
    # The largest ratio so far is kept; a smaller one is replaced.
    assert law.checks.ratio[0] == 0.9
    assert law.checks.ratio[1] == abs(law.sample.xi1[1]) / law.sample.bound[1]


@pytest.mark.parametrize('bad', [nan, inf, -inf])
@pytest.mark.parametrize(
    ('part', 'name', 'i'),
    [('state', 'estimate', 4), ('state', 'disturbance', 1), ('signals', 'demand', 0)],
)
def test_non_finite_values_are_suspect_and_not_kept(law, part, name, i, bad):
    getattr(getattr(law, part), name)[i] = bad
    law.checks.kept[:] = 3.0
    assert verdict(law) & SUSPECT
    assert (law.checks.kept == 3.0).all()


@pytest.mark.parametrize(('every', 'stops'), [(4, True), (6, False)])
def test_cuts_add_up_if_they_take_more_than_a_fifth_of_the_time(law, every, stops):
    check = SampleCheck(Safety(saturation_time=0.05), ('joint1', 'joint2'), law, DT)
    faults = []
    for k in range(2000):
        law.signals.demand[1] = 21.0 * (k % every == 0)
        law.flags = verdict(law)
        faults.append(check.check(DT))
    assert any(fault and fault.reason is Reason.SATURATED for fault in faults) == stops


def test_demand_past_the_limit_is_suspect(law):
    law.signals.demand[1] = -np.nextafter(20.0, 21.0)
    assert verdict(law) == SUSPECT


@pytest.mark.parametrize('error', [0.002, -0.0021, nan])
def test_error_past_the_bound_is_outside_and_suspect_if_it_must_stop(law, error):
    law.sample.xi1[0] = error
    assert verdict(law) == OUTSIDE | SUSPECT
    assert verdict(law, error_ratio=2.0) & SUSPECT == (SUSPECT if np.isnan(error) else 0)
    assert verdict(law, error_ratio=0.0) == OUTSIDE


def test_nan_of_a_rejected_column_is_not_a_fault(law):
    law.sample.estimate[4] = nan
    assert verdict(law) == 0


STATES = [
    (0, nan, Reason.NOT_FINITE),
    (1, -inf, Reason.NOT_FINITE),
    (3, nan, Reason.NOT_FINITE),
    (2, 50.0, None),
    (3, -50.1, Reason.VELOCITY),
    (5, nan, None),
]


@pytest.mark.parametrize(('index', 'value', 'reason'), STATES)
@pytest.mark.parametrize('learns_from', [0, EFFORT])
def test_only_finite_and_plausible_states_are_used_and_the_reasons_agree(
    index, value, reason, learns_from
):
    """The efforts must be finite if learning uses them."""
    law = controller(recommended()._replace(torque_source=learns_from))
    law.checks.velocity_limit[0] = 50.0
    measurement = plant().measure()
    measurement[index] = value
    before = law.save()
    law.update(0.0, DT, measurement)
    if index == 5 and learns_from == EFFORT:
        reason = Reason.NOT_FINITE
    assert (law.flags == INVALID) == bool(reason)
    assert (law.save() == before).all() == bool(reason)
    if reason:
        states = StateCheck(['joint1', 'joint2'], DT)
        assert states.invalid(Safety(velocity_limit=50.0), measurement).reason is reason


SAFETY = Safety()
# Repeated, early, regular, jittering, missed and far too late; occasionally backwards.
STEPS = st.sampled_from([0, 1, 499_999, 500_001, 1_000_000, 1_000_001, 1_499_999, 1_500_001])
RARE_STEPS = st.sampled_from([2_000_000, 3_000_000, 41_000_000, 50_000_000, -1_000_000])


class FullCheck(StateCheck):
    """Checks each stamp in full."""

    def _is_next(self, _stamp):
        return False


@given(steps=st.lists(STEPS | RARE_STEPS | st.just(1_000_000), max_size=60))
def test_short_stamp_check_agrees_with_the_full_one(steps):
    short, full = (cls(['joint1', 'joint2'], DT) for cls in (StateCheck, FullCheck))
    stamp = 1_000_000_000
    for step in steps:
        stamp += step
        faults = [states.check(SAFETY, stamp) for states in (short, full)]
        assert faults[0] == faults[1]
        assert vars(short) == vars(full)
