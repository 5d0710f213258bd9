# SPDX-License-Identifier: Apache-2.0
"""Commands that have no effect are found on any bound.

A healthy arm is not taken for one.

Whatever stops an arm whose commands do not reach it, nothing that the law made of that
is commanded afterwards.
"""

from __future__ import annotations

import re

import numpy as np
import pytest
from fault_table import Rig
from plants import rigid_gears

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import load_loop
from blf_dsc_controller.configuration.schema import build, change
from blf_dsc_controller.run import FIRST_STAMP
from blf_dsc_controller.simulation.loop import simulate
from blf_dsc_controller.supervision.command_effect import CommandEffect
from blf_dsc_controller.supervision.guard import Guard
from blf_dsc_controller.supervision.last_state import LastState
from blf_dsc_controller.supervision.safe_torque import safe_torque
from blf_dsc_controller.supervision.supervisor import Reason
from sim_plant.plant import plant_of


@pytest.mark.parametrize('bound', [0.03, 0.5, 5.0])
def test_bound_does_not_decide_whether_an_arm_has_moved(bound):
    """With motion from 2 % of the bound on, nothing moved within the first 0.05 s."""
    loop = load_loop('recommended')
    given = {'barrier.bound': [bound] * 2, 'insist': ['barrier.bound']}
    config = change(loop.controller, given)
    record = simulate(config, change(loop.plant, {'duration': 0.3}))
    assert record.run().stops == ()


@pytest.mark.parametrize(
    ('effort', 'bound'), [('whole', 0.005), ('unknown', 0.005), ('whole', 0.05)]
)
def test_arm_at_rest_that_gently_receives_a_load_is_not_stopped(effort, bound):
    """2 kg within 0.5 s: the Panda sags by 0.4 mrad, a hundred times the step of its sensors."""
    arm = {'robot.urdf': 'panda.urdf', 'robot.tip': 'panda_hand_tcp'}
    law = {
        'reference.type': 'hold',
        'robot.effort': effort,
        'feedback.inertia': 'whole',
    }
    config = build(ControllerConfig, arm | law | {'barrier.bound': [bound] * 7})
    load = {
        'events.begin': [0.5],
        'events.duration': [0.0],
        'events.ramp': [0.5],
        'events.payload': [2.0],
        'duration': 1.5,
    }
    record = simulate(config, change(load_loop('panda_rigid').plant, load))
    assert record.run().stops == ()
    torque = record.run().torque
    assert np.abs(torque[-1] - torque[400]).max() > 10.0  # N m: the load is held


@pytest.mark.parametrize(('ramp', 'mass'), [(0.3, 1.0), (0.5, 3.0), (1.0, 2.0)])
def test_stiff_arm_may_take_up_a_load_without_a_motion_that_its_encoders_resolve(
    ramp, mass
):
    """Steps of 50 urad: the loop holds the sag below a step on the average."""
    loop = load_loop('panda_rigid')
    law = {'reference.type': 'hold', 'robot.effort': 'unknown'}
    load = {
        'sensor.resolution': 5e-5,
        'events.begin': [4.0],
        'events.duration': [0.0],
        'events.ramp': [ramp],
        'events.payload': [mass],
        'duration': 5.5,
    }
    record = simulate(change(loop.controller, law), change(loop.plant, load)).run()
    assert record.stops == ()
    assert np.abs(record.torque[-1] - record.torque[3900]).max() > 3.0  # N m


@pytest.mark.parametrize('bound', [0.002, 0.05])
def test_brakes_are_found_on_any_bound_and_through_the_noise_of_the_encoders(bound):
    given = {'barrier.bound': [bound] * 2, 'safety.torque': 'hold_gravity'}
    rig = Rig(given)
    rng = np.random.default_rng(0)
    step = 2e-5  # rad, of an encoder of 18 bits

    def read(q):
        return step * np.round((q + 1e-5 * rng.normal(size=2)) / step)

    rig.sense = lambda state: [state.raw(q=read(state.q))]
    rig.step(40)
    q = rig.state().q
    rig.sense = lambda state: [state.raw(q=read(q), dq=np.zeros(2))]
    rig.step(1000)
    assert rig.supervisor.reason in {Reason.NO_EFFECT, Reason.OUTSIDE_BOUND}
    assert rig.supervisor.reason is Reason.NO_EFFECT or bound < 0.01


