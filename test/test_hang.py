# SPDX-License-Identifier: Apache-2.0
"""A controller that hangs in motion and goes on: no joint gets faster by that than it was.

Beside it, a drive holds the last torque, or the watchdog brings the arm to rest.
"""

from __future__ import annotations

import numpy as np
import pytest
from nights import at_night
from scenario import carrying
from watched_arm import PERIOD, TIMEOUT, WatchedArm

import blf_dsc_controller as blf

PATIENT = {'safety.state_timeout': 10.0}
SLACK = 0.2
"""rad/s: what a load of 2 kg that nobody knows adds while it is observed.

At most 0.15 was seen, of a UR5e that goes on; before, 1.2 of it and 0.95 of an FR3.
"""


def loaded(preset, given=None, **options):
    """Return an arm with a load that nobody knows."""
    return WatchedArm(preset, given, plant=carrying(2.0), **options)


def excess(least, record):
    """Return by how much [rad/s] a joint is faster than `least` (n,) and than it was asked."""
    asked = np.maximum(least, np.abs(record.dqr).max(axis=0))
    return (record.speed.max(axis=0) - asked).max()


CASES = [
    (preset, watched, given)
    for preset in ('fr3', 'ur5e_driver', 'ur5e', 'panda')
    for watched in (True, False)
    for given in (({}, PATIENT) if preset in ('fr3', 'ur5e_driver') else ({},))
]


@pytest.mark.parametrize(
    ('preset', 'watched', 'given'),
    [*CASES[1::3], *at_night(*CASES[::3], *CASES[2::3])],
)
def test_controller_that_goes_on_after_a_hang_makes_no_joint_faster(
    preset, watched, given
):
    """At random moments, for random times, with and without a load that nobody knows.

    Without a watchdog the torque that is held drives the arm on, an FR3 with 2 kg to 7 rad/s
    in a second: where one joint is braked from 2 rad/s, another may be dragged along, but
    none gets faster than the fastest.
    """
    draw = np.random.default_rng(CASES.index((preset, watched, given)))
    longest = 2.0 if watched else 0.4
    for queued, made in ((False, loaded), (True, WatchedArm)):
        arm = made(preset, given, watched=watched)
        before = arm.run(draw.uniform(1.0, 2.5))
        assert arm.is_running, arm.text
        arm.hang(np.exp(draw.uniform(np.log(0.05), np.log(longest))), queued=queued)
        least = np.maximum(before.since(-200).speed.max(axis=0), arm.speed)
        if not watched:
            least[:] = least.max()
        assert excess(least, arm.run(0.6)) < SLACK, queued


@pytest.mark.parametrize('preset', ['ur5e_driver', *at_night('fr3')])
def test_arm_that_nobody_commands_goes_on_as_its_reference_until_the_watchdog_brakes_it(
    preset,
):
    """The torque that is held keeps its acceleration a: |v + a s| after a silence of s.

    By up to 0.12 rad/s faster than before in the 52 ms of the watchdog, at the 2.3 rad/s^2 of
    these references.  Damping then sees the velocity behind a low pass of 0.03 s, and friction
    that was overcome passes for a load at first: by up to 0.17 rad/s beyond that.
    """
    draw = np.random.default_rng(3)
    for _ in range(4):
        arm = loaded(preset, PATIENT)
        before = arm.run(draw.uniform(1.5, 4.0))
        _, v, a = arm.controller.reference
        silence = 0.0
        while not arm.line.active:
            arm.run(arm.T, hangs=True)
            silence += arm.T
        assert silence <= TIMEOUT + PERIOD + 2.5 * arm.T
        most = np.maximum(before.since(-200).speed.max(axis=0), np.abs(v + a * silence))
        after = arm.run(0.3, hangs=True)
        assert (after.speed.max(axis=0) - most).max() < SLACK


