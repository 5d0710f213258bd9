# SPDX-License-Identifier: Apache-2.0
"""The recorder in its own process: full disk, odd types."""

from __future__ import annotations

import signal
import time

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from foreign_readers import read
from recorder_rig import ENCODER, PATIENCE, Rig
from small_disk import small_disk

from blf_dsc_controller.bags.recover import recover

ENCODED = ENCODER.encode(1, [1, 2], [3, 4], [5, 6])[12:]  # after the stamp


@pytest.fixture
def rig():
    instance = Rig()
    yield instance
    instance.close()


def test_full_disk_stops_the_recorder_with_one_error_and_a_whole_bag(rig, tmp_path):
    with small_disk(tmp_path / 'disk', 18) as disk:
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
        assert not recover(disk / 'bag', tmp_path / 'clean').losses


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
