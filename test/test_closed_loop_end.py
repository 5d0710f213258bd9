# SPDX-License-Identifier: Apache-2.0
"""Every way a run can end before its time: what was recorded stays, and no process is left."""

from __future__ import annotations

import os
import signal

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from command import Running, wait_for

from blf_dsc_controller.bags.reader import read_run


@pytest.fixture
def running(tmp_path):
    one = Running(tmp_path / 'out')
    yield one
    one.close()


def whole(bag):
    """Read a bag in which nothing is missing up to its end; return its number of samples."""
    run = read_run(bag)
    assert set(np.diff(run.stamp)) == {1_000_000}
    return run.stamp.size


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_in_order_with_bag_and_report(running, number):
    running.process.send_signal(number)
    code, said, complaints = running.end()
    assert code == 130, complaints
    assert 'Traceback' not in complaints
    running.wait_for_children()
    samples = whole(running.out / 'bag')
    assert f'{samples} samples' in said
    for result in ('summary.json', 'tracking.png', 'bag/metadata.yaml'):
        assert (running.out / result).is_file()


def test_a_node_that_is_killed_ends_the_others_and_is_named(running):
    os.kill(running.child('controller_node'), signal.SIGKILL)
    code, _, complaints = running.end()
    assert code == 1
    assert 'closed_loop: blf_dsc_controller was ended by SIGKILL' in complaints
    assert f'what was recorded until then is in {running.out / "bag"}' in complaints
    assert 'Traceback' not in complaints
    running.wait_for_children()
    assert whole(running.out / 'bag') > 100


def test_no_node_outlives_the_command(running):
    running.process.kill()
    running.process.communicate()
    running.wait_for_children()
    bag = running.out / 'bag'
    wait_for((bag / 'metadata.yaml').exists)
    assert whole(bag) > 100
