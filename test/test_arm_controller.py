# SPDX-License-Identifier: Apache-2.0
"""The guarded law in a loop of one's own: the same bits as the nodes', and a bag like theirs."""

from __future__ import annotations

import math
import os
import shutil
import signal
import subprocess
import sys

import numpy as np
import pytest
from recorded_run import limited_files
from scenario import Scenario

import blf_dsc_controller as blf
from blf_dsc_controller.bags.content import read_content
from blf_dsc_controller.bags.recovery import recover
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.messages import topics
from blf_dsc_controller.run import FIRST_STAMP
from sim_plant.plant import plant_of

LOOP = blf.load_loop('recommended', {'sim_plant': {'duration': 1.0}})
AT_REST = (2.2, 1.6), (0.0, 0.0)  # q [rad], dq
LONG = blf.load_loop('recommended', {'sim_plant': {'duration': 4.0}})

KILLED = """
import os, signal, sys, time
from test_arm_controller import LOOP, blf, plant_of, run
controller = blf.ArmController(LOOP.controller, record=sys.argv[1])
run(controller, plant_of(LOOP.plant), LOOP.plant, 700)
controller._recorder._bag.flush()  # as after 0.1 s
while os.path.getsize(f'{sys.argv[1]}/bag_0.mcap') < 100_000:  # of some 300 kB
    time.sleep(0.01)
os.kill(os.getpid(), signal.SIGKILL)
"""
ENVIRONMENT = os.environ | {'PYTHONPATH': os.pathsep.join(filter(None, sys.path))}


def run(controller, plant, config, steps):
    """Run the loop as a user does; return the torques (steps, n)."""
    torques = []
    for step in range(steps):
        q, dq, effort = plant.measure().reshape(3, -1)
        stamp = FIRST_STAMP * 1e-9 + step * config.sample_time
        torque = controller.update(stamp, q, dq, effort)
        torques.append(torque)
        plant.step(torque)
    return np.array(torques)


def test_it_computes_the_bits_of_the_simulation_and_its_bag_replays_them(tmp_path):
    plant = plant_of(LOOP.plant)
    steps = 1001  # of 1 s, with its end
    with blf.ArmController(LOOP.controller, record=tmp_path / 'bag') as controller:
        torques = run(controller, plant, LOOP.plant, steps)
        assert controller.phase is blf.Phase.TRACKING
        assert (np.abs(controller.error) < controller.bound).all()
        assert set(controller.estimates) > {'m2*l1*l2'}
        assert math.isnan(controller.load.mass)
    simulated = blf.simulate(LOOP.controller, LOOP.plant).run()
    np.testing.assert_array_equal(torques, simulated.torque)
    recorded = blf.read_run(tmp_path / 'bag')
    np.testing.assert_array_equal(recorded.torque, simulated.torque)
    verified = blf.verify(tmp_path / 'bag')
    assert verified.difference is None
    assert verified.samples == steps
    assert not any(found.missing for found in verified.comparisons)


def test_reference_is_that_of_the_last_sample_and_its_own_copy():
    """q - q_r is the error that it reports, and dq_r, ddq_r are the rates of q_r."""
    controller = blf.ArmController(LOOP.controller)
    plant = plant_of(LOOP.plant)
    run(controller, plant, LOOP.plant, 100)
    q, dq, effort = plant.measure().reshape(3, -1)
    before = controller.reference
    controller.update(1.1, q, dq, effort)
    now = controller.reference
    np.testing.assert_array_equal(q - now.q, controller.error)
    T = LOOP.plant.sample_time
    # of a trapezoid's error, T^2 / 12 times the third derivative: the reference is smooth
    np.testing.assert_allclose(
        (now.q - before.q) / T, 0.5 * (now.dq + before.dq), atol=1e-5
    )
    np.testing.assert_allclose(
        (now.dq - before.dq) / T, 0.5 * (now.ddq + before.ddq), atol=1e-3
    )


@pytest.mark.parametrize(
    ('given', 'problem'),
    [
        ((0.0, [0.0] * 3, [0.0] * 2), r'q: got an array of shape \(3,\), but \(2,\)'),
        ((0.0, [0.0] * 2, [0.0] * 2, [0.0]), r'effort: got an array of shape \(1,\)'),
        ((0.0, [0.0, [0.0]], [0.0] * 2), 'q: got what is no array of numbers'),
        ((math.nan, [0.0] * 2, [0.0] * 2), 'stamp: got nan, but a finite time'),
    ],
)
def test_states_of_another_shape_are_errors_and_change_nothing(given, problem):
    controller = blf.ArmController(LOOP.controller)
    with pytest.raises(blf.StateError, match=problem):
        controller.update(*given)
    with pytest.raises(blf.StateError, match=r'motors: got an array of shape \(2,\)'):
        controller.update(0.0, [0.0, 0.0], [0.0, 0.0], motors=[0.0, 0.0])
    assert controller.phase is blf.Phase.STARTING