def stopped_by(config, plant, spoil=None, reach=None, at=2.0, after=3.0):
    """Run an arm by hand until `after` [s] from its stop.

    Return guard, states, torques, the stop.

    From `at` [s] on `spoil(q, dq)` changes the readings, and the arm gets
    `reach(torque)` until 1 s after the stop.
    """
    arm = plant_of(plant)
    n = len(config.joints)
    guard = Guard(config, lambda: 0, lambda: 0)
    guard.starting.activate()
    torques = []
    positions = []
    speeds = []
    stop = None
    T = config.sample_time
    for k in range(round(10.0 / T)):
        measurement = arm.measure().copy()
        q, dq, _ = measurement.reshape(3, n)
        positions.append(q.copy())
        speeds.append(dq.copy())
        is_spoilt = k * T >= at
        if is_spoilt and spoil is not None:
            spoil(q, dq)
        torque = guard.update(FIRST_STAMP + round(k * T * 1e9), measurement)
        torques.append(np.zeros(n) if torque is None else torque.copy())
        if stop is None and not guard.supervisor.running:
            stop = k
        is_lost = stop is None or k < stop + 1.0 / T
        applied = torques[-1]
        if is_spoilt and is_lost and reach is not None:
            applied = reach(applied)
        arm.step(applied)
        if stop is not None and k * T > stop * T + after:
            break
    assert stop is not None, 'the arm was not stopped'
    return guard, np.array(positions), np.array(speeds), np.array(torques), stop


@pytest.mark.parametrize('preset', ['fr3', 'ur5e_driver'])
def test_commands_that_do_not_arrive_leave_nothing_in_the_safe_torque(preset):
    """An effort controller that becomes inactive in motion, and is activated 1 s after the stop.

    The drives hold the arm, so next to nothing is right; the law has wound up to -10.5
    N m (FR3) and -17.9 N m (UR5e) by then.
    """
    loop = load_loop(preset)
    plant = change(loop.plant, {'duration': 0.0})
    guard, q, _, torques, stop = stopped_by(
        loop.controller, plant, reach=lambda torque: 0.0 * torque
    )
    is_told = guard.supervisor.reason is Reason.NO_EFFECT  # by the effort of an FR3
    assert is_told or 'but the arm has not accelerated' in guard.supervisor.text
    assert 'activate the effort controller' in guard.supervisor.text
    assert np.abs(guard.estimates.disturbance).max() < 2.0
    assert np.abs(torques[-1]).max() < 3.0
    again = stop + round(1.0 / loop.controller.sample_time)
    assert np.abs(np.diff(torques[again:], axis=0)).max() < 1.0
    speeds = np.abs(np.diff(q[again:], axis=0)) / loop.controller.sample_time
    assert speeds[-1].max() < speeds[0].max() + 0.05


def test_effect_is_proven_by_a_lasting_acceleration_after_the_stop():
    """Not by the noise of differenced velocities, nor by what they show late.

    Each stop begins anew.
    """
    rng = np.random.default_rng(0)
    limit = np.full(2, 20.0)
    effect = CommandEffect(2)
    for _ in range(2):
        for _ in range(9):
            effect.update(np.full(2, 15.0), limit, 1e-3)
        for _ in range(500):
            effect.update(rng.normal(0.0, 1.0, 2), limit, 1e-3)
        assert not effect.is_proven
        for _ in range(100):
            effect.update(np.array([0.0, -3.0]), limit, 1e-3)
        assert effect.is_proven
        effect.restart()


