# SPDX-License-Identifier: Apache-2.0
"""A stop does not shake joints that are lighter than assumed, and brakes others as before."""

from __future__ import annotations

import numpy as np
import pytest
from nights import one_by_day
from scenario import Scenario

import blf_dsc_controller as blf
from benchmark import random_arms
from blf_dsc_controller.law.sensor import FILTER
from blf_dsc_controller.simulation.loop import write_bag
from blf_dsc_controller.supervision.swing import Swing

T = 1e-3  # s
LATE = 5  # samples until a torque acts and shows
ASSUMED = 1.0  # kg m^2
RATE = 1.0 / FILTER  # 1/s, configured damping over the assumed inertia


def braked(lighter, seconds=1.0, push=0.0):
    """Return speeds (k,) [rad/s] and shares (k,) of a joint that a stop brakes from 1 rad/s.

    Its inertia is the assumed one over `lighter`; `push` [N m] acts on it all the time.
    """
    inertia = ASSUMED / lighter
    swing = Swing(1)
    swing.begin()
    speed = slow = 1.0
    torques = [0.0] * LATE
    seen = []
    for _ in range(round(seconds / T)):
        slow += T / FILTER * (speed - slow)
        swing.observe(np.array([slow]), np.zeros(1), np.zeros(1), T)
        share = swing.share[0]
        torques.append(-share * RATE * ASSUMED * slow)
        speed += T / inertia * (torques.pop(0) + push)
        seen.append((speed, share))
    speeds, shares = np.array(seen).T
    return speeds, shares


@pytest.mark.parametrize('lighter', [1 / 7, 0.5, 1.0, 1.5])
def test_joint_that_has_about_the_assumed_inertia_gets_all_of_the_damping(lighter):
    """1 / T is 6 times the configured rate: up to there the loop is stable by itself."""
    speeds, shares = braked(lighter)
    assert (shares == 1.0).all()
    assert np.abs(speeds).max() < 1.01


@pytest.mark.parametrize('lighter', [4.0, 8.0, 16.0, 25.0])
def test_light_joint_comes_to_rest_with_the_share_that_damps_it_well(lighter):
    """That is the inertia over the assumed one, within the error of a half period of 30 ms."""
    speeds, shares = braked(lighter)
    assert np.abs(speeds[-100:]).max() < 0.02
    assert 0.3 / lighter < shares.min() < 3.0 / lighter


def test_joint_that_has_swung_is_braked_again_if_it_moves_on():
    """Pushed by 2 N m it would reach 16 rad/s in a second; all of the damping leaves 0.06."""
    speeds, shares = braked(3.5, 2.0, push=2.0)
    assert shares.min() < 0.5
    assert shares[-1] == 1.0
    assert abs(speeds[-1]) < 0.1


def test_arm_that_a_hand_moves_to_and_fro_keeps_all_of_the_damping():
    """Every 4 s at up to 0.3 rad/s: it would be missing once the arm falls."""
    swing = Swing(1)
    swing.begin()
    for t in np.arange(0.0, 16.0, T):
        v = np.array([0.3 * np.sin(0.5 * np.pi * t)])
        swing.observe(v, np.zeros(1), np.zeros(1), T)
        assert swing.share[0] == 1.0


def test_steps_of_coarse_encoders_are_no_swing():
    """Of 0.38 mrad, in Damiao's frames: a differenced velocity comes in steps of 0.38 rad/s."""
    coarse = {'sensor.resolution': 3.8e-4, 'sensor.velocity': 'differenced'}
    arm = Scenario('openarm', plant=coarse)
    arm.run(2.0)
    arm.controller.fail('by hand')
    arm.run(2.0)
    assert arm.text == 'by hand'


ARMS = {
    'UR5e, encoders at the motors, torque loop': ('ur5e', 0),
    'UR5e, encoders at the links, torque loop': ('ur5e', 2),
    'UR5e, encoders at the motors': ('ur5e', 7),
    'FR3, encoders at the motors, torque loop': ('fr3', 0),
    'FR3, encoders at the links, torque loop': ('fr3', 9),
    # none of the twelve of each robot that this was made with
    'another UR5e': ('ur5e', 14),
}
IN_FLIGHT = 0.2  # s, with what swings until it is found


@pytest.mark.parametrize('arm', one_by_day(3, ARMS))
def test_stop_of_an_arm_that_nobody_foresaw_brakes_it(arm, tmp_path):
    """Random arms whose motors have down to a fifth of the guess, behind any gears.

    With all of the damping and the usual observer, a wrist goes on at 5 to 20 rad/s on the
    first five but the third.  What the law has sent before the stop still speeds wrists up.
    """
    name, number = ARMS[arm]
    study = random_arms.study_of(name, 'wide')
    plant = random_arms.arm_of(study, number)
    with np.errstate(all='ignore'):
        record = blf.simulate(study.controller, plant, after_stop=1.3)
    n = len(plant.joints)
    t = 1e-9 * record.stamps - record.stopped
    speed = np.abs(record.truths[:, -n:]).max(axis=1)
    before = speed[t < 0.0].max()
    assert speed[t > IN_FLIGHT].max() < before
    assert speed[t > 1.0].max() < 0.15
    write_bag(tmp_path / 'bag', record)
    result = blf.verify(tmp_path / 'bag')
    assert (result.difference, result.remarks) == (None, ())


def test_stop_names_the_joints_that_swing_in_it():
    study = random_arms.study_of('fr3', 'wide')
    loop = blf.load_loop('fr3')._replace(
        controller=study.controller, plant=random_arms.arm_of(study, 9)
    )
    arm = Scenario(loop)
    with np.errstate(all='ignore'):
        arm.run(1.5)
    assert arm.controller.phase is blf.Phase.SAFE_STOP
    swings = "joint 'fr3_joint7' swings under the damping of the stop"
    assert arm.text.count(swings) == 1
    assert arm.text.count('robot.rotor_inertia') == 1
