# SPDX-License-Identifier: Apache-2.0
"""Commands that have no effect are found on any bound.

A healthy arm is not taken for one.

Whatever stops an arm whose commands do not reach it, nothing that the law made of that
is commanded afterwards; one whose commands do is held with the load it carries.
"""

from __future__ import annotations

import re

import numpy as np
import pytest
from nights import at_night
from scenario import Scenario, carrying, changed, frozen

import blf_dsc_controller as blf

P = [1.0, 0.32, 0.4]
QUIET = {'disturbance.amplitude': [0.0, 0.0]}


def stopped_by(arm, *, at=2.0, after=3.0, spoil=None, reach=None):
    """Run an arm until `after` [s] from its stop; return it from `at` [s] on, and the stop.

    From then on its states are spoilt; commands reach the arm again 1 s after the stop.
    """
    if at > 0.0:
        arm.run(at)
        assert arm.is_running, arm.text
    before = arm.run(8.0, spoil=spoil, reach=reach, until=lambda: not arm.is_running)
    assert not arm.is_running, 'the arm was not stopped'
    lost = arm.run(min(after, 1.0), spoil=spoil, reach=reach)
    rest = [arm.run(after - 1.0, spoil=spoil)] if after > 1.0 else []
    whole = (np.concatenate(parts) for parts in zip(before, lost, *rest, strict=True))
    return type(before)(*whole), len(before.t) - 1


# Healthy arms.


@pytest.mark.parametrize('bound', [0.03, 0.5, 5.0])
def test_bound_does_not_decide_whether_an_arm_has_moved(bound):
    """With motion from 2 % of the bound on, nothing moved within the first 0.05 s."""
    given = {'barrier.bound': [bound] * 2, 'insist': ['barrier.bound']}
    arm = Scenario('recommended', given)
    arm.run(0.3)
    assert arm.is_running, arm.text


@pytest.mark.parametrize(
    ('effort', 'bound', 'begin', 'ramp', 'mass', 'resolution'),
    [
        # The Panda sags by 0.4 mrad, a hundred times the step of its sensors.
        ('whole', 0.005, 0.5, 0.5, 2.0, 0.0),
        ('unknown', 0.005, 0.5, 0.5, 2.0, 0.0),
        ('whole', 0.05, 0.5, 0.5, 2.0, 0.0),
        # With steps of 50 urad the loop holds the sag below a step on the average.
        ('unknown', None, 4.0, 0.3, 1.0, 5e-5),
        ('unknown', None, 4.0, 1.0, 2.0, 5e-5),
    ],
)
def test_arm_at_rest_that_gently_receives_a_load_is_not_stopped(
    effort, bound, begin, ramp, mass, resolution
):
    given = {'reference.type': 'hold', 'robot.effort': effort}
    if bound is not None:
        given['barrier.bound'] = [bound] * 7
    plant = carrying(mass, begin, ramp)
    if resolution:
        plant['sensor.resolution'] = resolution
    record = Scenario('panda_rigid', given, plant=plant).run(begin + 1.0)
    before = round(begin / 1e-3) - 100
    assert (record.phase == blf.Phase.TRACKING).all()
    assert np.abs(record.torque[-1] - record.torque[before]).max() > 3.0  # N m


@pytest.mark.parametrize('effort', ['whole', 'unknown'])
def test_commands_that_arrive_are_not_said_to_have_no_effect(effort):
    """A load far too heavy: the error passes the bound, and the arm accelerates with it."""
    arm = Scenario('panda_rigid', {'robot.effort': effort}, plant=carrying(12.0, 1.0))
    stopped_by(arm, at=0.0)
    assert arm.reason == 'error past the bound'
    assert 'effort controller' not in arm.text


@pytest.mark.parametrize(
    ('stiffness', 'reference'), [(4.0, 'sinusoids'), *at_night((3.0, 'hold'))]
)
def test_arm_that_oscillates_when_it_is_stopped_keeps_the_load_it_carries(
    stiffness, reference
):
    """2 kg that nobody declared, and gains beyond the stability limit of its gears.

    Without the load of before the oscillation, or if it is not observed on, the arm falls by
    up to 0.8 rad.
    """
    given = {'reference.type': reference, 'safety.torque': 'hold_gravity'}
    arm = Scenario('panda', given | {'safety.oscillation': 'stop'}, plant=carrying(2.0))
    arm.run(3.0)
    stiff = {'blf_dsc_controller': given | {'feedback.stiffness': stiffness}}
    arm.guard.retune(blf.load_loop('panda', stiff).controller)
    before = arm.run(1.0, until=lambda: not arm.is_running)
    assert arm.reason == 'oscillation'
    after = arm.run(2.0)
    far = 0.15 if reference == 'hold' else 0.3  # rad
    assert np.abs(after.q - before.q[-1]).max() < far
    assert after.speed[-1].max() < 0.02


