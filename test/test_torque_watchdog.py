# SPDX-License-Identifier: Apache-2.0
"""A dead or stopped controller and a drive that holds the last torque: the watchdog takes over."""

from __future__ import annotations

import numpy as np
import pytest
from watched_arm import TIMEOUT, WatchedArm

import blf_dsc_controller as blf
from benchmark import random_arms
from blf_dsc_controller.supervision.torque_watchdog import TorqueWatchdog

AT_REST = {'reference.type': 'hold'}
# Of arms that nobody foresaw: s after the death of the controller, from which on one rests;
# its last torque, which the drives hold for 52 ms, makes a wrist of an FR3 as fast as 60 rad/s
HELD = 1.2
SLOW = 0.15  # rad/s, as after a stop
# with all of the damping each shook on by 7 to 19 rad/s
ARMS = {
    'UR5e, encoders at the motors, torque loop': ('ur5e', 0, 0.0),
    'the same, while its stop takes the damping down': ('ur5e', 0, 0.1),
    'UR5e, encoders at the links, torque loop': ('ur5e', 9, 0.0),
    'FR3': ('fr3', 6, 0.0),
}


def two_link(given=None):
    return WatchedArm('recommended', given, plant={'disturbance.amplitude': [0.0, 0.0]})


@pytest.mark.parametrize(('preset', 'angle'), [('fr3', 0.2), ('ur5e_driver', 0.15)])
@pytest.mark.parametrize(
    'armed', [False, True], ids=['watching', 'restarted afterwards']
)
def test_named_arm_of_a_dead_controller_comes_to_rest(preset, angle, armed):
    """In motion.

    An FR3 brakes at jumps of 1 N m in a cycle, if its driver lets them pass.

    Which torque its drives hold, a restarted one cannot know: that is left to the
    driver.
    """
    unlimited = {} if armed else {'actuator.rate_limit': 0.0}
    arm = WatchedArm(preset, plant=unlimited, watched=not armed)
    assert arm.run(1.1).speed[-1].max() > 0.3
    if armed:
        arm.line = TorqueWatchdog(arm.config, TIMEOUT, armed=True)
    after = arm.run(3.0, hangs=True)
    assert arm.line.takeovers == 1
    assert not arm.plant.is_stopped
    # a count of 17 bits shows as 0.013 rad/s
    assert after.speed[-1].max() < 0.01
    assert np.abs(after.q - after.q[0]).max() < angle


@pytest.mark.parametrize('arm', ARMS)
def test_arm_that_nobody_foresaw_comes_to_rest_when_its_controller_dies(arm):
    """By a hold that does not shake what a stop does not shake."""
    name, number, late = ARMS[arm]
    study = random_arms.study_of(name, 'wide')
    loop = blf.load_loop(name)._replace(
        controller=study.controller, plant=random_arms.arm_of(study, number)
    )
    with np.errstate(all='ignore'):
        arm = WatchedArm(loop)
        while arm.is_running or arm.controller.phase is blf.Phase.STARTING:
            arm.run(arm.T)
        if late:
            arm.run(late)
        after = arm.run(1.5, hangs=True)
    assert arm.line.takeovers == 1
    assert after.since(round(HELD / arm.T)).speed.max() < SLOW


def swinging(sigma, frequency=0.0, amplitude=0.0):
    """Return what is said of an arm that was held for 0.6 s.

    `sigma` [rad] is the noise of its positions, which swing by `amplitude` [rad].
    """
    config = blf.load_loop('fr3').controller
    n = len(config.joints)
    line = TorqueWatchdog(config, TIMEOUT)
    random = np.random.default_rng(0)
    T = config.sample_time
    for k in range(round(1.0 / T)):
        q = random.normal(0.0, sigma, n)
        q += amplitude * np.sin(2.0 * np.pi * frequency * k * T)
        measurement = np.concatenate((q, np.full(2 * n, np.nan)))
        line.take_state(round(1e9 * (1.0 + k * T)), measurement, k * T)
        if k * T < 0.4:
            line.take_torque(np.zeros(n), k * T)
        line.poll(k * T)
    said = line.name_swings()
    assert line.name_swings() == ''  # each joint once
    return said


def test_noise_of_an_encoder_passes_for_no_swing_and_a_swing_is_one():
    """Of an arm that measures no velocities; the noise is a hundred times that of 20 bits."""
    assert swinging(sigma=3.8e-4) == ''
    assert 'joint7' in swinging(sigma=1e-5, frequency=25.0, amplitude=2e-3)


def test_controller_that_is_back_takes_over_at_once_and_gravity_is_left_without_states():
    """After that it waits for a new controller."""
    arm = two_link()
    for takeovers in (1, 2):
        count = len(arm.taken)
        arm.run(0.1)
        assert not arm.line.active
        assert len(arm.taken) == count
        arm.run(0.2, hangs=True)
        assert arm.line.active
        assert arm.line.takeovers == takeovers
        arm.controller.reset()
    assert arm.line.leave().all()
    now = arm.now
    polled = [arm.line.poll(now + k * 1e-3) for k in range(1000)]
    faded = [torque.copy() for torque in polled if torque is not None]
    np.testing.assert_array_equal(faded[-1], faded[-2])  # gravity is left
    safety = arm.config.safety
    seconds = arm.T + safety.state_timeout + 0.5
    assert len(faded) * 1e-3 == pytest.approx(seconds, abs=0.005)
    arm.run(0.2, hangs=True)
    assert not arm.line.active


def test_torque_changes_by_its_rate_from_what_the_controller_commanded():
    """By the rate of a sample of 1 ms."""
    limited = AT_REST | {'torque.rate_limit': [300.0, 300.0]}
    arm, restarted = two_link(limited), two_link(limited)
    restarted.line = TorqueWatchdog(arm.config, TIMEOUT, armed=True)
    arm.run(0.1)
    last = np.array([20.0, -5.0])
    arm.line.take_torque(last, arm.now)
    for each in (arm, restarted):
        each.run(0.1, hangs=True)
    steps = np.diff([last, *arm.taken], axis=0)
    assert np.abs(steps).max() == pytest.approx(0.3)
    assert np.abs(restarted.taken[0]).min() > 1.0  # half of gravity


@pytest.mark.parametrize('armed', [False, True])
def test_states_that_are_repeated_are_a_silence_after_which_it_waits_for_the_controller(
    armed,
):
    """As of a driver that was stopped, or of a plant in lock-step that waits for a torque.

    Nobody expects a torque any more, as after a restart of the driver.
    """
    arm = two_link()
    arm.run(0.1)
    if armed:
        arm.line = TorqueWatchdog(arm.config, TIMEOUT, armed=True)
    q = np.append(arm.state().q, np.zeros(4))
    for k in range(2200):  # the last 0.1 s are new states again
        stamp = 1.1e9 + 1e6 * max(0, k - 2100)
        arm.line.take_state(round(stamp), q, 0.1 + 1e-3 * k)
        assert arm.line.poll(0.1 + 1e-3 * k) is None
