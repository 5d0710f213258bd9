# SPDX-License-Identifier: Apache-2.0
"""Playing a bag: its messages byte for byte over ROS, in its time."""

from __future__ import annotations

import threading
import time

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

import recorded_run
import synthetic_bag
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from synthetic_bag import START, Synthetic

from blf_dsc_controller.bags.sources import open_bag
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.messages.codecs import typestore
from blf_dsc_controller.messages.topics import ROBOT_DESCRIPTION
from blf_dsc_controller.nodes.player_node import PlayerNode


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    """200 samples, 1 ms apart, after a URDF."""
    message = typestore().types[ROBOT_DESCRIPTION.type](data='<robot/>')
    raw = bytes(typestore().serialize_cdr(message, ROBOT_DESCRIPTION.type))
    urdf = (ROBOT_DESCRIPTION, START, raw + bytes(-len(raw) % 4))  # as the middleware delivers it
    path = tmp_path_factory.mktemp('played') / 'bag'
    return synthetic_bag.write(path, [urdf, *Synthetic(200).messages()])


def test_bag_is_played_in_its_time_and_order_byte_for_byte(bag, ros):
    received = {}
    latched = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)

    def listen(type_, name, quality=1000):
        callback = received.setdefault(name, []).append
        ros.tester.create_subscription(type_, name, callback, quality, raw=True)

    listen(JointState, '/joint_states')
    listen(Clock, '/clock')
    with open_bag(bag) as opened:
        chosen = ['joint_states', '/robot_description']
        player = PlayerNode(opened, chosen, clock=True, context=ros.context)
        assert [*player.outputs] == ['/robot_description', '/joint_states']
        ros.until(player.outputs['/joint_states'].get_subscription_count)
        ros.until(lambda: ros.tester.count_publishers('/clock'))
        begin = time.monotonic()
        thread = threading.Thread(target=player.play, args=(0.5,))
        thread.start()
        ros.until(lambda: not thread.is_alive())
        assert time.monotonic() - begin >= 0.199 / 0.5  # never early, however slow the machine
        listen(String, '/robot_description', latched)  # late, as RViz is
        sent = [raw for name, _, _, raw in recorded_run.messages(bag) if name == '/joint_states']
        ros.until(
            lambda: len(received['/joint_states']) == len(sent) and received['/robot_description']
        )
        player.destroy_node()
    assert [bytes(raw) for raw in received['/joint_states']] == sent
    assert deserialize_message(received['/robot_description'][0], String).data == '<robot/>'
    clocks = [deserialize_message(raw, Clock).clock for raw in received['/clock']]
    times = [clock.sec * 10**9 + clock.nanosec for clock in clocks]
    assert len(times) > 1
    assert times == sorted(times)
    assert START <= times[0] < times[-1] <= START + 199_000_000


def test_whole_bag_is_played_by_command(bag, capfd):
    assert main(['replay', str(bag), '--play', '--rate', '0']) == 0
    out, err = capfd.readouterr()
    assert out.startswith('playing 0.199 s: ')
    assert '/robot_description' in out
    assert err == ''


@pytest.mark.parametrize(
    ('options', 'message'),
    [
        (['--rate', 'nan'], '--rate nan: expected a speed, or 0'),
        (['--rate', '-1'], '--rate -1: expected'),
        (['--map', 'commands=/x'], '--play publishes the bag as it is'),
        (['--topics', '/x'], 'the bag has no topic /x; it holds /'),
        ([], 'the bag is empty'),
    ],
)
def test_what_cannot_be_played_is_rejected_in_one_line(bag, tmp_path, capfd, options, message):
    path = bag if options else recorded_run.write(tmp_path / 'bag', [])
    assert main(['replay', str(path), '--play', *options]) == 1
    out, err = capfd.readouterr()
    assert err.startswith(f'blf_dsc replay: {message}')
    assert (out, err.count('\n')) == ('', 1)
