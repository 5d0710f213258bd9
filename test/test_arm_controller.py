# SPDX-License-Identifier: Apache-2.0
"""The guarded law in a loop of one's own: the same bits as the nodes', and a bag like theirs."""

from __future__ import annotations

import math
import os
import shutil
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml
from recorded_run import limited_files, small_disk

import blf_dsc_controller as blf
from blf_dsc_controller.bags.content import read_content
from blf_dsc_controller.bags.recovery import recover
from blf_dsc_controller.cli.bags import PARTIAL
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.control.arm_controller import StateError
from blf_dsc_controller.errors import (
    BlfDscError,
    ConfigurationError,
    LoopEndedError,
)
from blf_dsc_controller.law.weighing import DEVIATION
from blf_dsc_controller.messages.journal import EventType
from blf_dsc_controller.messages.topics import COMMANDS
from blf_dsc_controller.reference.trajectory import TrajectoryError
from blf_dsc_controller.run import FIRST_STAMP
from blf_dsc_controller.supervision.supervisor import Phase
from sim_plant.plant import plant_of
from sim_plant.settings import steps_of

LOOP = blf.load_loop('recommended', {'sim_plant': {'duration': 1.0}})
AT_REST = (2.2, 1.6), (0.0, 0.0)  # q [rad], dq
LONG = blf.load_loop('recommended', {'sim_plant': {'duration': 4.0}})