# Brakes that close, and commands that do not arrive.


@pytest.mark.parametrize('bound', [0.002, 0.05])
def test_brakes_are_found_on_any_bound_and_through_the_noise_of_the_encoders(bound):
    arm = Scenario('recommended', {'barrier.bound': [bound] * 2})
    draw = np.random.default_rng(0)
    step = 2e-5  # rad, of an encoder of 18 bits
    noise = changed(
        q=lambda q: step * np.round((q + 1e-5 * draw.normal(size=2)) / step)
    )
    arm.run(0.04, spoil=noise)
    brakes = frozen('q', 'dq')
    arm.run(1.0, spoil=lambda state: noise(brakes(state)[0]))
    assert arm.reason == 'commands without effect' or (
        arm.reason == 'error past the bound' and bound < 0.01
    )


def test_commands_without_effect_stop_the_arm_with_the_model_from_before():
    """Brakes, or an inactive effort controller: the law would learn its own commands."""
    given = {'two_link.initial_estimate': P, 'safety.torque': 'hold_gravity'}
    arm = Scenario('recommended', given, plant=QUIET)
    arm.run(0.04)
    held = arm.plant.state.copy()

    def brakes(state):
        arm.plant.state[1:5] = [*held[1:3].tolist(), 0.0, 0.0]
        return changed(q=lambda _: held[1:3], dq=lambda dq: 0.0 * dq)(state)

    before = arm.run(0.5, spoil=brakes)
    assert arm.reason == 'commands without effect'
    remedy = 'release the brakes, and activate the effort controller'
    assert remedy in arm.text
    after = arm.run(1.0)  # the brakes open
    assert np.abs(after.q - before.q[-1]).max() < 0.025  # while the load is observed


@pytest.mark.parametrize(('effort', 'stops'), [('unknown', False), ('commanded', True)])
def test_constant_command_that_does_not_reach_the_arm_shows_only_in_its_effort(
    effort, stops
):
    """An inactive effort controller, on an arm that its drives hold."""
    hold = {'reference.type': 'hold', 'two_link.initial_estimate': P}
    arm = Scenario('recommended', hold | {'robot.effort': effort}, plant=QUIET)
    arm.run(0.1)
    brakes = frozen('q', 'dq')
    no_effort = changed(effort=lambda effort: 0.0 * effort)
    arm.run(0.3, spoil=lambda state: no_effort(brakes(state)[0]))
    assert arm.is_running != stops
    assert ('lacks' in arm.text) == stops


@pytest.mark.parametrize('preset', ['fr3', 'ur5e_driver'])
def test_commands_that_do_not_arrive_leave_nothing_in_the_safe_torque(preset):
    """An effort controller that becomes inactive in motion, and is activated 1 s after the stop.

    The drives hold the arm, so next to nothing is right; the law has wound up to -10.5
    N m (FR3) and -17.9 N m (UR5e) by then.
    """
    arm = Scenario(preset)
    record, stop = stopped_by(arm, reach=lambda torque: 0.0 * torque)
    is_lacking = arm.reason == 'commands without effect'  # by the effort of an FR3
    assert is_lacking or 'but the arm has not accelerated' in arm.text
    assert 'activate the effort controller' in arm.text
    assert np.abs(record.torque[-1]).max() < 3.0
    again = record.since(stop + round(1.0 / arm.T))
    assert np.abs(np.diff(again.torque, axis=0)).max() < 1.0
    assert again.speed[-1].max() < again.speed[0].max() + 0.05


@pytest.mark.parametrize('preset', ['panda_rigid', *at_night('ur5e_rigid')])
def test_brakes_in_motion_are_named_after_the_error_has_passed_the_bound(preset):
    """Within 6 to 64 ms: too soon for what tells them from an error at rest."""
    arm = Scenario(preset)
    record, stop = stopped_by(arm, spoil=frozen('q', 'dq'))
    assert arm.reason == 'error past the bound'
    assert arm.text.count('but the arm has not accelerated') == 1
    pattern = r"torque of joint '(\w+)' has changed by ([-+\d.]+) N m"
    joint, said = re.search(pattern, arm.text).groups()
    i = arm.config.joints.index(joint)
    later = stop + round(1.0 / arm.T)
    moved = record.torque[later, i] - record.torque[stop - 1, i]
    assert float(said) == pytest.approx(moved, rel=0.2)


