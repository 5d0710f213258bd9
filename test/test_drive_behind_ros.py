# SPDX-License-Identifier: Apache-2.0
"""A robot behind ROS as any other: a script and `blf_dsc drive` command it by its topics."""

from __future__ import annotations

import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from command import wait_for
from std_srvs.srv import Trigger

import blf_dsc_controller as blf
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import Float64MultiArrayEncoder
from blf_dsc_controller.nodes.plant_node import PlantNode

STEP = np.array([0.1, -0.1])  # rad


@pytest.fixture
def behind(ros, monkeypatch):
    """Start the simulated arm as a driver in lock-step, whose node works in a thread."""
    monkeypatch.setenv('ROS_DOMAIN_ID', str(ros.context.get_domain_id()))
    ros.add(PlantNode, mode='lockstep')
    return ros


@contextmanager
def working(ros, also=lambda: None):
    """Let the nodes of this process work meanwhile, in a thread."""
    is_over = threading.Event()

    def work():
        while not is_over.is_set():
            ros.executor.spin_once(timeout_sec=0.01)
            also()

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield
    finally:
        is_over.set()
        thread.join()


def test_script_moves_it_and_is_told_why_a_target_is_refused(behind, tmp_path):
    bag = tmp_path / 'bag'
    with (
        working(behind),
        blf.Drive('recommended', robot='ros', record=bag) as arm,
    ):
        start = arm.state.q
        with pytest.raises(blf.MotionFailedError, match='joint1'):
            arm.move_to([9.0, 0.0])
        arm.move_to(start + STEP, speed=1.0)
        state = arm.state
        np.testing.assert_allclose(state.reference, start + STEP, atol=1e-3)
        assert (np.abs(state.error) < state.bound).all()
    assert arm.ended == 'ended on request'
    assert blf.verify(bag).difference is None


def test_stop_of_somebody_else_ends_its_motion(behind):
    client = behind.tester.create_client(Trigger, '/blf_dsc_controller/stop')
    with working(behind), blf.Drive('recommended', robot='ros') as arm:
        assert client.wait_for_service(30.0)
        start = arm.state.reference
        arm.move_to(arm.state.q + 10.0 * STEP, speed=0.05, wait=False)
        wait_for(lambda: np.abs(arm.state.reference - start).max() > 0.01)
        client.call_async(Trigger.Request())
        with pytest.raises(blf.MotionFailedError, match='by ~/stop'):
            arm.wait()


def test_second_publisher_ends_it_and_the_arm_is_held_until_it_recovers(behind):
    plant = behind.nodes[-1].plant
    held = {'blf_dsc_controller': {'safety.torque': 'hold_gravity'}}
    with working(behind), blf.Drive('recommended', held, robot='ros') as arm:
        other = behind.publisher(topics.COMMANDS)
        wait_for(lambda: arm.ended)
        assert 'the controller stopped: another node publishes torques on' in arm.ended
        ended = plant.sample
        wait_for(lambda: plant.sample > ended + 1000)  # who waits for a torque gets it
        assert np.abs(plant.measure().reshape(3, -1)[1]).max() < 0.01  # rad/s
        behind.tester.destroy_publisher(other)
        time.sleep(2.0)  # the node looks every second
        arm.recover()
        arm.move_to(arm.state.q + STEP, speed=1.0)


def test_nothing_starts_beside_another_commander(behind):
    other = behind.publisher(topics.COMMANDS)
    torque = Float64MultiArrayEncoder(2).encode(np.zeros(2))
    with (
        working(behind, lambda: other.publish(torque)),
        pytest.raises(blf.LoopEndedError, match='another node commands torques on'),
    ):
        blf.Drive('recommended', robot='ros')


def test_command_controls_it_for_a_while(behind, tmp_path, capfd):
    out = tmp_path / 'bag'
    words = ['drive', '--robot', 'ros', '--config', 'recommended', '--duration', '0.5']
    with working(behind):
        assert main([*words, '--out', str(out)]) == 0
    told = capfd.readouterr().out
    assert 'end           the duration is over' in told
    assert ', and 0 missed' in told
    assert blf.verify(out).difference is None


def test_robot_without_topics_is_told(ros, monkeypatch, capfd, tmp_path):
    monkeypatch.setenv('ROS_DOMAIN_ID', str(ros.context.get_domain_id()))
    words = ['drive', '--robot', 'ros', '--config', 'recommended']
    assert main([*words, '--out', str(tmp_path / 'bag')]) == 1
    assert 'nobody takes torques on /blf_dsc_controller/commands' in (
        capfd.readouterr().err
    )
    assert main([*words, '--ros']) == 1
    assert '--robot ros has its topics already' in capfd.readouterr().err
