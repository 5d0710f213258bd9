# SPDX-License-Identifier: Apache-2.0
"""Efforts that are not the torques of joint sensors: the load observer is left out, and why."""

from __future__ import annotations

from functools import lru_cache
from types import SimpleNamespace

import numpy as np
import pytest
from law_part import part

from blf_dsc_controller.configuration.nodes import PLANT, load_loop
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.factory.controller import controller_of
from blf_dsc_controller.law import (
    joint_sensors,
    load_observer,
    motor_friction,
    oscillation,
    torque_sensors,
)
from blf_dsc_controller.law.load_observer import SLOWER
from blf_dsc_controller.law.torque_sensors import (
    COMMANDS,
    MAY_SHAKE,
    NONE,
    OFF,
    SHAKES,
    STILL_SHAKES,
)
from blf_dsc_controller.messages.journal import EventType
from blf_dsc_controller.replay.verify import verify
from blf_dsc_controller.run import FIRST_STAMP
from blf_dsc_controller.simulation.loop import simulate, write_bag
from blf_dsc_controller.supervision.guard import Guard
from blf_dsc_controller.supervision.not_sensors import joint_of, text_of
from blf_dsc_controller.supervision.supervisor import Phase, Reason
from sim_plant.plant import plant_of

DT = 1e-3  # s
LIMIT = np.array([80.0, 10.0])  # N m
MOVES = np.array([0.5, -0.2])  # rad/s
ECHO = {'actuator.loop_gain': 0.0, 'actuator.loop_damping': 0.0}
MOTORS = {'sensor.side': 'motor'}


class Observer:
    """An observer with a bandwidth, by which parts of a state have a size."""

    enabled = 1


def new():
    """An empty state, and scratch, of two joints."""
    sizes = {'n': 2, 'observer': Observer}
    state, work = (
        part(each, **sizes) for each in (torque_sensors.State, torque_sensors.Work)
    )
    torque_sensors.begin(state, np.zeros(2))
    return state, work


def compared(of_command, of_links, seconds=0.5, speed=MOVES):
    """Return what is found of efforts that are away from commands and from the links' torque."""
    state, work = new()
    found = 0
    for k in range(round(seconds / DT)):
        wave = np.sin(2.0 * np.pi * 5.0 * k * DT)
        work.differences[0] = (
            of_command * wave + 1.0
        )  # N m, an offset counts for nothing
        work.differences[1] = of_links * wave - 2.0
        found += torque_sensors.compare_with_commands(state, work, speed, k == 0, DT)
    assert found == (state.fault[0] == NONE) * state.is_distinct[0]  # said once
    return state


def test_efforts_that_are_nearer_to_commands_than_to_the_links_torque_are_commands():
    state = compared(np.array([0.02, 0.1]), np.array([1.0, 2.0]))
    assert (state.fault[0], state.joint[0]) == (COMMANDS, 0)


def test_efforts_that_motors_and_friction_separate_from_commands_are_sensors():
    state = compared(np.array([0.2, 0.4]), np.array([1.0, 0.4]))
    assert (state.fault[0], state.is_distinct[0]) == (NONE, 1.0)


def test_what_lies_between_is_not_judged_yet():
    state = compared(np.array([0.2, 0.4]), np.array([1.0, 2.0]))
    assert (state.fault[0], state.is_distinct[0]) == (NONE, 0.0)


def test_an_arm_at_rest_and_a_load_that_comes_later_say_nothing():
    still = compared(np.array([0.02, 0.1]), np.array([1.0, 2.0]), speed=0.05 * MOVES)
    assert (still.fault[0], still.is_distinct[0]) == (NONE, 0.0)
    state = compared(np.array([0.2, 0.4]), np.array([0.2, 0.4]))
    work = new()[1]
    for k in range(2000):  # s, a load, in which efforts are as commanded
        work.differences[1] = 20.0 * np.sin(0.02 * k)
        torque_sensors.compare_with_commands(state, work, MOVES, begins=False, dt=DT)
    assert state.fault[0] == NONE


def watched(torque, seconds=0.3, distinct=1.0):
    """Return what is found of r, a function of the time [s], and how often each joint shakes."""
    state, work = new()
    state.is_distinct[0] = distinct
    shaken = np.zeros(2)
    for k in range(round(seconds / DT)):
        torque_sensors.watch_shaking(state, work, LIMIT, torque(k * DT), shaken, DT)
    return state, shaken.tolist()