def brakes():
    """Return what makes all readings stay at the first ones, at rest."""
    held = []

    def hold(q, dq):
        held.append(q.copy())
        q[:] = held[0]
        dq[:] = 0.0

    return hold


@pytest.mark.parametrize('preset', ['panda_rigid', 'ur5e_rigid'])
def test_brakes_in_motion_are_told_after_the_error_has_passed_the_bound(preset):
    """Within 6 to 64 ms: too soon for what tells them from an error at rest."""
    loop = load_loop(preset)
    plant = change(loop.plant, {'duration': 0.0})
    guard, _, _, torques, stop = stopped_by(loop.controller, plant, spoil=brakes())
    assert guard.supervisor.reason is Reason.OUTSIDE_BOUND
    assert guard.supervisor.text.count('but the arm has not accelerated') == 1
    joint, told = re.search(
        r"torque of joint '(\w+)' has changed by ([-+\d.]+) N m", guard.supervisor.text
    ).groups()
    i = loop.controller.joints.index(joint)
    later = stop + round(1.0 / loop.controller.sample_time)
    changed = torques[later, i] - torques[stop - 1, i]
    assert float(told) == pytest.approx(changed, rel=0.2)


@pytest.mark.parametrize('preset', ['fr3', 'panda_rigid'])
def test_measured_efforts_explain_an_error_past_the_bound(preset):
    """One joint whose commands are lost in motion; nothing is learned from it."""
    loop = load_loop(preset, rigid_gears(7, 0.01) if preset == 'fr3' else None)
    plant = change(loop.plant, {'duration': 0.0})

    def lose(torque):
        return np.where(np.arange(7) == 1, 0.0, torque)

    guard, *_ = stopped_by(loop.controller, plant, reach=lose)
    assert guard.supervisor.reason is Reason.NO_EFFECT
    assert "_joint2' lacks -" in guard.supervisor.text
    assert np.abs(guard.estimates.disturbance).max() < 2.0


@pytest.mark.parametrize('effort', ['whole', 'unknown'])
def test_commands_that_arrive_are_not_said_to_have_no_effect(effort):
    """A load far too heavy: the error passes the bound, and the arm accelerates with it."""
    loop = load_loop('panda_rigid')
    fall = {
        'duration': 0.0,
        'events.begin': [1.0],
        'events.duration': [0.0],
        'events.payload': [12.0],
    }
    config = change(loop.controller, {'robot.effort': effort})
    guard, *_ = stopped_by(config, change(loop.plant, fall))
    assert guard.supervisor.reason is Reason.OUTSIDE_BOUND
    assert 'effort controller' not in guard.supervisor.text


@pytest.mark.parametrize(
    ('preset', 'effort', 'factor', 'payload'),
    [('panda', 'unknown', 0.5, 0.0), ('ur5e_rigid', 'whole', 1.0, 20.0)],
)
def test_weak_drives_are_named_where_no_effort_shows_what_they_give(
    preset, effort, factor, payload
):
    """Without efforts a load and a weak drive look alike; with them only the load is named."""
    loop = load_loop(preset)
    given = {
        'robot.effort': effort,
        'safety.first_torque': 'send',
        'disturbance.observer_bandwidth': 0.0,  # it needs efforts
    }
    load = {'events.begin': [0.5], 'events.duration': [0.0]}
    arm = {'duration': 0.0, **load, 'events.payload': [payload]}
    guard, *_ = stopped_by(
        change(loop.controller, given),
        change(loop.plant, arm),
        reach=lambda torque: factor * torque,
        at=0.0,
        after=0.1,
    )
    assert guard.supervisor.reason is Reason.OUTSIDE_BOUND
    found = re.search(
        r'; it is sent (\S+) N m, where the model needs (\S+) N m at rest, and leaves',
        guard.supervisor.text,
    )
    sent, needed = map(float, found.groups())
    assert abs(sent) > 2.0 * abs(needed)  # the torque of gravity, and what brakes
    assert 'it carries more than the model knows' in guard.supervisor.text
    named = 'its drive gives less than it is sent (torque constant'
    assert (named in guard.supervisor.text) == (effort == 'unknown')


