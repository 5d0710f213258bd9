# SPDX-License-Identifier: Apache-2.0
"""The recorder as a process of its own: on a full disk, asked for a ring, asking for parameters."""

from __future__ import annotations

import signal
import time

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from foreign_readers import read
from recorder_rig import ENCODER, PATIENCE, Rig
from small_disk import small_disk
from std_srvs.srv import Trigger

from blf_dsc_controller.bags.context import read_context
from blf_dsc_controller.bags.recover import recover

ENCODED = ENCODER.encode(1, [1, 2], [3, 4], [5, 6])[12:]  # behind the stamp


@pytest.fixture
def rig():
    one = Rig()
    yield one
    one.close()


def test_a_full_disk_ends_it_with_one_clear_error_and_a_whole_bag(rig, tmp_path):
    with small_disk(tmp_path / 'disk', 4) as disk:
        process = rig.record(disk / 'bag')
        deadline = time.monotonic() + PATIENCE
        while process.poll() is None:
            assert time.monotonic() < deadline, 'still recording'
            for _ in range(100):
                rig.publish(0)
            time.sleep(0.005)
        _, said = process.communicate()
        assert process.returncode == 1
        assert said.count('the disk is full') == 1
        assert 'Traceback' not in said
        assert len(read(disk / 'bag')) > 1000
        assert recover(disk / 'bag', tmp_path / 'clean').is_whole


def test_its_ring_is_written_when_it_is_asked_to(rig, tmp_path):
    rig.record(tmp_path / 'bag', ring=0.5)
    client = rig.node.create_client(Trigger, '/bag_recorder/trigger')
    rig.wait_for(client.service_is_ready)
    rig.publish_for(1.5)
    answer = client.call_async(Trigger.Request())
    rig.wait_for(answer.done)
    assert answer.result().success, answer.result().message
    assert answer.result().message.endswith(f'messages into {tmp_path / "bag"}')
    stamps = [at for topic, at, _ in read(tmp_path / 'bag') if topic == '/a']
    assert stamps[-1] - stamps[1] <= 0.5e9  # the first is older: the topic is a latched one
    again = client.call_async(Trigger.Request())
    rig.wait_for(again.done)
    assert (tmp_path / 'bag-2' / 'metadata.yaml').exists()


def test_the_parameters_of_who_publishes_are_in_the_bag(rig, tmp_path):
    process = rig.record(tmp_path / 'bag')
    file = tmp_path / 'bag' / 'bag_0.mcap'
    rig.wait_for(lambda: b'gain: [1.0, 2.0]' in file.read_bytes())
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=PATIENCE)
    context = read_context(tmp_path / 'bag')
    assert '/source:\n  ros__parameters:\n    gain: [1.0, 2.0]\n' in context.configuration
    assert context.facts['messages /a'].startswith('0 written, 0 missed')


def test_parameters_are_read_before_the_first_message_when_they_are_waited_for(rig, tmp_path):
    process = rig.record(tmp_path / 'bag', wait_for_parameters=PATIENCE)
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=PATIENCE)
    assert 'gain: [1.0, 2.0]' in read_context(tmp_path / 'bag').configuration


def test_a_node_that_never_responds_is_recorded_after_the_wait(rig, tmp_path):
    process = rig.start(tmp_path / 'bag', wait_for_parameters=0.3)
    while not rig.publishers[0].get_subscription_count():  # its parameter services are not served
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=PATIENCE)
    assert '/source: its parameters could not be read' in said


def test_names_that_no_ros_package_has_import_nothing_and_end_nothing(rig, tmp_path):
    process = rig.record(tmp_path / 'bag', topics='[a, b, c, d, e]')
    names = {'b': 'unittest::__main__::X', 'c': 'foo::X', 'd': 'unittest::msg::X', 'e': 'X'}
    rig.start_odd(*(f'{topic}={name}' for topic, name in names.items()))
    said = wait_for_lines(process, [f'/{topic} is not recorded: its type' for topic in names])
    assert '/b is not recorded: its type unittest/__main__/X is not installed here' in said
    assert '/c is not recorded: its type foo/X is not installed here' in said
    rig.publish(1)
    rig.start_odd('f=std_msgs::msg::\udce4')  # not UTF-8
    wait_for_lines(process, ['the name of a topic or type is not UTF-8'])
    rig.publish(2)
    rig.wait_for(lambda: (tmp_path / 'bag' / 'bag_0.mcap').read_bytes().count(ENCODED) == 2)
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=PATIENCE)
    assert process.returncode == 0
    assert [topic for topic, _, _ in read(tmp_path / 'bag')] == ['/a', '/a']


def wait_for_lines(process, expected):
    """Read what a recorder says until all of this was said; return it."""
    said = ''
    while not all(text in said for text in expected):
        line = process.stderr.readline()
        assert line, f'it has ended: {said}'
        said += line
    return said
