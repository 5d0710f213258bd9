# SPDX-License-Identifier: Apache-2.0
"""The quick look: yes where all is well, no for each single thing that is not."""

from __future__ import annotations

from math import inf, nan

import numpy as np
import pytest
from closed_loop_case import controller, plant, recommended

from blf_dsc_controller.supervision.checks import OUTSIDE, SUSPECT, check_sample, is_valid_state

DT = 1e-3


@pytest.fixture
def law():
    """A controller that has answered one sample, inside its bound and below its limit."""
    answering = controller(recommended())
    answering.update(0.0, DT, plant().measure())
    return answering


def verdict(law, ratio=None, kept=None, error_ratio=1.0):
    vectors = law.settings_vector, law.state_vector, law.signals_vector, law.sample_vector
    ratio = np.zeros(2) if ratio is None else ratio
    return check_sample(*vectors, error_ratio, ratio, np.zeros(7) if kept is None else kept)


def test_a_sound_answer_is_kept(law):
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
def test_whatever_is_not_finite_is_suspect_and_not_kept(law, part, name, i, bad):
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


def test_a_refused_column_is_told_as_unknown_and_is_no_fault(law):
    law.sample.estimate[4] = nan
    assert verdict(law) == 0


@pytest.mark.parametrize('value', [nan, inf, 50.1])
def test_a_state_is_sound_if_finite_and_slow(value):
    still = np.zeros(2)
    assert is_valid_state(still, still, 50.0)
    assert not is_valid_state(still, np.array([0.0, -value]), 50.0)
    assert is_valid_state(still, np.array([50.0, 0.0]), 50.0)
    if value != 50.1:
        assert not is_valid_state(np.array([value, 0.0]), still, 50.0)