def test_law_takes_what_it_commanded_for_efforts_that_are_not_given():
    """No effort is not one of 0 N m: the law would learn that its commands do not arrive."""
    config = blf.change(LOOP.controller, {'robot.effort': 'commanded'})
    found = []
    for gives in (True, False):
        controller = blf.ArmController(config)
        plant = plant_of(LOOP.plant)
        torque = np.full(2, math.nan)
        for step in range(200):
            q, dq, _ = plant.measure().reshape(3, -1)
            effort = torque if gives else None
            torque = controller.update(1.0 + 1e-3 * step, q, dq, effort)
            plant.step(torque)
        found.append((torque, list(controller.estimates.values())))
        assert controller.phase is blf.Phase.TRACKING
    for with_efforts, without in zip(*found, strict=True):
        np.testing.assert_array_equal(with_efforts, without)


def test_torque_is_sent_before_anything_is_learned_from_its_state():
    """What is learned takes up to fifty times as long as a torque."""
    controller = blf.ArmController(LOOP.controller)
    plant = plant_of(LOOP.plant)
    at_sending, after = [], []
    for step in range(800):
        controller.update(
            1.0 + 1e-3 * step,
            *plant.measure().reshape(3, -1),
            send=lambda torque: (
                plant.step(torque),
                at_sending.append([*controller.estimates.values()]),
            ),
        )
        after.append([*controller.estimates.values()])
    np.testing.assert_array_equal(at_sending[1:], after[:-1])
    assert after[-2] != after[-1]


def test_it_follows_trajectories_and_stops_on_request():
    arm = Scenario(LOOP)
    controller = arm.controller
    arm.run(0.01)
    controller.follow([(2.0, np.array([2.2, 1.6]))])
    with pytest.raises(blf.TrajectoryError, match='rejected'):
        controller.follow([blf.TrajectoryPoint(1e-3, (90.0, 90.0))])
    with pytest.raises(blf.TrajectoryError, match='each point is a time and positions'):
        controller.follow([2.2, 1.6])
    for begin in (float('nan'), 1.7e9, 'soon'):
        with pytest.raises(blf.TrajectoryError):
            controller.follow([(2.0, np.array([2.2, 1.6]))], begin=begin)
    for stamp in (float('nan'), 1.7e18, 'now'):
        with pytest.raises(blf.StateError, match='a finite time in s is needed'):
            controller.update(stamp, [2.0, 1.5], [0.0, 0.0])
    (*_, q) = arm.run(2.5).q
    np.testing.assert_allclose(q, (2.2, 1.6), atol=2e-3)  # the bound
    controller.stop()
    assert controller.phase is blf.Phase.INACTIVE
    controller.start()
    assert controller.phase is blf.Phase.STARTING


# 0.0005 rad is inside the bound, where the law could take over, but not the same place.
@pytest.mark.parametrize(
    ('away', 'is_used'), [(0.0, True), (0.0005, False), (0.01, False)]
)
def test_prepared_start_is_used_if_the_arm_is_still_there(away, is_used, tmp_path):
    """From elsewhere the approach is planned again; both replay."""
    start = {'initial.position': [2.0, 1.5], 'duration': 0.2}
    loop = blf.load_loop('recommended', {'sim_plant': start})
    plant = plant_of(loop.plant)
    q = plant.measure().reshape(3, -1)[0]
    with blf.ArmController(loop.controller, record=tmp_path / 'bag') as controller:
        controller.prepare(q + 1e-5 + away)
        torques = run(controller, plant, loop.plant, 100)
        assert (np.abs(controller.error) < controller.bound).all()
    unprepared = blf.simulate(loop.controller, loop.plant).run().torque[:100]
    assert np.array_equal(torques, unprepared) is not is_used
    assert blf.verify(tmp_path / 'bag').difference is None