@pytest.mark.parametrize(
    ('preset', 'moment', 'seconds', 'queued'),
    [('fr3', 1.3, 0.12, False), ('ur5e_driver', 5.3, 0.09, True)],
)
def test_law_that_goes_on_does_not_pull_a_braked_arm_to_its_reference(
    preset, moment, seconds, queued
):
    """Within its bound, but at another velocity: by 0.95 and 1.2 rad/s before."""
    arm = loaded(preset, PATIENT)
    before = arm.run(moment)
    arm.hang(seconds, queued=queued)
    least = np.maximum(before.since(-200).speed.max(axis=0), arm.speed)
    assert excess(least, arm.run(0.6)) < SLACK


@pytest.mark.parametrize('preset', ['fr3', *at_night('ur5e_driver')])
def test_controller_that_hung_takes_the_resting_arm_over_as_the_watchdog_holds_it(
    preset,
):
    """The load of 2 kg is known by then, whatever was learned of it in motion.

    What it had learned moved a wrist of the FR3 at 0.3 rad/s.
    """
    arm = loaded(preset)
    arm.run(5.3)
    arm.hang(1.0)
    assert arm.speed.max() < 0.03
    after = arm.run(0.6)
    assert arm.reason == 'stamp jump'
    assert after.speed.max() < 0.08


def test_controller_that_hangs_as_soon_as_it_is_started_again_makes_no_joint_faster():
    """While the watchdog brakes, before anything is known of the load that it observed."""
    arm = loaded('fr3', PATIENT)
    before = arm.run(2.0).since(-200).speed.max(axis=0)
    arm.run(0.15, hangs=True)
    assert arm.speed.max() > 0.3
    arm.restart(acting=arm.taken[-1])
    arm.run(2.0 * arm.T)
    assert arm.is_running, arm.text
    for record in (arm.run(0.3, hangs=True), arm.run(0.6)):
        assert excess(before, record) < SLACK


def test_arm_near_its_reference_returns_to_it_after_a_gap_at_the_torque_that_acts():
    """The reference begins where the arm is, and the command at what its effort shows."""
    arm = loaded('fr3', PATIENT)
    arm.run(1.3)
    arm.hang(0.12)
    held, state = arm.taken[-1], arm.state()
    arm.answer(state)
    assert arm.controller.phase is blf.Phase.APPROACHING
    start = arm.events[-1]
    assert start.type == 'start'
    assert start.content['resumed']
    assert np.abs(arm.controller.error).max() < 1e-9
    commanded = state.effort - arm.guard.controller.signals.saturation.added
    # as measured and delayed, within what an arm that brakes changes in some samples
    np.testing.assert_allclose(commanded, held, atol=0.5)
    step = np.array(arm.config.torque.rate_limit) * arm.T
    assert np.all(np.abs(arm._applied - commanded) <= step * (1.0 + 1e-9))
    arm.plant.step(arm._applied)
    arm.run(2.0)
    assert arm.controller.phase is blf.Phase.TRACKING


def test_arm_far_from_its_reference_stops_after_a_gap_that_may_last():
    arm = loaded('fr3', PATIENT)
    arm.run(1.3)
    arm.hang(0.5)
    arm.run(arm.T)
    assert arm.reason == 'stamp jump'
    assert 'too far from its reference now' in arm.text


def test_arm_that_no_error_stops_goes_on_after_a_gap_outside_its_bound():
    """As a busy computer leaves it: with `safety.error_ratio` 0 no bound is enforced."""
    law = {
        'reference.type': 'hold',
        'safety.error_ratio': 0.0,
        'safety.state_timeout': 10.0,
    }
    config = blf.load_loop('recommended', {'blf_dsc_controller': law}).controller
    rest, still = np.array([2.293, 1.696]), np.zeros(2)  # rad
    controller = blf.ArmController(config)
    for k in range(100):
        controller.update(1.0 + 1e-3 * k, rest, still, still)
    # slower than `safety.velocity_limit`, so it is believed
    far = rest + 3.0 * np.array(config.barrier.bound)
    controller.update(1.162, far, still, still)
    assert controller.phase is blf.Phase.TRACKING, controller.reason