@pytest.mark.parametrize('preset', ['fr3', 'panda_rigid'])
def test_measured_efforts_explain_an_error_past_the_bound(preset):
    """One joint whose commands are lost in motion."""
    lost = np.arange(7) == 1
    arm = Scenario(preset)
    stopped_by(arm, reach=lambda torque: np.where(lost, 0.0, torque), after=0.1)
    assert arm.reason == 'commands without effect'
    assert "_joint2' lacks " in arm.text


@pytest.mark.parametrize(
    ('preset', 'effort', 'factor', 'payload'),
    [('panda', 'unknown', 0.5, 0.0), ('ur5e_rigid', 'whole', 1.0, 20.0)],
)
def test_weak_drives_are_named_where_no_effort_shows_what_they_give(
    preset, effort, factor, payload
):
    """Without efforts a load and a weak drive look alike; with them only the load is named."""
    given = {
        'robot.effort': effort,
        'safety.first_torque': 'send',
        'disturbance.observer_bandwidth': 0.0,  # it needs efforts
    }
    arm = Scenario(preset, given, plant=carrying(payload, 0.5))
    stopped_by(arm, reach=lambda torque: factor * torque, at=0.0, after=0.1)
    assert arm.reason == 'error past the bound'
    pattern = (
        r'; it is sent (\S+) N m, where the model needs (\S+) N m at rest, and leaves'
    )
    sent, needed = map(float, re.search(pattern, arm.text).groups())
    assert abs(sent) > 2.0 * abs(needed)  # the torque of gravity, and what brakes
    assert 'it carries more than the model knows' in arm.text
    named = 'its drive gives less than it is sent (torque constant'
    assert (named in arm.text) == (effort == 'unknown')


def test_arm_that_sped_up_in_the_stop_comes_to_rest_once_its_drive_answers_again():
    """It kept the load of the stop, and drifted on at 0.12 rad/s."""
    arm = Scenario('ur5e', {'safety.torque': 'hold_gravity'})
    arm.run(0.3)
    arm.controller.fail('by hand')
    stuck = arm.run(0.01).torque[-1] + np.array([0.0, 0.0, 8.0, 0.0, 0.0, 0.0])
    arm.run(3.0, reach=lambda _: stuck, until=lambda: 'speeds' in arm.text)
    after = arm.run(2.0)
    assert after.speed[0].max() > 1.0
    assert after.speed[-1].max() < 0.02


def test_load_known_before_is_used_if_the_arm_speeds_up_in_the_stop():
    """A drive that is stuck: what is observed of its motion is no load."""
    given = {
        'two_link.initial_estimate': P,
        'two_link.learning_weight': 0.0,
        'safety.torque': 'hold_gravity',
        'safety.damping': [1e-3, 1e-3],
    }
    still = QUIET | {'disturbance.constant': [0.0, 0.0]}
    arm = Scenario('recommended', given, plant=still)
    arm.run(0.3)
    arm.controller.fail('by hand')
    stuck = arm.run(0.01).torque[-1] + np.array([0.0, 2.0])
    falling = arm.run(3.0, reach=lambda _: stuck, until=lambda: 'speeds' in arm.text)
    assert arm.text.endswith('rad/s: engage the brakes')
    after = arm.run(0.05, reach=lambda _: stuck)
    assert arm.text.count('speeds up') == 1
    # Without a load the torque is that of the model at rest, as at a stop there.
    there = {'initial.position': after.q[-1].tolist()}
    known = Scenario(
        'recommended', given | {'reference.type': 'hold'}, plant=still | there
    )
    known.run(0.01)
    known.controller.fail('by hand')
    held = known.run(0.1).torque[-1]
    assert np.abs(falling.torque[-2] - held).max() > 1.0
    np.testing.assert_allclose(after.torque[-1], held, atol=0.2)


# Drives that give another torque than they are sent.


def estimates_of(scale):
    """Return what is learned within 12 s from a driver that scales commands."""
    arm = Scenario('recommended', {'robot.effort': 'whole'})
    arm.run(12.0, reach=lambda torque: scale * torque)
    assert arm.is_running, arm.text
    return np.array([*arm.controller.estimates.values()][:3])


def test_driver_that_scales_commands_is_learned_as_such_an_arm():
    """As doc/arms.md says: it is what the next torque has to be computed with."""
    np.testing.assert_allclose(estimates_of(0.9), estimates_of(1.0) / 0.9, rtol=0.02)


def test_driver_that_clips_commands_is_named_by_its_effort():
    arm = Scenario('recommended', {'robot.effort': 'whole'})
    stopped_by(arm, reach=lambda torque: np.clip(torque, -4.0, 4.0), at=0.0)
    assert arm.reason == 'commands without effect'
    assert 'N m of what is commanded' in arm.text
    assert 'its drive gives less than it is sent: correct' in arm.text