@pytest.mark.parametrize('samples', [0, 100])
def test_failure_of_the_caller_is_a_stop_that_the_bag_holds(samples, tmp_path):
    """Before the first torque nothing is commanded, afterwards what leads to the safe one."""
    plant = plant_of(LOOP.plant)
    with blf.ArmController(LOOP.controller, record=tmp_path / 'bag') as controller:
        torques = run(controller, plant, LOOP.plant, samples)
        torque = controller.fail('the bus is silent')
        assert (torque is None) == (samples == 0)
        assert controller.phase is blf.Phase.SAFE_STOP
        assert 'the bus is silent' in controller.reason
        q, dq, _ = plant.measure().reshape(3, -1)
        controller.update(3.0, q, dq)  # a bag without a state cannot be read
    content = read_content(tmp_path / 'bag')
    ((received, stop),) = (each for each in content.events if each[1].type == 'stop')
    assert received < 3_000_000_000  # at once, not with the next state
    assert stop.content['text'] == 'the bus is silent'
    assert stop.commands == samples
    if samples:
        commands = content.topics[topics.COMMANDS]
        names = commands.joint_names()
        recorded = commands.joint_states(names, ()).field(2)[:]
        np.testing.assert_array_equal(recorded[: samples + 1], [*torques, torque])
        # the failure's, that for the state, and the last one at the end
        assert len(recorded) == samples + 3


def test_full_disk_ends_the_recording_and_no_torque_is_lost(tmp_path, caplog):
    """It holds half of the run's 1.9 MB."""
    # Before: compiled kernels would be files that are too large, too.
    simulated = blf.simulate(LONG.controller, LONG.plant).run()
    with blf.ArmController(LONG.controller) as controller:
        run(controller, plant_of(LONG.plant), LONG.plant, 10)
    plant = plant_of(LONG.plant)
    with limited_files(tmp_path / 'disk', 10**6) as disk:
        bag = disk / 'bag'
        with blf.ArmController(LONG.controller, record=bag) as controller:
            torques = run(controller, plant, LONG.plant, 4001)
            assert controller.phase is blf.Phase.TRACKING
        shutil.copytree(bag, tmp_path / 'bag')  # off the full disk
    saved = recover(tmp_path / 'bag', tmp_path / 'saved')
    assert f'blf_dsc recover {bag} saves' in controller.output_problem
    np.testing.assert_array_equal(torques, simulated.torque)
    assert len(caplog.records) == 1  # said once
    assert 500 < saved.messages[topics.COMMANDS.resolved] < 4000
    metadata = tmp_path / 'bag' / 'metadata.yaml'
    assert not metadata.exists()  # it would count what is not there


class Failing:
    """An output of a user that fails at its tenth message."""

    def __init__(self):
        self.taken = 0

    def write(self, *_):
        self.taken += 1
        if self.taken == 10:
            raise ValueError('a mistake of the user')


def test_output_that_fails_is_dropped_and_the_others_go_on():
    plant = plant_of(LOOP.plant)
    failing = Failing()
    with blf.ArmController(LOOP.controller) as controller:
        controller.add_output(failing)
        torques = run(controller, plant, LOOP.plant, 100)
    assert failing.taken == 10
    assert controller.output_problem == 'ValueError: a mistake of the user'
    simulated = blf.simulate(LOOP.controller, LOOP.plant).run()
    np.testing.assert_array_equal(torques, simulated.torque[:100])


@pytest.mark.parametrize(
    'use',
    [
        lambda each: each.update(1.001, *AT_REST),
        lambda each: each.follow([blf.TrajectoryPoint(1.0, AT_REST[0])]),
        blf.ArmController.start,
    ],
)
def test_closed_controller_commands_no_more_and_still_says_what_it_found(use):
    with blf.ArmController(LOOP.controller) as controller:
        q, dq, effort = plant_of(LOOP.plant).measure().reshape(3, -1)
        controller.update(1.0, q, dq, effort)
        found = controller.estimates
    with pytest.raises(blf.LoopEndedError, match=r'is closed.*: make another one'):
        use(controller)
    assert controller.estimates == found
    assert controller.close() is not None


def test_recording_of_a_loop_that_was_killed_is_not_said_to_be_whole(tmp_path, capsys):
    """A loop without ROS, whose process ends by SIGKILL in motion."""
    killed = subprocess.run(
        [sys.executable, '-c', KILLED, tmp_path / 'bag'], env=ENVIRONMENT, check=False
    )
    assert killed.returncode == -signal.SIGKILL
    recover(tmp_path / 'bag', tmp_path / 'saved')
    assert main(['replay', str(tmp_path / 'saved')]) == 4  # partial
    assert 'MISSING in the bag: the end of the run' in capsys.readouterr().out


@pytest.mark.parametrize(
    ('q', 'says'), [([math.nan] * 2, 'positions'), ([126.0, 92.0], 'reference')]
)
def test_why_it_commands_nothing_is_logged_once(caplog, q, says):
    """As for angles in degrees: a loop that only looks at torques would not show it."""
    with blf.ArmController(LOOP.controller) as controller:
        for step in range(5):
            controller.update(1.0 + step * LOOP.plant.sample_time, q, (0.0, 0.0))
    (text,) = (each.message for each in caplog.records if each.levelname == 'WARNING')
    assert says in text