@pytest.mark.parametrize('joint', [0, 1])
def test_r_that_shakes_is_found_and_one_that_takes_a_load_or_is_small_is_not(joint):
    share = np.eye(2)[joint] * LIMIT / 80.0
    shakes, _ = watched(lambda t: 3.0 * np.sin(2.0 * np.pi * 30.0 * t) * share, 0.15)
    assert (shakes.fault[0], shakes.joint[0]) == (SHAKES, joint)
    small, _ = watched(lambda t: 0.5 * np.sin(2.0 * np.pi * 30.0 * t) * share)
    load, _ = watched(
        lambda t: 20.0 * (1.0 - np.exp(-150.0 * t)) * np.array([1.0, 0.1])
    )
    assert (small.fault[0], load.fault[0]) == (NONE, NONE)


def test_ripple_of_r_does_not_hide_that_it_shakes():
    """0.8 N m at 200 Hz: a half wave of less than a fortieth of the limit, 2 N m, is none."""

    def r(t):
        wave = 3.0 * np.sin(2.0 * np.pi * 20.0 * t)
        return np.array([wave + 0.8 * np.sin(2.0 * np.pi * 200.0 * t), 0.0])

    state, _ = watched(r, 0.25)
    assert (state.fault[0], state.joint[0]) == (SHAKES, 0)


@pytest.mark.parametrize(
    ('ratio', 'fault', 'expected'),
    [
        (0.01, NONE, (COMMANDS, 1.0)),
        (0.05, NONE, (NONE, 0.0)),  # between 0.02 and 0.1
        (0.2, NONE, (NONE, 1.0)),
        (0.05, OFF, (OFF, 1.0)),  # it is known what they are not
    ],
)
def test_efforts_are_judged_once(ratio, fault, expected):
    state, _ = new()
    state.fault[0] = fault
    state.square[:] = [[4.0 * ratio, ratio / 4.0], [1.0, 1.0]]
    assert torque_sensors.decide(state) == (ratio > 0.1)
    assert (state.fault[0], state.is_distinct[0]) == expected
    assert state.joint[0] == float(expected[0] == COMMANDS)  # the nearest


def shaking(seconds, *joints, **known):
    """Return what is found where r of some joints shakes at 30 Hz."""
    share = np.isin(np.arange(2), joints) * LIMIT / 80.0
    return watched(
        lambda t: 3.0 * np.sin(2.0 * np.pi * 30.0 * t) * share, seconds, **known
    )


@pytest.mark.parametrize(
    ('seconds', 'fault', 'times'),
    [(0.15, SHAKES, 1.0), (0.25, SHAKES, 2.0), (0.5, STILL_SHAKES, 3.0)],
)
def test_r_is_slower_where_it_shakes_and_left_out_if_that_does_not_help(
    seconds, fault, times
):
    """Six half waves take 0.1 s at 30 Hz."""
    state, shaken = shaking(seconds, 1)
    assert (state.fault[0], shaken) == (fault, [0.0, times])
    assert shaking(seconds, 0, 1)[1] == [times, times]
    faded, calmed = np.zeros(1), np.zeros(2)
    for _ in range(500):
        torque_sensors.fade(state, faded, is_off=False, dt=DT)
        torque_sensors.calm(np.array(shaken), calmed, DT)
    assert faded[0] == (fault == STILL_SHAKES)
    np.testing.assert_allclose(calmed, [0.0, 1.0 - SLOWER**times], atol=1e-6)


def test_joint_that_begins_to_shake_later_is_slower_as_well():
    def first_one_then_the_other(t):
        wave = 3.0 * np.sin(2.0 * np.pi * 30.0 * t)
        return wave * np.eye(2)[int(t / 0.15)] * LIMIT / 80.0

    state, shaken = watched(first_one_then_the_other, 0.3 - DT)
    assert (state.fault[0], shaken) == (SHAKES, [1.0, 1.0])


def arm_that_oscillates(share, joint=0, growth=0.0, seconds=0.15):
    """What `oscillation` finds of an arm with torques of a `share` of their limit at 30 Hz."""
    found = part(oscillation.State, n=2)
    oscillation.begin(found, np.zeros(2), np.zeros(2))
    for k in range(round(seconds / DT)):
        wave = np.sin(2.0 * np.pi * 30.0 * k * DT) * np.eye(2)[joint]
        wave *= np.exp(growth * k * DT)
        none = np.zeros(2)
        oscillation.watch(
            found, LIMIT, 0.01 * wave, share * LIMIT * wave, none, none, DT
        )
    assert oscillation.oscillates(found, joint)
    return found


