# SPDX-License-Identifier: Apache-2.0
"""Efforts that are not the torques of joint sensors: the load observer is left out, and why."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from nights import at_night, one_by_day
from scenario import Scenario, changed, frozen

import blf_dsc_controller as blf
from blf_dsc_controller.warnings.table import config_warnings
from sim_plant.plant import plant_of

POLE = 'disturbance.observer_bandwidth'
HOLD = {'reference.type': 'hold'}
PICK_UP = {
    'events.begin': [2.0],
    'events.duration': [0.0],
    'events.payload': [2.0],
}


def said(arm):
    """Return what is said of the sensors, and the reasons of stops."""
    found = {'torque sensors': [], 'stop': []}
    for event in arm.events:
        if event.type in found:
            found[event.type.value].append(event.content)
    texts = [each['text'] for each in found['torque sensors']]
    return texts, [str(each['reason']) for each in found['stop']]


def assert_ends_well(arm, run):
    """It was warned of once, or the arm has stopped; none left its bound or was fast."""
    texts, stops = said(arm)
    assert len(texts) + len(stops) > 0
    assert len(texts) < 2
    assert run.ratio < 0.75
    assert run.speed.max() < np.abs(run.dqr).max() + 1.5
    for text in texts:
        assert 'the load observer is off, and the law goes on without it' in text
        assert 'set robot.effort to ' in text
    for reason in stops:
        assert reason in ('oscillation', 'commands without effect')
        if reason == 'oscillation' and not texts:
            assert 'efforts are not those of joint torque sensors' in arm.text


def test_panda_that_holds_then_jogs_one_joint_keeps_its_sensors_at_a_pick_up():
    """It took efforts for commands: 28 to 31 mrad without them."""
    arm = Scenario('panda', HOLD, plant=PICK_UP | {'events.begin': [5.0]})
    arm.run(3.0)
    there = np.array(arm.controller.reference.q)
    away = there + 0.3 * np.eye(7)[3]
    arm.controller.follow([(1.2, away), (2.4, there), (3.6, away)])
    run = arm.run(3.6)
    assert said(arm) == ([], [])
    assert 1e3 * np.abs(run.error).max() < 6.5


class Echo:
    """A Panda whose efforts are its commands, some samples late, behind a lag [s]."""

    def __init__(self, stiffness, late, lag):
        rigid = {'actuator.loop_gain': 0.0, 'actuator.loop_damping': 0.0}
        plant = PICK_UP | rigid | {'joint.stiffness': [stiffness] * 7}
        self._plant = plant_of(blf.load_loop('panda', {'sim_plant': plant}).plant)
        self._share = 1.0 - np.exp(-1e-3 / lag) if lag else 1.0
        self._given = [np.zeros(7)] * (late + 1)

    def __getattr__(self, name):
        return getattr(self._plant, name)

    def measure(self):
        measured = np.array(self._plant.measure())
        measured[14:] = self._given[0]
        return measured

    def step(self, torque):
        last = self._given[-1]
        self._given = [*self._given[1:], last + self._share * (torque - last)]
        self._plant.step(torque)


ECHOES = (0, 0.0), (2, 0.0), (1, 0.005)  # samples late, lag [s]


@pytest.mark.parametrize(
    ('stiffness', 'pole', 'echo'),
    one_by_day(4, product((1e4, 1.4e4, 5e4), (150.0, 300.0), ECHOES)),
)
def test_panda_whose_efforts_are_commands_goes_on_without_the_observer_or_stops(
    stiffness, pole, echo
):
    """Of currents of motors, efforts are commands behind a lag."""
    arm = Scenario('panda', {POLE: pole}, plant=Echo(stiffness, *echo))
    assert_ends_well(arm, arm.run(3.5))


@pytest.mark.parametrize('pole', [300.0, *at_night(150.0)])
@pytest.mark.parametrize('preset', ['panda', 'fr3', 'fr3_direct'])
def test_arm_with_encoders_at_the_motors_goes_on_without_the_observer_or_stops(
    preset, pole
):
    plant = PICK_UP | {'sensor.side': 'motor'}
    arm = Scenario(preset, {POLE: pole}, plant=plant)
    assert_ends_well(arm, arm.run(3.0))


FAILURES = {
    'dead': lambda effort: 0.0 * effort,
    'wrong sign': lambda effort: -effort,
    'N mm': lambda effort: 1e3 * effort,
    'a tenth': lambda effort: 0.1 * effort,
}


@pytest.mark.parametrize(
    ('preset', 'failure'),
    [
        *product(['panda'], FAILURES),
        ('fr3_direct', 'dead'),
        *at_night(*product(['fr3_direct'], ['wrong sign', 'N mm', 'a tenth'])),
    ],
)
def test_sensors_that_fail_in_motion_are_named_and_the_arm_goes_on(preset, failure):
    """It does not stop for commands without effect, which efforts would tell."""
    arm = Scenario(preset, {POLE: 300.0}, plant=PICK_UP)
    arm.run(1.0)
    run = arm.run(2.0, spoil=changed(effort=FAILURES[failure]))
    assert_ends_well(arm, run)
    (text,), stops = said(arm)
    assert not stops
    assert ' from what is commanded while the arm follows: a sensor is stuck' in text
    # drives of an FR3 add the weight of what Desk declares
    is_named = 'another load than robot.drive_payload, 0 kg' in text
    assert is_named == (preset == 'fr3_direct')


@pytest.mark.parametrize('failure', FAILURES)
def test_sensors_that_fail_while_a_panda_holds_stop_it_without_a_jump(failure):
    """They would tell of commands without effect; r of wrong efforts is no load to be held."""
    arm = Scenario('panda', HOLD | {POLE: 300.0})
    arm.run(1.0)
    run = arm.run(1.0, spoil=changed(effort=FAILURES[failure]))
    assert_ends_well(arm, run)
    assert said(arm)[1]


def test_sensors_of_one_joint_that_are_stuck_do_no_harm():
    arm = Scenario('fr3_direct', plant=PICK_UP)
    arm.run(1.0)
    first = []

    def stuck(state):
        first.append(state.effort[1])
        effort = state.effort.copy()
        effort[1] = first[0]
        return [replace(state, effort=effort)]

    assert_ends_well(arm, arm.run(2.5, spoil=stuck))


def test_brakes_that_close_still_stop_an_arm_whose_efforts_say_so():
    """The arm stands still: efforts of nothing are no reason to go on without them."""
    arm = Scenario('panda')
    arm.run(1.0)
    braked, dead = frozen(), changed(effort=lambda effort: 0.0 * effort)
    arm.run(
        1.0,
        spoil=lambda state: dead(braked(state)[0]),
        until=lambda: not arm.is_running,
    )
    assert said(arm)[0] == []
    assert arm.reason in ('commands without effect', 'error past the bound')


def warned(given):
    """Return what is warned of the use of torque sensors."""
    config = Scenario('panda', given).config
    return [text for text in config_warnings(config) if text.startswith(POLE)]


def torques(given):
    """Return the torques of a Panda that picks up a load."""
    plant = PICK_UP | {'events.begin': [0.2]}
    return Scenario('panda', given, plant=plant).run(0.5).torque


def test_sensors_are_used_only_if_they_are_declared_and_proven():
    """Of one without the other a line says what to do, and torques are those without."""
    without = torques({POLE: 0.0})
    assert not np.array_equal(torques({}), without)
    assert warned({}) == []
    (text,) = warned({POLE: 0.0})
    assert 'nothing has proven the joint torque sensors' in text
    assert '`blf_dsc commission`' in text
    assert warned({POLE: 0.0, 'commissioning.friction': [0.1] * 7}) == []
    (text,) = warned({'robot.effort': 'unknown'})
    assert '150 rad/s is not used' in text
    unread = torques({'robot.effort': 'unknown', 'safety.first_torque': 'send'})
    np.testing.assert_array_equal(
        unread,
        torques({POLE: 0.0, 'robot.effort': 'unknown', 'safety.first_torque': 'send'}),
    )
