# SPDX-License-Identifier: Apache-2.0
"""Checks of joint states, stamps and samples: each single fault is flagged."""

from __future__ import annotations

from math import inf, nan
from pathlib import Path

import numpy as np
import pytest
from closed_loop_case import controller, plant, recommended
from fault_table import FAULTS, page, run

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.law.checks import INVALID, OUTSIDE, SUSPECT, check_sample
from blf_dsc_controller.supervision.checks import Reason, SampleCheck, Velocity

DT = 1e-3
LIMIT = 20.0  # N m, the default torque limit


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


BAD = [
    (part, name, i, bad, 1.0, SUSPECT)
    for part, name, i in (
        ('state', 'estimate', 4),
        ('state', 'disturbance', 1),
        ('signals', 'demand', 0),
    )
    for bad in (nan, inf, -inf)
]


@pytest.mark.parametrize(
    ('part', 'name', 'i', 'value', 'error_ratio', 'flags'),
    [
        *BAD,
        ('signals', 'demand', 1, -np.nextafter(LIMIT, 21.0), 1.0, SUSPECT),
        ('sample', 'xi1', 0, 0.002, 1.0, OUTSIDE | SUSPECT),
        ('sample', 'xi1', 0, -0.0021, 1.0, OUTSIDE | SUSPECT),
        ('sample', 'xi1', 0, 0.0021, 2.0, OUTSIDE),
        ('sample', 'xi1', 0, 0.0021, 0.0, OUTSIDE),
        ('sample', 'xi1', 0, nan, 2.0, OUTSIDE | SUSPECT),
        ('sample', 'estimate', 4, nan, 1.0, 0),  # of a rejected column
    ],
)
def test_suspect_samples_are_flagged_and_not_kept(law, part, name, i, value, error_ratio, flags):
    getattr(getattr(law, part), name)[i] = value
    law.checks.kept[:] = 3.0
    assert verdict(law, error_ratio) == flags
    assert (law.checks.kept == 3.0).all() == bool(flags & SUSPECT)


@pytest.mark.parametrize(('every', 'stops'), [(4, True), (6, False)])
def test_cuts_add_up_if_they_take_more_than_a_fifth_of_the_time(law, every, stops):
    check = SampleCheck(build(ControllerConfig, {'safety.saturation_time': 0.05}), law)
    faults = []
    for k in range(2000):
        law.signals.demand[1] = 21.0 * (k % every == 0)
        law.flags = verdict(law)
        faults.append(check.check(DT))
    assert any(fault and fault.reason is Reason.SATURATED for fault in faults) == stops
    assert check.saturated == -(-2000 // every)


@pytest.mark.parametrize(
    ('index', 'value', 'is_valid'),
    [(0, nan, False), (1, -inf, False), (3, nan, False), (2, 50.0, True), (3, -50.1, False)],
)
def test_invalid_state_leaves_the_law_as_it_was(law, index, value, is_valid):
    measurement, before = plant().measure(), law.save()
    measurement[index] = value
    law.update(DT, DT, measurement)
    assert (law.flags == INVALID) == (not is_valid)
    assert (law.save() == before).all() == (not is_valid)


MILLISECOND = 1_000_000  # ns


def estimated(*states):
    """Estimated velocity (rad/s) of joint 1 at each (stamp in ms, position in rad)."""
    velocity, found = Velocity(2), []
    for stamp, position in states:
        measurement = np.array([position, 0.0, 7.0, 7.0, 8.0, 8.0])
        velocity.replace(stamp * MILLISECOND, measurement)
        found.append(measurement[2])
        assert (measurement[4:] == 8.0).all()
    return found


def test_velocity_is_the_difference_quotient_of_two_states():
    np.testing.assert_allclose(estimated((1, 0.5), (2, 0.502), (4, 0.501)), [0.0, 2.0, -0.5])


def test_repeated_stamp_keeps_the_velocity_and_the_next_one_counts_from_it():
    found = estimated((1, 0.5), (2, 0.502), (2, 0.502), (2, 0.502), (3, 0.503))
    np.testing.assert_allclose(found, [0.0, 2.0, 2.0, 2.0, 1.0])


def test_velocity_is_zero_where_the_stamps_restart():
    np.testing.assert_allclose(estimated((5, 0.5), (6, 0.502), (1, 0.1), (2, 0.1)), [0, 2, 0, 0])


def test_repeated_reading_with_a_new_stamp_is_continued_at_its_velocity():
    """Once; an arm that really stands still is at rest in the sample after."""
    moving = (1, 0.5), (2, 0.502)
    found = estimated(*moving, (3, 0.502), (3, 0.504), (4, 0.506), (5, 0.508))
    np.testing.assert_allclose(found, [0.0, 2.0, 2.0, 2.0, 2.0, 2.0])
    np.testing.assert_allclose(estimated(*moving, (3, 0.502), (4, 0.502)), [0.0, 2.0, 2.0, 0.0])
    coarse = (1, 0.5), (2, 0.5002), (3, 0.5002)  # less than three counts of 16 bits
    np.testing.assert_allclose(estimated(*coarse), [0.0, 0.2, 0.0])


@pytest.mark.parametrize('fault', FAULTS, ids=lambda fault: fault.name)
def test_fault_is_detected_and_named_and_the_loop_recovers(fault):
    outcome = run(fault)

    assert outcome.reason is fault.reason, outcome.text
    for commands in (outcome.before, outcome.after):
        assert np.isfinite(commands).all()
        assert (np.abs(commands) <= LIMIT).all()
    # A controller that never started stays silent.
    assert bool(len(outcome.after)) == (fault.reason is not Reason.START_REJECTED)
    if fault.reason is Reason.NONE:
        assert outcome.noticed == -1
        assert outcome.error < 1.0
    else:
        assert 1 <= outcome.noticed <= fault.within
        assert outcome.text
        # The default safe torque is zero; above all, the last torque is not repeated.
        assert not outcome.after.any()
        assert outcome.last.all()
    assert outcome.recovered


def test_faults_cover_all_reasons_and_their_page_is_up_to_date():
    assert {fault.reason for fault in FAULTS} == set(Reason) - {Reason.FAILED}
    text = (Path(__file__).parents[1] / 'doc/faults.md').read_text()
    assert text == page(text), 'run: python test/fault_table.py doc/faults.md'
