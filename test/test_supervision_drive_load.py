# SPDX-License-Identifier: Apache-2.0
"""A weighed load is declared to the drives step by step, and the law leaves it to them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenario import Scenario

import blf_dsc_controller as blf
from blf_dsc_controller.law.contact import TOUCHED
from blf_dsc_controller.messages.tip_load import TipLoad
from sim_plant.settings import plant_settings

HELD = {'events.begin': [3.0], 'events.duration': [7.0], 'events.payload': [2.0]}
GIVEN = {
    'load.tell_drive': True,
    'safety.torque': 'hold_gravity',
    'learning.window': 2.0,
}
HOLD = {'reference.type': 'hold', 'safety.torque': 'hold_gravity'}


def test_load_is_declared_in_steps_kept_over_a_reset_and_taken_back():
    """An FR3 that picks 2 kg up at 3 s and puts them down at 10 s.

    In between it is stopped and reset: the law forgets the load, and the drives hold it.
    """
    given = {'sim_plant': HELD, 'blf_dsc_controller': GIVEN}
    loop = blf.load_loop('fr3_direct', given)
    arm = Scenario(loop)
    declared = []

    def declare():
        load = arm.controller.load_to_tell()
        if load is not None:
            robot = replace(
                loop.plant.robot,
                drive_payload=load.mass,
                drive_payload_centre=load.centre,
            )
            arm.plant.change(plant_settings(replace(loop.plant, robot=robot)))
            arm.controller.take_over(load)
            declared.append(load.mass)
        return False

    moving = arm.run(5.0, until=declare)
    assert len(declared) > 10
    assert (np.diff(declared) > 0.0).all()
    assert declared[-1] == pytest.approx(2.0, abs=0.1)
    assert moving.ratio < 0.2
    limit = (
        np.array(arm.config.torque.rate_limit) * arm.T
    )  # of the drives, else they stop
    steps = np.abs(np.diff(moving.torque[2000:], axis=0))
    assert (steps <= limit * (1.0 + 1e-9)).all()

    last = moving.torque[-1]
    assert (
        np.abs(arm.run(arm.T).torque[0] - last).max() < 1.0
    )  # N m: left to the drives

    arm.controller.stop()
    resting = arm.run(2.0)
    assert resting.speed[-1].max() < 0.01
    assert arm.controller.load_to_tell() is None
    arm.controller.reset()
    after = arm.run(0.2)
    assert arm.is_running, arm.text
    assert np.abs(after.torque[0] - resting.torque[-1]).max() < 0.01  # N m
    assert np.abs(after.q - resting.q[-1]).max() < 0.004

    arm.run(10.0 - after.t[-1], until=declare)
    assert declared[-1] == pytest.approx(2.0, abs=0.1)  # nothing has changed
    put_down = arm.run(3.0, until=declare)
    assert put_down.ratio < 0.8
    assert declared[-1] == pytest.approx(0.0, abs=0.15)


SURE = (0.01, 0.005, 0.005, 0.005)  # kg and m, standard deviations


@pytest.mark.parametrize(
    ('mass', 'deviations', 'is_declared'),
    [
        (2.0, SURE, True),
        (0.04, SURE, False),  # kg, within 0.05: no change
        (2.0, (0.05, 0.0, 0.005, 0.005), False),  # no interval of the centre yet
        (2.0, (0.05, 0.005, 0.005, 0.005), True),  # 0.098 kg, less than 5 %
        (2.0, (0.052, 0.005, 0.005, 0.005), False),
        (2.0, (0.0, 0.005, 0.005, 0.005), False),  # not weighed yet
        (2.0, (0.01, 0.005, 0.005, 0.016), False),  # 0.031 m, more than 0.03
    ],
)
def test_only_a_load_that_is_well_known_is_declared(mass, deviations, is_declared):
    arm = Scenario('fr3_direct', GIVEN)
    arm.run(0.05)
    state = arm.guard.controller.state
    state.payload.load[:] = (mass, 0.01, -0.02, 0.05, *deviations)
    assert (arm.controller.load_to_tell() is not None) == is_declared
    state.contact.phase[0] = TOUCHED
    assert arm.controller.load_to_tell() is None


def test_told_load_is_left_as_it_is_until_another_is_weighed():
    """Small changes are declared as the rest of a load only, not as one of its own."""
    arm = Scenario('fr3_direct', GIVEN)
    arm.run(0.05)
    arm.controller.take_over(TipLoad(2.0, (0.01, -0.02, 0.05)))
    load = arm.guard.controller.state.payload.load
    declared = []
    for mass in (2.05, 2.2, 2.05):  # which begins in several steps, and goes on
        load[:] = (mass, 0.01, -0.02, 0.05, *SURE)
        declared.append(arm.controller.load_to_tell() is not None)
    assert declared == [False, True, True]


CEILING = [0.0, 0.0, 9.81]
UPRIGHT = [0.0, 0.0, -9.81]


def on_ceiling(preset, drive_gravity):
    robot = {'robot.gravity': CEILING, 'robot.drive_gravity': drive_gravity}
    robot['robot.drive_compensates'] = 'gravity'
    common = {'sim_plant': robot, 'blf_dsc_controller': robot | HOLD}
    return Scenario(blf.load_loop(preset, common))


@pytest.mark.parametrize('drive_gravity', [CEILING, UPRIGHT])
def test_arm_on_the_ceiling_is_held_whatever_its_drives_take_for_down(drive_gravity):
    arm = on_ceiling('panda', drive_gravity)
    held = arm.run(1.0)
    assert arm.is_running, arm.text
    assert held.ratio < 0.1
    arm.controller.stop()
    stopped = arm.run(2.0)
    assert np.abs(stopped.q - stopped.q[0]).max() < 0.02
    assert stopped.speed.max() < 0.05


def test_arm_that_upright_drives_cannot_hold_is_not_started():
    arm = on_ceiling('fr3_direct', UPRIGHT)
    arm.run(0.01)
    assert 'the first torque would step' in arm.text
    assert 'drive_compensates to gravity' not in arm.text


@pytest.mark.parametrize('gravity', [[1.0, 0.0, -9.7], CEILING, [0.0, 0.0, 0.0]])
def test_drives_that_compensate_on_a_tilted_base_say_by_which_gravity(gravity):
    given = {'robot.gravity': gravity}
    with pytest.raises(blf.ConfigurationError, match='the base is tilted'):
        blf.load_loop('fr3', {'sim_plant': given, 'blf_dsc_controller': given})