def test_load_known_before_is_used_if_the_arm_speeds_up_in_the_stop():
    """A drive of the wrong sign: damping drives the arm, and so does what is observed."""
    rig = Rig({'safety.torque': 'hold_gravity'})
    rig.step(300)
    rig.guard.fail('by the test')
    known = rig.guard.safe_torque.load.copy()
    rig.push[:] = [0.0, 2.0]
    rig.actuate = lambda _: []  # the last torque is held: nothing brakes
    seen = []
    rig.sense = lambda state: [state.raw()] if seen.append(state) is None else []
    for _ in range(3000):
        rig.step()
        if 'speeds up' in rig.supervisor.text:
            break
    assert rig.supervisor.text.endswith('rad/s: engage the brakes')
    guard = rig.guard
    safety = rig.config.safety
    settings = guard.controller.settings
    for _ in range(50):
        rig.step()
    last = LastState(2)
    slow = guard.safe_torque.last.slow
    last.take(0, np.concatenate(seen[-1][1:]), slow)
    goal = safe_torque(safety, settings, last, guard.estimates.estimate, known)
    np.testing.assert_allclose(rig.commands[-1], goal, rtol=0.0, atol=1e-9)
    assert rig.supervisor.text.count('speeds up') == 1


def estimates_of(scale):
    """Return what is learned within 12 s from a driver that scales commands."""
    loop = load_loop('recommended')
    config = change(loop.controller, {'robot.effort': 'whole'})
    arm = plant_of(change(loop.plant, {'duration': 0.0}))
    guard = Guard(config, lambda: 0, lambda: 0)
    guard.starting.activate()
    for k in range(12_000):
        torque = guard.update(FIRST_STAMP + k * 1_000_000, arm.measure().copy())
        arm.step(scale * torque)
    assert guard.supervisor.running, guard.supervisor.text
    return guard.controller.state.estimate[:3].copy()


def test_driver_that_scales_commands_is_learned_as_such_an_arm():
    """As doc/arms.md says: it is what the next torque has to be computed with."""
    np.testing.assert_allclose(estimates_of(0.9), estimates_of(1.0) / 0.9, rtol=0.02)


def test_driver_that_clips_commands_is_told_by_its_effort():
    loop = load_loop('recommended')
    config = change(loop.controller, {'robot.effort': 'whole'})
    guard, *_ = stopped_by(
        config,
        change(loop.plant, {'duration': 0.0}),
        reach=lambda torque: np.clip(torque, -4.0, 4.0),
        at=0.0,
    )
    assert guard.supervisor.reason is Reason.NO_EFFECT
    assert 'N m of what is commanded' in guard.supervisor.text
    assert 'its drive gives less than it is sent: correct' in guard.supervisor.text


def test_command_has_no_effect_if_it_changed_by_a_fifth_of_its_limit_for_a_while():
    """For 0.1 s, whichever joint it is; this is said once in each stop."""
    limit = np.array([20.0, 10.0])
    effect = CommandEffect(2)
    for changed, is_missing in (
        ([3.9, -1.9], False),
        ([0.0, -2.1], True),
        ([4.1, 0.0], True),
    ):
        effect.restart()
        answers = [
            effect.await_effect(np.array(changed), limit, 1e-3) for _ in range(300)
        ]
        assert answers == [is_missing and k == answers.index(True) for k in range(300)]
        if is_missing:
            assert 0.0999 <= 1e-3 * (answers.index(True) + 1) <= 0.1021
    effect = CommandEffect(2)
    assert not any(effect.await_effect(np.zeros(2), limit, 1e-3) for _ in range(300))
