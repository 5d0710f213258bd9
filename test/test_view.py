# SPDX-License-Identifier: Apache-2.0
"""The live view without a browser: what it shows of a loop, where it is served, wrong usage."""

from __future__ import annotations

import os
import pty
import re
import signal
import socket
import subprocess
from subprocess import PIPE
from urllib.request import urlopen

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')
pytest.importorskip('yourdfpy', reason='needs viser: pip install .[view]')

from command import COMMAND, NO_PICTURES
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from ros_rig import activate, cleanup, configure, deactivate, values
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

import blf_dsc_controller as blf
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.messages import topics
from blf_dsc_controller.view.node import ViewNode

HOST = '127.0.0.1'
PORT = 18080
LOG = topics.Topic(
    '', '/rosout', 'rcl_interfaces/msg/Log', topics.STREAM, topics.STREAM
)


def test_port_in_use_is_skipped(ros):
    with socket.create_server((HOST, PORT)):
        view = ros.add(ViewNode, port=PORT)
        ros.until(lambda: view.page)
        assert view.page.server.get_port() != PORT
        view.close()
    with pytest.raises(
        blf.BlfDscError, match=r"served at '192.0.2.1'.*of this computer"
    ):
        ros.add(ViewNode, host='192.0.2.1')


def test_view_of_an_offline_run_is_rejected_before_the_run(tmp_path):
    out = tmp_path / 'run'
    assert main(['run', '--offline', '--view', '--out', str(out)]) == 1
    assert not out.exists()


# Live, of a running loop in lock-step.

WAITING = 'waiting for a controller (/blf_dsc_controller/journal)'
EVENT = {'events.begin': [1.0], 'events.duration': [0.5], 'events.payload': [0.25]}


def events_with(view, word):
    return [event for event in view.page.listed if word in f'{event}']


def assert_reset_is_shown(ros, arm, view):
    before = list(view.past)
    ros.reset(arm)
    ros.until(lambda: events_with(view, 'reset'))
    ros.until(lambda: view.past and view.past[0] is not before[0])
    assert view.past[0].time < before[-1].time  # counted from the new start


def test_page_shows_the_loop_its_events_and_that_its_controller_is_gone(ros):
    view = ros.add(ViewNode, port=18180)
    ros.until(lambda: view.page.shown_state == ('STALE', WAITING))
    arm, law = ros.loop({**EVENT, 'autostart': False})
    ros.until(lambda: view.plant)
    assert configure(ros, arm)
    assert activate(ros, arm)
    ros.until(lambda: view.past and view.past[-1].time > 2.0)
    now = view.past[-1]
    assert np.abs(now.error).max() < 0.002
    assert now.bound == pytest.approx([0.002, 0.002])
    assert now.truth[:3] == pytest.approx([1.0, 0.32, 0.4])
    assert np.isfinite(now.estimate[:3]).all()
    assert view.page.shown_state == ('OK', 'tracking')
    assert [t for t, *_ in events_with(view, '0.25 kg picked up')] == [1.0]
    assert [t for t, *_ in events_with(view, '0.25 kg put down')] == [1.5]

    streamed = ros.publisher(topics.JOINT_POSITIONS)
    ros.until(streamed.get_subscription_count)
    ahead = now.position.copy()
    inputs = law.status.trajectories
    for _ in range(20):
        ahead += 2e-3
        streamed.publish(Float64MultiArray(data=ahead.tolist()))
        ros.until(lambda count=inputs.targets: inputs.targets > count)
        ros.run(arm, 10)
    ros.until(lambda: events_with(view, 'of targets'))
    assert len(events_with(view, 'of targets')) == 1
    assert np.abs(view.past[-1].error).max() < 0.002
    assert view.page.shown_state == ('OK', 'tracking')
    chunk = JointTrajectory(joint_names=['joint1', 'joint2'])
    chunk.points.append(JointTrajectoryPoint(positions=ahead.tolist()))
    chunk.points[0].time_from_start.sec = 1
    inputs.take_trajectory(serialize_message(chunk))
    ros.until(lambda: events_with(view, '1 points'))
    arm.set_parameters([Parameter('load.payload', value=0.5)])
    ros.until(lambda: view.past[-1].loaded)
    assert_reset_is_shown(ros, arm, view)
    ros.kill(law)
    ros.until(
        lambda: (
            view.page.shown_state[0] == 'ERROR' and 'gone' in view.page.shown_state[1]
        )
    )
    view.close()


