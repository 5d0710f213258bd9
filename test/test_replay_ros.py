# SPDX-License-Identifier: Apache-2.0
"""Events between two samples replay bit for bit from the bag of the nodes.

Bags are played.
"""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

import recorded_run
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message
from recorded_run import compared, of
from ros_rig import FakeClock, RosRig, activate, configure, deactivate
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from test_nodes_trajectory import JOINTS, SECOND, send, trajectory

from blf_dsc_controller.bags.content import read_content
from blf_dsc_controller.bags.sources import open_bag
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.messages.codecs import typestore
from blf_dsc_controller.messages.journal import EventType
from blf_dsc_controller.messages.topics import (
    COMMANDS,
    JOINT_STATES,
    ROBOT_DESCRIPTION,
    TRACKING_ERROR,
)
from blf_dsc_controller.nodes.player_node import PlayerNode
from blf_dsc_controller.nodes.process import drain
from blf_dsc_controller.nodes.recorder_node import BagRecorderNode
from blf_dsc_controller.replay.verify import verify

BRISK = {
    'limits__acceleration': [4.0, 4.0],  # rad/s^2, for a trajectory of one second
    'barrier__bound': [0.02, 0.02],  # rad, twenty times what this run needs
}
# no two torques alike
DAMPED = {'safety__torque': 'hold_gravity', 'safety__damping': [2.0, 1.0]}


class Recording:
    """A loop in lock-step and its recorder, all in this process."""

    def __init__(self, path, clock=time.monotonic_ns, **controller):
        self.ros = RosRig()
        self.path = path
        self.recorder = self.ros.add(BagRecorderNode, output=str(path))
        complete = {'wait_for_subscribers': 1}
        waiting = complete | {'autostart': False}
        self.arm, self.law = self.ros.loop(waiting, complete | controller, clock=clock)
        configure(self.ros, self.arm)
        activate(self.ros, self.arm)

    def run(self, samples):
        self.ros.run(self.arm, samples)

    def change(self, name, value):
        (result,) = self.law.set_parameters([Parameter(name, value=value)])
        assert result.successful, result.reason

    def end(self):
        """Stop the plant, let the recorder receive everything, and complete the bag."""
        deactivate(self.ros, self.arm)
        self.ros.until(lambda: self.law.guard.journal.stamp == self.arm.stamp)
        for node in (self.arm, self.law):
            drain(node.publishers)
        self.recorder.close()
        self.ros.close()
        return self.path