def test_r_takes_the_blame_of_an_arm_that_oscillates_as_often_as_it_becomes_slower():
    state, _ = new()
    state.is_distinct[0] = 1.0
    shaken = np.zeros(2)
    for times in (1.0, 2.0, 3.0):
        arm = arm_that_oscillates(0.1)
        assert torque_sensors.take_blame(state, arm, LIMIT, LIMIT, shaken)
        assert not oscillation.oscillates(arm, 0)
        assert (state.fault[0], state.joint[0]) == (MAY_SHAKE, 0)
        assert (state.noted[0], shaken.tolist()) == (times, [times, 0.0])
    arm = arm_that_oscillates(0.1)
    assert not torque_sensors.take_blame(state, arm, LIMIT, LIMIT, shaken)
    assert oscillation.oscillates(arm, 0)


@pytest.mark.parametrize(
    ('share', 'growth', 'most', 'fault'),
    [
        (0.6, 0.0, LIMIT, NONE),
        (0.06, 15.0, LIMIT, NONE),
        (0.1, 0.0, 0.0 * LIMIT, NONE),
        (0.1, 0.0, LIMIT, OFF),
    ],
    ids=['violent', 'grows', 'r is zero', 'r is left out'],
)
def test_nothing_waits_for_r_where_it_is_late_or_cannot_be_the_cause(
    share, growth, most, fault
):
    state, _ = new()
    state.fault[0] = fault
    shaken = np.zeros(2)
    arm = arm_that_oscillates(share, growth=growth, seconds=0.12)
    assert (oscillation.grows(arm, 0)) == (growth > 0.0)
    assert not torque_sensors.take_blame(state, arm, LIMIT, most, shaken)
    assert (state.noted[0], shaken.tolist()) == (0.0, [0.0, 0.0])


@pytest.mark.parametrize(
    ('of_command', 'fault', 'waits'),
    [(2.0, SHAKES, 0.0), (0.3, SHAKES, 1.0), (0.01, STILL_SHAKES, 1.0)],
    ids=['sensors', 'undecided', 'commands'],
)
def test_r_that_shakes_before_efforts_are_known_waits_for_that(
    of_command, fault, waits
):
    state, _ = shaking(0.15, 1, distinct=0.0)
    assert (state.fault[0], state.waits[0]) == (SHAKES, 1.0)
    faded, (_, work) = np.zeros(1), new()
    for k in range(500):
        wave = np.sin(2.0 * np.pi * 5.0 * k * DT)
        work.differences[0], work.differences[1] = of_command * wave, wave
        torque_sensors.compare_with_commands(state, work, MOVES, k == 0, DT)
        torque_sensors.fade(state, faded, is_off=False, dt=DT)
    assert (state.fault[0], state.waits[0]) == (fault, waits)
    assert faded[0] == pytest.approx(waits, abs=1e-3)


def test_efforts_that_are_off_are_found_after_r_has_shaken():
    state, _ = shaking(0.15, 1)
    torque_sensors.note_fault(state, OFF, 0)
    assert (state.fault[0], state.joint[0]) == (OFF, 0)
    torque_sensors.note_fault(state, STILL_SHAKES, 1)
    assert (state.fault[0], state.joint[0]) == (OFF, 0)


def off(difference, speed, seconds):
    """Return what is found of efforts that are off by some N m, at a speed (n,) [rad/s]."""
    state, work = new()
    for _ in range(round(seconds / DT)):
        work.differences[0] = difference
        now = torque_sensors.watch_following(state, work, LIMIT, speed, MOVES, DT)
    return state.fault[0], now


def test_efforts_that_are_off_while_the_arm_follows_are_of_no_sensor():
    """For good after 0.05 s; a tenth of the limit may be friction."""
    assert off(np.array([9.0, 0.0]), MOVES, 0.04) == (NONE, True)
    assert off(np.array([9.0, 0.0]), MOVES, 0.06) == (OFF, True)
    assert off(np.array([7.0, 0.9]), MOVES, 1.0) == (NONE, False)


def test_efforts_of_an_arm_that_does_not_follow_are_doubted_while_that_lasts():
    """Brakes may hold it: `effect` stops it."""
    assert off(np.array([9.0, 0.0]), 0.0 * MOVES, 1.0) == (NONE, True)