def test_page_that_is_opened_late_draws_what_it_receives_and_says_from_when(ros):
    """Topics of curves keep no past, and those of events do."""
    arm, _ = ros.loop({**EVENT, 'autostart': False})
    assert configure(ros, arm)
    assert activate(ros, arm)
    ros.run(arm, 3000)
    view = ros.add(ViewNode, port=18380)
    ros.until(lambda: len(view.past) > 3)
    first = view.past[0].time
    assert first >= 3.0
    (noted,) = events_with(view, 'earlier curves are not sent again')
    assert noted[:2] == (first, 'view')
    assert [t for t, *_ in events_with(view, '0.25 kg picked up')] == [1.0]
    view.close()


def test_contact_is_on_the_page_and_in_diagnostics(ros):
    """4 N at 2.5 s, once the arm has been learned."""
    view = ros.add(ViewNode, port=18280)
    said = ros.listen(topics.DIAGNOSTICS)
    log = ros.listen(LOG)

    def contact_statuses():
        found = [each for message in said for each in message.status]
        return [each for each in found if each.name.endswith('/contact')]

    push = {'events.begin': [2.5], 'events.duration': [60.0], 'events.payload': [0.0]}
    force = {'events.force': [4.0, 0.0, 0.0]}
    arm, law = ros.loop(
        {**push, **force, 'autostart': False},
        {'contact.enabled': True, 'learning.window': 1.0},
    )
    ros.until(lambda: view.config)
    assert configure(ros, arm)
    assert activate(ros, arm)
    ros.until(lambda: view.past and view.past[-1].touched)
    now = view.past[-1]
    assert now.felt_at == 0
    assert abs(now.external[0]) > now.interval[0]
    # the loop does not wait for the page: what it showed before the push
    *_, before = (each for each in view.past if 1.5 < each.time < 2.5)
    assert before.felt_at is None
    ros.until(lambda: contact_statuses()[-1].level == DiagnosticStatus.WARN)
    status = contact_statuses()[-1]
    assert 'something touches the arm' in status.message
    assert values(status)['joint'] == 'joint1'
    ros.run(arm, 100)  # it is warned of once, however many samples it lasts
    warned = [each.msg for each in log if each.msg.startswith('something touches')]
    assert len(warned) == 1
    (event,) = events_with(view, "N m on joint 'joint1', and model error")
    assert 2.5 < event[0] < 2.6
    # Once it has ended, all of it can be looked at.
    assert view.page.slider is None
    assert deactivate(ros, law)
    assert cleanup(ros, law)
    ros.until(lambda: view.page.slider)
    assert 'the controller has ended normally' in view.page.shown_state[1]
    assert view.page.slider.max > 2.5
    view.close()


def test_page_replays_a_run_until_the_user_goes_on(tmp_path):
    """With a terminal; the results follow.

    The page is there before the run, however short that is.
    """
    out = tmp_path / 'run'
    words = ('--view', '--mode', 'lockstep', '--duration', '0.5', '--out', str(out))
    ours, theirs = pty.openpty()
    command, env = (*COMMAND, *words), os.environ | NO_PICTURES
    with subprocess.Popen(command, stdout=PIPE, stderr=theirs, env=env) as process:
        os.close(theirs)
        said = b''
        expected = rb'(?s).*open (http://127.0.0.1:\d+)\s.*the run has ended'
        while not (found := re.match(expected, said)):
            try:
                said += os.read(ours, 1000)
            except OSError:  # it has ended, and closed its terminal
                pytest.fail(said.decode())
        address = found[1].decode()
        with urlopen(address) as served:  # noqa: S310 - an address of our own
            assert b'<html' in served.read()
        process.send_signal(signal.SIGINT)
        results = process.communicate()[0]
    os.close(ours)
    assert process.returncode == 0
    assert b'bound       held by every joint' in results
