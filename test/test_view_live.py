# SPDX-License-Identifier: Apache-2.0
"""The live view of a running loop in lock-step."""

from __future__ import annotations

import re
import signal
import subprocess
from subprocess import PIPE, STDOUT
from urllib.error import URLError
from urllib.request import urlopen

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')
pytest.importorskip('yourdfpy', reason='needs viser: pip install blf_dsc_controller[view]')

from command import COMMAND, wait_for
from rclpy.parameter import Parameter
from ros_rig import activate, configure
from sensor_msgs.msg import JointState

from blf_dsc_controller.bags.reader import read_run
from blf_dsc_controller.cli.main import INTERRUPTED
from blf_dsc_controller.view.node import ViewNode

EVENT = {'events.begin': [1.0], 'events.duration': [0.5], 'events.payload': [0.25]}


def events_with(view, word):
    return [event for event in view.page._events if word in f'{event}']


def test_page_shows_the_loop_its_events_and_that_its_controller_is_gone(ros):
    view = ros.add(ViewNode, port=18180)
    ros.until(lambda: view.page._state == ('STALE', 'waiting for /blf_dsc_controller/journal'))
    arm, law = ros.loop({**EVENT, 'autostart': False})
    ros.until(lambda: view._plant)
    assert configure(ros, arm)
    assert activate(ros, arm)
    ros.until(lambda: view.past and view.past[-1].time > 2.0)
    now = view.past[-1]
    assert np.abs(now.error).max() < 0.002
    assert now.bound == pytest.approx([0.002, 0.002])
    assert now.truth[:3] == pytest.approx([1.0, 0.32, 0.4])
    assert np.isfinite(now.estimate[:3]).all()
    assert view.page._state == ('OK', 'tracking')
    assert [t for t, *_ in events_with(view, '0.25 kg picked up')] == [1.0]
    assert [t for t, *_ in events_with(view, '0.25 kg put down')] == [1.5]

    arm.set_parameters([Parameter('load.payload', value=0.5)])
    ros.until(lambda: view.past[-1].loaded)
    arm.set_parameters([Parameter('load.payload', value=0.0)])
    ros.until(lambda: len(events_with(view, 'load.payload')) == 2)
    ros.reset(arm)
    ros.until(lambda: events_with(view, 'reset'))
    ros.until(lambda: 0.1 < view.past[-1].time < 1.0)  # counted from the new start

    ros.kill(law)
    ros.until(lambda: view.page._state[0] == 'ERROR' and 'gone' in view.page._state[1])
    # The arm goes on without it: its last error is no longer shown.
    assert np.isfinite(view.past[-1].error).all()
    states = view.create_publisher(JointState, 'joint_states', 1)
    state = JointState(name=['joint1', 'joint2'], position=[0.1, 0.2])
    state.header.stamp.sec = view._sampled // 10**9 + 2
    ros.until(lambda: states.publish(state) or view.past[-1].position[0] == 0.1)
    assert np.isnan(view.past[-1].error).all()
    view.close()


def test_page_of_a_run_is_served_until_the_run_ends(tmp_path):
    out = tmp_path / 'run'
    command = (*COMMAND, '--view', '--mode', 'lockstep', '--duration', '100000', '--out', str(out))
    with subprocess.Popen(command, stdout=PIPE, stderr=STDOUT, text=True) as process:
        output = ''
        while not (found := re.search(r'open (http://127.0.0.1:\d+)', output)):
            output += process.stdout.readline()
            assert process.poll() is None, output
        wait_for(lambda: 'open http' in (out / 'logs' / 'view.log').read_text())
        with urlopen(found[1]) as page:  # noqa: S310 - an address of our own
            assert b'<html' in page.read()
        process.send_signal(signal.SIGINT)
        output += process.communicate()[0]
    assert process.returncode == INTERRUPTED, output
    run = read_run(out / 'bag')
    assert np.isfinite(run.error[0]).all()  # the recorder was running before the page
    with pytest.raises(URLError):
        urlopen(found[1])  # noqa: S310
