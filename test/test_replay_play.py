# SPDX-License-Identifier: Apache-2.0
"""Playing a bag: the right message at the right time, and over ROS the very bytes."""

from __future__ import annotations

import subprocess
import sys
import time

import pytest
import recorded_run

from blf_dsc_controller.messages.topics import JOINT_STATES
from blf_dsc_controller.replay.timeline import Timeline

TIMES = [100, 110, 120, 200]
PATIENCE = 300.0  # s, until a test gives up on what should take a moment


def test_messages_are_due_as_their_times_say():
    timeline = Timeline(TIMES, 1.0)
    assert list(timeline.due(1000, 9)) == [0]
    assert timeline.wait(1000) == pytest.approx(10e-9)
    assert list(timeline.due(1009, 9)) == []
    assert list(timeline.due(1020, 9)) == [1, 2]
    assert list(timeline.due(1100, 9)) == [3]
    assert timeline.is_over


def test_the_rate_stretches_time_and_zero_knows_none():
    timeline = Timeline(TIMES, 10.0)
    assert list(timeline.due(0, 9)) == [0]
    assert list(timeline.due(2, 9)) == [1, 2]
    assert timeline.wait(2) == pytest.approx(8e-9)
    fast = Timeline(TIMES, 0.0)
    assert [list(fast.due(0, 3)), list(fast.due(0, 3))] == [[0, 1, 2], [3]]


def test_a_pause_stops_the_time_and_steps_move_on_one_by_one():
    timeline = Timeline(TIMES, 1.0)
    timeline.due(1000, 9)
    assert timeline.step() is None  # only while paused
    timeline.pause(1005)
    assert list(timeline.due(5000, 9)) == []
    assert timeline.wait(5000) == float('inf')
    assert timeline.step() == 1
    timeline.resume(9000)  # at the time of message 1
    assert timeline.wait(9000) == pytest.approx(10e-9)
    assert list(timeline.due(9010, 9)) == [2]


def test_a_loop_begins_again():
    timeline = Timeline(TIMES, 0.0, loop=True)
    assert list(timeline.due(0, 9)) == [0, 1, 2, 3]
    assert list(timeline.due(0, 9)) == [0, 1, 2, 3]
    assert not timeline.is_over
    assert Timeline([], 1.0, loop=True).is_over


def test_a_bag_is_played_over_ros_byte_by_byte_under_another_name(tmp_path):
    pytest.importorskip('rclpy', reason='needs ROS 2')
    import rclpy
    from rclpy.qos import QoSProfile
    from sensor_msgs.msg import JointState
    from std_srvs.srv import Trigger

    path = recorded_run.record(tmp_path / 'bag', 0.2)
    sent = [raw for topic, _, _, raw in recorded_run.messages(path) if topic == '/joint_states']
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node('listener', context=context)
    executor = rclpy.executors.SingleThreadedExecutor(context=context)
    executor.add_node(node)
    came = []
    node.create_subscription(JointState, '/again', came.append, QoSProfile(depth=1000), raw=True)
    services = {
        name: node.create_client(Trigger, f'/rosbag2_player/{name}')
        for name in ('is_paused', 'play_next', 'resume')
    }

    def wait_for(condition):
        deadline = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < deadline, 'still waiting'
            executor.spin_once(timeout_sec=0.02)

    def call(name):
        wait_for(services[name].service_is_ready)
        future = services[name].call_async(Trigger.Request())
        wait_for(future.done)
        return future.result()

    words = ['--play', '--start-paused', '--rate', '0', '--remap', 'joint_states:=again']
    command = [sys.executable, '-m', 'blf_dsc_controller', 'replay', str(path), *words]
    player = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        wait_for(lambda: node.count_publishers('/again') > 0)
        wait_for(lambda: call('is_paused').success)
        assert came == []
        while not came:  # the first messages are of other topics
            assert call('play_next').success
            executor.spin_once(timeout_sec=0.1)
        assert bytes(came[0]) == sent[0]
        assert call('resume').success
        wait_for(lambda: len(came) == len(sent))
        assert [bytes(raw) for raw in came] == sent
        _, said = player.communicate(timeout=PATIENCE)
        assert player.returncode == 0, said
    finally:
        player.kill()
        node.destroy_node()
        context.try_shutdown()
    assert JOINT_STATES.resolved == '/joint_states'


def test_a_bag_with_nothing_to_play_is_called_empty(tmp_path):
    pytest.importorskip('rclpy', reason='needs ROS 2')
    path = recorded_run.write(tmp_path / 'bag', [])
    command = [sys.executable, '-m', 'blf_dsc_controller', 'replay', str(path), '--play']
    run = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert run.returncode == 1
    assert f'blf_dsc replay: {path} is empty' in run.stderr
    assert 'Traceback' not in run.stderr