def test_joint_follows_within_a_quarter_of_the_speed_of_the_arm():
    for share, fault in ((-0.26, NONE), (-0.24, OFF), (0.24, OFF), (0.26, NONE)):
        speed = MOVES + np.array([share * np.hypot(*MOVES), 0.0])
        assert off(np.array([9.0, 0.0]), speed, 0.1) == (fault, True)


def test_efforts_are_off_for_good_only_if_that_lasts_without_a_break():
    state, work = new()
    for k in range(1000):
        work.differences[0] = [9.0 * (k % 50 > 0), 0.0]  # 0.049 s
        torque_sensors.watch_following(state, work, LIMIT, MOVES, MOVES, DT)
    assert state.fault[0] == NONE


def test_commands_are_compared_behind_the_filter_of_the_efforts():
    """The torque is the last of a row; 1 - 1 / e after 1 / L."""
    state, _ = new()
    row = np.array([[7.0, 8.0, 3.0], [5.0, 6.0, -2.0]])
    for _ in range(20):
        torque_sensors.follow_applied(state, row, 2, 50.0, DT)
    np.testing.assert_allclose(state.command, (1.0 - np.exp(-1.0)) * row[:, 2])


def observed(most, disturbance):
    """Return states of an arm in which efforts are 4 and 2 N m away from commands, for 0.33 s.

    That is 4 / L = 0.08 s until the filters have settled, and 0.25 s of motion.
    """
    of = load_observer.Settings(1, 50.0, 0.0, most, np.ones(2), np.zeros(1))
    motors = SimpleNamespace(size=1, filter_pole=30.0)
    sizes = {'n': 2, 'p': 1, 'm': 1, 'observer': of, 'motors': motors}
    settings = SimpleNamespace(
        **sizes, information=np.eye(1), torque=SimpleNamespace(limit=LIMIT)
    )
    observer, sensors, now = (
        part(each.State, **sizes)
        for each in (load_observer, torque_sensors, motor_friction)
    )
    state = SimpleNamespace(
        samples=np.ones(1),
        estimate=np.zeros(1),
        disturbance=disturbance,
        observer=observer,
        sensors=sensors,
        motors=now,
    )
    signals = SimpleNamespace(
        row=SimpleNamespace(Xu=np.array([[0.0, 9.0], [0.0, 1.0]])),
        effort=np.array([5.0, -1.0]),
        dq=MOVES,
        dqr=MOVES,
        sensors=part(torque_sensors.Work, **sizes),
        scratch=SimpleNamespace(observer=part(load_observer.Work, **sizes)),
    )
    for _ in range(330):
        joint_sensors.observe_load(settings, state, signals, DT)
        state.samples[0] += 1.0
    return state


def test_offset_of_efforts_from_commands_says_nothing_about_them():
    sensors = observed(LIMIT, np.zeros(2)).sensors
    np.testing.assert_allclose(sensors.slow, [[-4.0, -2.0], [5.0, -1.0]], atol=0.1)
    assert sensors.moved[0] == pytest.approx(0.25, abs=2.0 * DT)
    left = 5.0 * np.exp(-4.0)  # N m, that comes through the filters later
    assert (sensors.square < 0.25 * left**2).all()
    # an observer that is off has no load in P^ that it could take from the efforts
    assert observed(0.0 * LIMIT, np.zeros(2)).sensors.moved[0] == 0.0


def test_sensors_are_passed_on_to_the_friction_of_motors_and_d3_to_the_bias():
    """e^-10 of the efforts is left by the poles of a row, eleven times that by two of them."""
    state = observed(LIMIT, np.array([0.0, 2.0]))
    assert state.observer.keeps_bias.tolist() == [1.0, 1.0]
    np.testing.assert_allclose(state.motors.sensed2, [5.0, -1.0], rtol=6e-4)


