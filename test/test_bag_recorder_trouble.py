# SPDX-License-Identifier: Apache-2.0
"""The recorder in its own process: full disk, ring buffer, parameters of nodes, odd types."""

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

ENCODED = ENCODER.encode(1, [1, 2], [3, 4], [5, 6])[12:]  # after the stamp


@pytest.fixture
def rig():
    instance = Rig()
    yield instance
    instance.close()


def test_full_disk_stops_the_recorder_with_one_error_and_a_whole_bag(rig, tmp_path):
    with small_disk(tmp_path / 'disk', 4) as disk:
        process = rig.record(disk / 'bag')
        deadline = time.monotonic() + PATIENCE
        while process.poll() is None:
            assert time.monotonic() < deadline, 'still recording'
            for _ in range(100):
                rig.publish(0)
            time.sleep(0.005)
        _, output = process.communicate()
        assert process.returncode == 1
        assert output.count('the disk is full') == 1
        assert 'Traceback' not in output
        assert len(read(disk / 'bag')) > 1000
        assert recover(disk / 'bag', tmp_path / 'clean').is_whole


def test_ring_is_written_on_a_trigger(rig, tmp_path):
    rig.record(tmp_path / 'bag', ring=0.5)
    client = rig.node.create_client(Trigger, '/bag_recorder/trigger')
    rig.wait_for(client.service_is_ready)
    rig.publish_for(1.5)
    future = client.call_async(Trigger.Request())
    rig.wait_for(future.done)
    assert future.result().success, future.result().message
    assert future.result().message.endswith(f'messages into {tmp_path / "bag"}')
    stamps = [stamp for topic, stamp, _ in read(tmp_path / 'bag') if topic == '/a']
    assert stamps[-1] - stamps[1] <= 0.5e9  # the first is older, as the topic is latched
    again = client.call_async(Trigger.Request())
    rig.wait_for(again.done)
    assert (tmp_path / 'bag-2' / 'metadata.yaml').exists()


def test_parameters_of_publishing_nodes_are_in_the_bag(rig, tmp_path):
    process = rig.record(tmp_path / 'bag')
    file = tmp_path / 'bag' / 'bag_0.mcap'
    rig.wait_for(lambda: b'gain: [1.0, 2.0]' in file.read_bytes())
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=PATIENCE)
    context = read_context(tmp_path / 'bag')
    assert '/source:\n  ros__parameters:\n    gain: [1.0, 2.0]\n' in context.configuration
    assert context.facts['messages /a'].startswith('0 written, 0 missed')


def test_parameters_are_read_before_the_first_message_if_waited_for(rig, tmp_path):
    process = rig.record(tmp_path / 'bag', wait_for_parameters=PATIENCE)
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=PATIENCE)
    assert 'gain: [1.0, 2.0]' in read_context(tmp_path / 'bag').configuration


def test_unresponsive_node_is_recorded_after_the_wait(rig, tmp_path):
    process = rig.start(tmp_path / 'bag', wait_for_parameters=0.3)
    while not rig.publishers[0].get_subscription_count():  # nobody serves its parameters
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    _, output = process.communicate(timeout=PATIENCE)
    assert '/source: its parameters could not be read' in output


def test_unknown_message_packages_are_not_imported_and_do_not_stop_the_recorder(rig, tmp_path):
    process = rig.record(tmp_path / 'bag', topics='[a, b, c, d, e]')
    names = {'b': 'unittest::__main__::X', 'c': 'foo::X', 'd': 'unittest::msg::X', 'e': 'X'}
    rig.start_odd(*(f'{topic}={name}' for topic, name in names.items()))
    output = wait_for_lines(process, [f'/{topic} is not recorded: its type' for topic in names])
    assert '/b is not recorded: its type unittest/__main__/X is not installed here' in output
    assert '/c is not recorded: its type foo/X is not installed here' in output
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
    """Read the output of a recorder until it has all expected texts; return it."""
    output = ''
    while not all(text in output for text in expected):
        line = process.stderr.readline()
        assert line, f'it has ended: {output}'
        output += line
    return output