KILLED = """
import os, signal, sys, time
from test_arm_controller import LOOP, blf, plant_of, run
controller = blf.ArmController(LOOP.controller, record=sys.argv[1])
run(controller, plant_of(LOOP.plant), LOOP.plant, 700)
controller._outputs._recorder._bag.flush()  # as after 0.1 s
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
    steps = steps_of(LOOP.plant) + 1
    with blf.ArmController(LOOP.controller, record=tmp_path / 'bag') as controller:
        torques = run(controller, plant, LOOP.plant, steps)
        assert controller.phase is Phase.TRACKING
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
    assert np.isnan(controller.reference).all()
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
    controller.stop()
    np.testing.assert_array_equal(controller.reference, now)
    controller.start()
    assert np.isnan(controller.reference).all()


@pytest.mark.parametrize(
    ('given', 'problem'),
    [
        ((0.0, [0.0] * 3, [0.0] * 2), r'q: got an array of shape \(3,\), but \(2,\)'),
        ((0.0, [0.0] * 2, 0.0), r'dq: got an array of shape \(\), but \(2,\)'),
        ((0.0, [0.0] * 2, [0.0] * 2, [0.0]), r'effort: got an array of shape \(1,\)'),
        ((0.0, 'high', [0.0] * 2), r'q: got what is no array of numbers, but \(2,\)'),
        ((0.0, [0.0, [0.0]], [0.0] * 2), 'q: got what is no array of numbers'),
        ((math.nan, [0.0] * 2, [0.0] * 2), 'stamp: got nan, but a finite time'),
        ((None, [0.0] * 2, [0.0] * 2), 'stamp: got None, but a finite time'),
    ],
)
def test_states_of_another_shape_are_errors_and_change_nothing(given, problem):
    controller = blf.ArmController(LOOP.controller)
    with pytest.raises(StateError, match=problem):
        controller.update(*given)
    with pytest.raises(StateError, match=r'motors: got an array of shape \(2,\)'):
        controller.update(0.0, [0.0, 0.0], [0.0, 0.0], motors=[0.0, 0.0])
    assert controller.phase is Phase.STARTING


def test_faults_stop_it_with_a_reason_and_a_safe_torque():
    controller = blf.ArmController(LOOP.controller)
    plant = plant_of(LOOP.plant)
    run(controller, plant, LOOP.plant, 100)
    q, dq, _ = plant.measure().reshape(3, -1)
    torque = controller.update(1.1, [math.nan, q[1]], dq)
    assert controller.phase is Phase.SAFE_STOP
    assert 'the positions are not finite' in controller.reason
    assert torque is not None
    assert np.isfinite(torque).all()


def test_law_takes_what_it_commanded_for_efforts_that_are_not_given():
    """No effort is not one of 0 N m: the law would learn that its commands do not arrive."""
    config = change(LOOP.controller, {'robot.effort': 'commanded'})
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
        assert controller.phase is Phase.TRACKING
    for with_efforts, without in zip(*found, strict=True):
        np.testing.assert_array_equal(with_efforts, without)


def test_interval_of_the_load_covers_95_percent():
    """1.96 standard deviations of a normal distribution on each side."""
    controller = blf.ArmController('panda')
    load = controller.guard.controller.state.weighing.load
    load[0], load[DEVIATION] = 2.0, 0.1
    assert controller.load == (2.0, pytest.approx(0.196))
    load[DEVIATION] = 0.0
    assert math.isnan(controller.load.interval)


def test_it_follows_trajectories_and_stops_on_request():
    controller = blf.ArmController(LOOP.controller)
    plant = plant_of(LOOP.plant)
    run(controller, plant, LOOP.plant, 10)
    controller.follow([(2.0, np.array([2.2, 1.6]))])
    with pytest.raises(TrajectoryError, match='rejected'):
        controller.follow([blf.TrajectoryPoint(1e-3, (90.0, 90.0))])
    with pytest.raises(TrajectoryError, match='each point is a time and positions'):
        controller.follow([2.2, 1.6])
    for step in range(10, 2500):
        q, dq, effort = plant.measure().reshape(3, -1)
        plant.step(controller.update(1.0 + 1e-3 * step, q, dq, effort))
    np.testing.assert_allclose(q, (2.2, 1.6), atol=2e-3)  # the bound
    controller.stop()
    assert controller.phase is Phase.INACTIVE
    controller.start()
    assert controller.phase is Phase.STARTING


def test_presets_and_files_are_found_by_name_and_bags_are_not_overwritten(tmp_path):
    assert blf.ArmController('recommended').joints == ('joint1', 'joint2')
    with pytest.raises(ConfigurationError, match='does not exist'):
        blf.ArmController('nowhere.yaml')
    (tmp_path / 'bag').mkdir()
    with pytest.raises(BlfDscError, match='exists'):
        blf.ArmController('recommended', record=tmp_path / 'bag')


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
        assert controller.phase is Phase.SAFE_STOP
        assert 'the bus is silent' in controller.reason
        q, dq, _ = plant.measure().reshape(3, -1)
        controller.update(3.0, q, dq)  # a bag without a state cannot be read
    content = read_content(tmp_path / 'bag')
    ((received, stop),) = (
        each for each in content.events if each[1].type is EventType.STOP
    )
    assert received < 3_000_000_000  # at once, not with the next state
    assert stop.content['text'] == 'the bus is silent'
    assert stop.commands == samples
    if samples:
        commands = content.topics[COMMANDS]
        names = commands.joint_names()
        recorded = commands.joint_states(names, ()).field(2)[:]
        np.testing.assert_array_equal(recorded[: samples + 1], [*torques, torque])
        # the failure's, that for the state, and the last one at the end
        assert len(recorded) == samples + 3


# Both hold half of the run's 1.9 MB.
@pytest.mark.parametrize(
    'full', [partial(small_disk, megabytes=1), partial(limited_files, size=10**6)]
)
def test_full_disk_ends_the_recording_and_no_torque_is_lost(full, tmp_path, caplog):
    # Before: compiled kernels would be files that are too large, too.
    simulated = blf.simulate(LONG.controller, LONG.plant).run()
    with blf.ArmController(LONG.controller) as controller:
        run(controller, plant_of(LONG.plant), LONG.plant, 10)
    plant = plant_of(LONG.plant)
    with full(tmp_path / 'disk') as disk:
        bag = disk / 'bag'
        with blf.ArmController(LONG.controller, record=bag) as controller:
            torques = run(controller, plant, LONG.plant, steps_of(LONG.plant) + 1)
            assert controller.phase is Phase.TRACKING
        shutil.copytree(bag, tmp_path / 'bag')  # off the full disk
    saved = recover(tmp_path / 'bag', tmp_path / 'saved')
    assert f'blf_dsc recover {bag} saves' in controller.output_problem
    np.testing.assert_array_equal(torques, simulated.torque)
    assert len(caplog.records) == 1  # said once
    assert 500 < saved.messages[COMMANDS.resolved] < 4000
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
        lambda each: each.prepare(AT_REST[0]),
        lambda each: each.follow([blf.TrajectoryPoint(1.0, AT_REST[0])]),
        blf.ArmController.start,
        blf.ArmController.reset,
    ],
)
def test_closed_controller_commands_no_more_and_still_says_what_it_found(use):
    with blf.ArmController(LOOP.controller) as controller:
        q, dq, effort = plant_of(LOOP.plant).measure().reshape(3, -1)
        controller.update(1.0, q, dq, effort)
        found = controller.estimates
    with pytest.raises(LoopEndedError, match=r'is closed.*: make another one'):
        use(controller)
    assert controller.estimates == found
    assert controller.close() is not None


def test_error_at_the_end_of_the_recording_does_not_lose_the_last_torque(tmp_path):
    """The disk is full when the bag is completed."""
    plant = plant_of(LOOP.plant)
    with limited_files(tmp_path / 'disk', 1000) as disk:  # holds no chunk
        controller = blf.ArmController(LOOP.controller, record=disk / 'bag')
        q, dq, effort = plant.measure().reshape(3, -1)
        controller.update(1.0, q, dq, effort)
        assert controller.close() is not None
    assert 'cannot be written any further: File too large' in controller.output_problem


def test_recording_of_a_loop_that_was_killed_is_not_said_to_be_whole(tmp_path, capsys):
    """A loop without ROS, whose process ends by SIGKILL in motion."""
    killed = subprocess.run(
        [sys.executable, '-c', KILLED, tmp_path / 'bag'], env=ENVIRONMENT, check=False
    )
    assert killed.returncode == -signal.SIGKILL
    recover(tmp_path / 'bag', tmp_path / 'saved')
    assert main(['replay', str(tmp_path / 'saved')]) == PARTIAL
    assert 'MISSING in the bag: the end of the run' in capsys.readouterr().out


def errors_of_a_heavy_panda(config, record=None):
    """Return the largest error [rad] of the first second, and of 7 more, in MuJoCo."""
    arm = mujoco.MjModel.from_xml_path(str(blf.share_folder() / 'config/panda.urdf'))
    arm.opt.timestep = 0.001
    arm.dof_armature[:] = 0.1
    arm.body_mass[:] *= 1.25  # the URDF is a fifth too light
    arm.body_inertia[:] *= 1.25
    data = mujoco.MjData(arm)
    data.qpos[:7] = [-0.14, -0.04, -0.03, -1.43, -0.05, 1.66, 0.27]
    errors = []
    with blf.ArmController(config, record=record) as controller:
        for _ in range(8000):
            data.qfrc_applied[:7] = controller.update(
                data.time, data.qpos[:7], data.qvel[:7]
            )
            mujoco.mj_step(arm, data)
            errors.append(np.abs(controller.error).max())
    return max(errors[:1000]), max(errors[1000:])


def test_next_day_begins_with_what_a_day_has_shown(tmp_path, monkeypatch, capsys):
    """As the page says: `blf_dsc identify` of the recorded day, and its robot.* in the file."""
    monkeypatch.chdir(tmp_path)
    first, _ = errors_of_a_heavy_panda('panda', 'day1')
    arm = ['--urdf', 'panda.urdf', '--tip', 'panda_hand_tcp', '--effort', 'command']
    outputs = ['--out', 'learned.urdf', '--out', 'learned.yaml']
    assert main(['identify', 'day1', *arm, *outputs]) == 0, capsys.readouterr().err
    learned = yaml.safe_load(Path('learned.yaml').read_text())['/**']['ros__parameters']
    given = {name: learned[name] for name in learned if name != 'joints'}
    loop = blf.load_loop('panda', {'blf_dsc_controller': given, 'sim_plant': given})
    errors = errors_of_a_heavy_panda(loop.controller)
    assert first > 0.01  # rad; 13 mrad
    assert max(errors) < 0.001  # 0.5 mrad