def test_r_fades_out_and_comes_back_smoothly_and_stays_whole_without_doubt():
    state, _ = new()
    faded = np.zeros(1)
    torque_sensors.fade(state, faded, is_off=False, dt=DT)
    assert faded[0] == 0.0
    torque_sensors.fade(state, faded, is_off=True, dt=0.02)
    assert faded[0] == pytest.approx(1.0 - np.exp(-1.0))
    still, once = np.zeros(2), np.array([0.0, 1.0])
    assert torque_sensors.is_fading(faded, still, still)
    assert not torque_sensors.is_fading(np.ones(1), still, still)
    assert torque_sensors.is_fading(np.ones(1), once, 0.5 * once)
    assert not torque_sensors.is_fading(np.ones(1), once, (1.0 - SLOWER) * once)
    for _ in range(500):
        torque_sensors.fade(state, faded, is_off=False, dt=DT)
    assert faded[0] == 0.0
    state.fault[0] = STILL_SHAKES
    torque_sensors.fade(state, faded, is_off=False, dt=0.005)
    assert faded[0] == pytest.approx(1.0 - np.exp(-1.0))


def test_joint_that_shows_it_is_named_with_its_own_difference():
    config = load_loop('fr3_direct').controller
    law = controller_of(config)
    law.state.sensors.fault[0] = OFF
    law.state.sensors.joint[0] = 2
    law.signals.sensors.differences[0, :3] = [1.0, 2.0, -3.5]
    joint = config.joints[2]
    assert f'the effort of joint {joint!r} is off -3.5 N m' in text_of(law, config)
    assert joint_of(law, config.joints) == joint


def test_efforts_may_be_off_by_the_weight_that_drives_add():
    """fr3_direct reads whole torques, with the weight of what Desk declares; a panda adds none."""
    text = 'or the drives compensate another load than robot.drive_payload, 0 kg'
    for preset, is_named in (('fr3_direct', True), ('panda', False)):
        config = load_loop(preset).controller
        law = controller_of(config)
        law.state.sensors.fault[0] = OFF
        assert (text in text_of(law, config)) == is_named


def loop_of(preset, seconds, **plant):
    """Return the loop of a preset whose arm may be another."""
    return load_loop(preset, {PLANT: {'duration': seconds, **plant}})


def said(record):
    """Return what is said of the sensors, with its time [s], and the reasons of stops."""
    events = [e for e in record.journal.pending if e.type is EventType.TORQUE_SENSORS]
    found = [
        (1e-9 * (each.stamp - FIRST_STAMP), each.content['text']) for each in events
    ]
    return found, [each.reason for each in record.run().stops]


@lru_cache
def without_sensors(stiffness, pole=150.0):
    """Return the record of a Panda that is said to have sensors, and echoes its commands."""
    loop = loop_of('panda', 1.5, **ECHO, **{'joint.stiffness': [stiffness] * 7})
    law = change(loop.controller, {'disturbance.observer_bandwidth': pole})
    return simulate(law, loop.plant)


@pytest.mark.parametrize(
    ('stiffness', 'pole', 'what'),
    [
        (1e4, 150.0, 'has shaken by the load observer'),
        (1e4, 300.0, 'has shaken by the load observer'),
        (5e4, 150.0, 'the efforts are what is commanded'),
        (5e4, 300.0, 'the efforts are what is commanded'),
    ],
)
def test_panda_without_sensors_goes_on_without_the_observer(stiffness, pole, what):
    """With it, gears of 1e4 N m/rad resonate at 30 Hz at once."""
    record = without_sensors(stiffness, pole)
    (*_, (time, text)), stops = said(record)
    assert not stops
    assert not record.run().oscillations
    assert time < 0.5
    assert what in text
    assert 'robot.torque_loop to false' in text
    assert np.abs(record.run().error[-500:]).max() < 0.01


@pytest.mark.parametrize('pole', [150.0, 300.0])
def test_arm_with_sensors_gets_all_of_its_pole_once_they_are_known(pole):
    loop = loop_of('panda', 1.0)
    law = change(loop.controller, {'disturbance.observer_bandwidth': pole})
    record = simulate(law, loop.plant)
    state = record.controller.state
    assert state.sensors.is_distinct[0] == 1.0
    assert not state.observer.slowed.any()
    assert not state.observer.calmed.any()


@pytest.mark.parametrize('stiffness', [1e4, 5e4])
def test_bag_of_an_arm_without_sensors_replays(tmp_path, stiffness):
    write_bag(tmp_path / 'bag', without_sensors(stiffness))
    result = verify(tmp_path / 'bag')
    assert (result.difference, result.remarks) == (None, ())


@pytest.mark.parametrize('preset', ['panda', 'fr3_direct'])
def test_arm_with_encoders_at_the_motors_goes_on_with_a_slow_observer_or_none(preset):
    loop = loop_of(preset, 1.5, **MOTORS)
    record = simulate(loop.controller, loop.plant)
    found, stops = said(record)
    assert not stops
    assert not record.run().oscillations
    assert found[0][0] < 0.2
    for _, text in found:
        assert 'by the load observer' in text
        assert 'positions are those of the motors' in text