def test_trajectories_and_gain_change_replay_where_they_took_effect(tmp_path):
    """The second trajectory begins later; the journal holds both as they were sent."""
    run = Recording(tmp_path / 'bag', **BRISK)
    run.run(200)
    sent = trajectory(JOINTS, np.zeros(2), duration=1.0)
    assert send(run.ros, run.law, sent) == ''
    run.run(300)
    run.change('feedback.gain', [50.0, 25.0])
    run.run(200)
    begin = run.law.guard.reference.last_stamp + SECOND // 4
    later = trajectory(
        JOINTS[::-1], np.array([0.05, -0.1]), duration=0.5, fields=2, stamp=begin
    )
    assert send(run.ros, run.law, later) == ''
    run.run(600)
    result = verify(run.end())
    assert (result.difference, result.remarks) == (None, ())
    assert [event.type for event in result.events].count(EventType.PARAMETERS) == 1
    assert result.samples >= 1300
    assert compared(result)['commands'] == 2 * result.samples
    assert compared(result)['reference'] == 4 * -(-result.samples // 10)
    assert result.motions == 2
    first, second = (each.content for _, each in read_content(run.path).motions)
    assert (tuple(first['joints']), tuple(second['joints'])) == (JOINTS, JOINTS[::-1])
    errors = read_content(run.path).topics[TRACKING_ERROR].joint_states(JOINTS, ())
    assert first['begin'] is None
    assert second['begin'] == (begin - int(errors.stamp[0])) * 1e-9
    for recorded, point in zip(first['points'], sent.points, strict=True):
        np.testing.assert_array_equal(recorded['positions'], point.positions)
        np.testing.assert_array_equal(recorded['accelerations'], point.accelerations)


def test_stops_ramps_and_activations_replay_with_identical_torques(tmp_path):
    """A pause, a stop in which a gain changes, a reset, a stop since no state comes any more."""
    clock = FakeClock()
    run = Recording(tmp_path / 'bag', clock, safety__watchdog='on', **DAMPED)
    run.ros.until(lambda: clock.advance(0.01) or run.arm.is_offered)
    run.run(100)
    deactivate(run.ros, run.law)
    run.run(600)  # past the ramp
    activate(run.ros, run.law)
    run.run(200)
    run.arm.start_stamp += SECOND // 10  # the next state is too late
    run.ros.until(lambda: run.law.guard.supervisor.text)
    run.run(50)
    run.change('safety.damping', [4.0, 3.0])
    run.run(50)
    deactivate(run.ros, run.law)
    run.run(50)
    activate(run.ros, run.law)
    run.run(100)
    run.ros.reset(run.law)
    run.run(100)
    deactivate(run.ros, run.arm)
    clock.advance(0.1)
    run.ros.until(lambda: run.law.guard.supervisor.text)
    silent = run.law.guard.reference.last_stamp
    activate(run.ros, run.arm)
    run.ros.until(lambda: clock.advance(0.01) or run.arm.is_offered)
    run.run(20)
    deactivate(run.ros, run.law)
    activate(run.ros, run.law)  # after a stop, keeping only the estimates
    run.run(50)
    bag = run.end()
    result = verify(bag)
    assert (result.difference, result.remarks) == (None, ())
    assert [event.type for event in result.events].count(EventType.PARAMETERS) == 1
    assert ', '.join(result.transitions) == (
        'activate, deactivate, activate, safe stop (stamp jump), deactivate, activate, reset, '
        'safe stop (state timeout), deactivate, activate'
    )
    errors = read_content(bag).topics[TRACKING_ERROR].joint_states(JOINTS, ())
    used = errors.stamp[np.isfinite(errors.field(0)[:, 0])]
    assert result.samples == used.size
    assert np.count_nonzero(used > silent) >= 30
    torques = len(of(recorded_run.messages(bag), COMMANDS))
    assert compared(result)['commands'] == 2 * torques
    assert compared(result)['tracking_error'] == 6 * errors.size
    assert torques - result.samples >= 600 + 2 * 50


# Playing a bag: its messages byte for byte over ROS, in its time.


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    """200 samples, 1 ms apart, after a URDF."""
    message = typestore().types[ROBOT_DESCRIPTION.type](data='<robot/>')
    raw = bytes(typestore().serialize_cdr(message, ROBOT_DESCRIPTION.type))
    # As the middleware delivers it.
    urdf = (ROBOT_DESCRIPTION, recorded_run.START, raw + bytes(-len(raw) % 4))
    messages = [urdf, *recorded_run.Synthetic(200).messages()]
    return recorded_run.write_made(tmp_path_factory.mktemp('played') / 'bag', messages)


def test_bag_is_played_in_its_time_and_order_byte_for_byte(bag, ros):
    received = {}
    latched = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)

    def listen(type_, name, quality=1000):
        callback = received.setdefault(name, []).append
        ros.tester.create_subscription(type_, name, callback, quality, raw=True)

    listen(JointState, '/joint_states')
    with open_bag(bag) as opened:
        player = PlayerNode(opened, context=ros.context)
        ros.until(player.outputs['/joint_states'].get_subscription_count)
        begin = time.monotonic()
        thread = threading.Thread(target=player.play)
        thread.start()
        ros.until(lambda: not thread.is_alive())
        # never early, however slow the machine
        assert time.monotonic() - begin >= 0.199
        listen(String, '/robot_description', latched)  # late, as RViz is
        sent = [raw for _, _, _, raw in of(recorded_run.messages(bag), JOINT_STATES)]
        ros.until(lambda: len(received['/joint_states']) == len(sent))
        ros.until(lambda: received['/robot_description'])
        player.destroy_node()
    assert [bytes(raw) for raw in received['/joint_states']] == sent
    assert (
        deserialize_message(received['/robot_description'][0], String).data
        == '<robot/>'
    )


def test_bag_is_played_by_command_or_refused_in_one_line(bag, tmp_path, capfd):
    assert main(['replay', str(bag), '--play']) == 0
    out, err = capfd.readouterr()
    assert (out[: len('playing 0.199 s: ')], err) == ('playing 0.199 s: ', '')
    assert '/robot_description' in out
    empty = recorded_run.write(tmp_path / 'bag', [])
    for path, options, message in (
        (bag, ['--map', 'commands=/x'], '--play publishes the bag as it is'),
        (empty, [], f'{empty} is empty'),
    ):
        assert main(['replay', str(path), '--play', *options]) == 1
        out, err = capfd.readouterr()
        assert (out, err.count('\n')) == ('', 1)
        assert err.startswith(f'blf_dsc replay: {message}')
