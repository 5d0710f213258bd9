# SPDX-License-Identifier: Apache-2.0
"""A load that somebody knows before the arm does, as when a gripper closes."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from nights import at_night
from scenario import Scenario

import blf_dsc_controller as blf

# s: at the same point of the motion, which has a period of 5 s
PICKED_UP, HELD, CYCLE = 6.0, 4.0, 10.0
AFTER = 2.0  # s, in which the error of a change shows
BOX = 2.0  # kg


def picking(preset, mass=BOX, cycles=1, **options):
    """Return an arm that picks up and puts down a box, at once."""
    begin = [PICKED_UP + k * CYCLE for k in range(cycles)]
    box = {
        'events.begin': begin,
        'events.duration': [HELD] * cycles,
        'events.payload': [mass] * cycles,
    }
    return Scenario(preset, plant=box, **options)


@cache
def unknown():
    """Return the record of an arm to which nobody says anything."""
    return picking('ur5e').run(PICKED_UP + AFTER)


def worst(record, time):
    """Return the largest error [mrad] after a time [s]."""
    shown = (record.t >= time) & (record.t < time + AFTER)
    return 1e3 * np.abs(record.error[shown]).max()


def test_the_box_of_before_costs_no_error():
    """It is remembered from the first cycle, which has to find it."""
    arm = picking('ur5e', cycles=2)
    say = arm.controller.expect_load
    again = PICKED_UP + CYCLE
    record = arm.run(
        again + HELD + AFTER,
        at={
            again: lambda: say(remember=True, interval=0.0),
            again + HELD: lambda: say(interval=0.0),
        },
    )
    usual = 1e3 * np.abs(record.error[record.t > 4.0][:1999]).max()
    assert worst(record, PICKED_UP) > 3.0 * usual
    assert worst(record, again) < 0.4 * worst(record, PICKED_UP)
    assert worst(record, again) < 2.0 * usual
    assert worst(record, again + HELD) < 2.7 * usual
    assert arm.is_running


@pytest.mark.parametrize('there', [0.0, *at_night(2.0 * BOX)])
def test_wrong_word_costs_no_more_than_none(there):
    """Of a gripper that has closed on nothing, or on two boxes."""
    arm = picking('ur5e', there)
    say = arm.controller.expect_load
    undone = PICKED_UP + HELD
    record = arm.run(
        undone + AFTER, at={PICKED_UP: lambda: say(BOX), undone: lambda: say(0.0)}
    )
    assert worst(record, PICKED_UP) < 1.3 * worst(unknown(), PICKED_UP)
    if there == 0.0:  # what was learned of the empty arm is there again
        assert worst(record, undone) < worst(record, 4.0)


def test_run_with_an_expected_load_replays(tmp_path):
    arm = picking('fr3', record=tmp_path / 'bag')
    arm.run(3.0, at={1.0: lambda: arm.controller.expect_load(BOX, (0.0, 0.02, 0.1))})
    arm.controller.close()
    assert blf.verify(tmp_path / 'bag').difference is None


def test_change_of_a_parameter_leaves_what_is_expected():
    records = []
    for changes in (False, True):
        arm = picking('panda')
        say = arm.controller.expect_load
        arm.run(PICKED_UP, at={PICKED_UP - 0.001: lambda say=say: say(BOX)})
        if changes:
            assert not arm.change({'safety.error_ratio': 1.5})
        records.append(arm.run(AFTER).torque)
    assert np.array_equal(*records)


def test_reset_carries_the_box_on():
    """What was expected is forgotten, and its weight goes on as that of an unknown load."""
    errors = []
    for said in (0.0, BOX):
        arm = picking('ur5e')
        say = arm.controller.expect_load
        arm.run(PICKED_UP + 3.0, at={PICKED_UP: lambda say=say, said=said: say(said)})
        arm.controller.reset()
        errors.append(np.nanmax(np.abs(arm.run(1.0).error)))
    assert errors[1] < 1.1 * errors[0]


@pytest.mark.parametrize(
    ('given', 'message'),
    [
        ((-1.0,), 'got -1.0 kg'),
        (('two',), "got 'two' kg"),
        ((1.0, (0.0, 0.1)), 'three coordinates'),
        ((20.0,), 'got 20 kg, but robot.payload'),
        ((1.0, (0.0, 0.0, 50.0)), 'would need .* at joint .*, whose limit is'),
        ((1.0, (0.0, 0.0, 0.0), -0.1), 'seconds between 0 and 10'),
        ((1.0, (0.0, 0.0, 0.0), 'soon'), "got an interval of 'soon'"),
    ],
)
def test_what_is_no_load_is_refused(given, message):
    arm = picking('fr3')
    arm.run(0.1)
    with pytest.raises(blf.BlfDscError, match=message):
        arm.controller.expect_load(*given)


def test_load_is_refused_where_it_means_nothing():
    arm = picking('fr3')
    with pytest.raises(blf.BlfDscError, match='not in command'):
        arm.controller.expect_load(1.0)
    arm.run(0.1)
    with pytest.raises(blf.BlfDscError, match='none has been weighed'):
        arm.controller.expect_load(remember=True)
    links = Scenario('recommended')
    links.run(0.1)
    with pytest.raises(blf.BlfDscError, match='no tip'):
        links.controller.expect_load(1.0)