PUSHED = {
    'events.begin': [0.0, 2.0, 3.0],  # s
    'events.duration': [1.5, 0.2, 0.0],
    'events.force': [0.0, 0.0, 0.0, 30.0, 15.0, -20.0, 0.0, 0.0, 0.0],  # N
}


ERRONEOUS = {  # but sensors, which the loop of the drives sees as well
    'sensor.torque_offset': [0.8, -0.8, 0.6, -0.8, 0.15, -0.15, 0.15],  # N m
    'sensor.torque_factor': [1.03, 0.97, 1.02, 0.98, 0.97, 1.03, 0.98],
    'sensor.torque_noise': [0.1, 0.1, 0.1, 0.1, 0.03, 0.03, 0.03],  # N m
}


@pytest.mark.parametrize('errors', [{}, ERRONEOUS], ids=['exact', 'erroneous'])
@pytest.mark.parametrize('preset', ['panda', 'fr3', 'fr3_direct'])
def test_sensors_of_an_arm_that_starts_with_a_load_and_is_pushed_are_left_alone(
    preset, errors
):
    """It holds 2 kg that nobody declared, puts them down, is pushed, and picks up its payload."""
    payload = load_loop(preset).controller.robot.payload
    loads = {'events.payload': [2.0, 0.0, payload]}
    loop = loop_of(preset, 4.0, **PUSHED, **loads, **errors)
    record = simulate(loop.controller, loop.plant)
    assert said(record) == ([], [])
    state = record.controller.state
    assert (state.observer.faded[0], state.sensors.is_distinct[0]) == (0.0, 1.0)


class Failing:
    """A Panda whose efforts fail after a while, in the guarded loop."""

    def __init__(self, fails, after=1.0, seconds=1.6):
        loop = loop_of('panda', seconds)
        plant, n = plant_of(loop.plant), len(loop.controller.joints)
        self.guard = Guard(loop.controller, lambda: 0, lambda: 0)
        self.guard.starting.activate()
        self.error = self.step = 0.0
        before, held = None, None
        for k in range(round(seconds / DT)):
            measurement = np.array(plant.measure())
            if k * DT >= after:
                held = measurement[2 * n :].copy() if held is None else held
                measurement[2 * n :] = fails(measurement[2 * n :], held)
            torque = self.guard.update(FIRST_STAMP + k * 1_000_000, measurement).copy()
            if before is not None and k * DT >= after:
                self.step = max(self.step, np.abs(torque - before).max())
            before = torque
            self.error = max(self.error, np.abs(self.guard.controller.sample.xi1).max())
            plant.step(torque)


@pytest.mark.parametrize(
    'fails',
    [
        lambda effort, _: 0.0 * effort,
        lambda effort, _: -effort,
        lambda effort, _: 1e3 * effort,
    ],
    ids=['dead', 'wrong sign', 'N mm'],
)
def test_panda_whose_sensors_fail_in_motion_goes_on_without_them(fails):
    """It does not stop for commands without effect, which efforts would tell."""
    run = Failing(fails)
    assert run.guard.supervisor.phase is Phase.TRACKING
    assert 'what is commanded while the arm follows' in run.guard.findings.untrusted
    assert run.guard.controller.state.observer.faded[0] == 1.0
    assert run.error < 0.03


def test_brakes_that_close_still_stop_an_arm_whose_efforts_say_so():
    """The arm stands still: efforts of nothing are no reason to go on without them."""
    loop = loop_of('panda', 2.0)
    plant, n = plant_of(loop.plant), len(loop.controller.joints)
    guard = Guard(loop.controller, lambda: 0, lambda: 0)
    guard.starting.activate()
    rest = None
    for k in range(2000):
        measurement = np.array(plant.measure())
        if k >= 1000:
            rest = measurement[:n].copy() if rest is None else rest
            measurement = np.concatenate((rest, np.zeros(2 * n)))
        torque = guard.update(FIRST_STAMP + k * 1_000_000, measurement).copy()
        if guard.supervisor.phase is Phase.SAFE_STOP:
            break
        plant.step(torque)
    assert not guard.findings.untrusted
    assert guard.supervisor.reason in (Reason.NO_EFFECT, Reason.OUTSIDE_BOUND)
