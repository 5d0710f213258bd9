# SPDX-License-Identifier: Apache-2.0
"""Playing a bag: messages at the right time, and byte for byte over ROS."""

from __future__ import annotations

import subprocess
import sys
import time
from itertools import pairwise

import pytest
import recorded_run
import synthetic_bag
from synthetic_bag import START, Synthetic

from blf_dsc_controller.cli.main import main
from blf_dsc_controller.messages.topics import ROBOT_DESCRIPTION
from blf_dsc_controller.messages.types import typestore
from blf_dsc_controller.nodes.player_node import Timeline

PATIENCE = 300.0  # s, timeout of waits that should take a moment
MEGABYTE = 10**6
COMMAND = [sys.executable, '-m', 'blf_dsc_controller', 'replay']
PLAY_AND_SHOW_PEAK = """
import sys
from blf_dsc_controller.cli.main import main
code = main(['replay', sys.argv[1], '--play', '--rate', '0', '--delay', '0'])
print(open('/proc/self/status').read())
sys.exit(code)
"""


def playing(rate):
    timeline = Timeline(100, rate)
    timeline.resume(1000)
    return timeline


def test_bag_plays_in_real_time():
    timeline = playing(1.0)
    assert timeline.wait(110, 1000) == pytest.approx(10e-9)
    assert timeline.wait(110, 1010) == 0.0
    assert timeline.position(1020) == 120


def test_rate_scales_time_and_zero_means_no_waiting():
    timeline = playing(10.0)
    assert timeline.wait(200, 1002) == pytest.approx(8e-9)
    assert timeline.position(1002) == 120
    fast = playing(0.0)
    assert fast.wait(10**12, 1000) == 0.0
    assert fast.position(2000) == 100


def test_pause_stops_the_timeline():
    timeline = playing(1.0)
    timeline.pause(1005)
    assert timeline.wait(100, 5000) == float('inf')
    timeline.jump(110, 6000)  # a step
    timeline.resume(9000)
    assert timeline.wait(120, 9000) == pytest.approx(10e-9)


def string(text):
    message = typestore().types[ROBOT_DESCRIPTION.type](data=text)
    raw = bytes(typestore().serialize_cdr(message, ROBOT_DESCRIPTION.type))
    return raw + bytes(-len(raw) % 4)  # as the middleware delivers it


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    """200 samples and two URDFs, the second one after 50 samples."""
    messages = list(Synthetic(200).messages())
    urdfs = [(ROBOT_DESCRIPTION, START + k, string(f'<robot {k}/>')) for k in (0, 50_000_000)]
    ordered = sorted([*urdfs, *messages], key=lambda message: message[1])
    return synthetic_bag.write(tmp_path_factory.mktemp('played') / 'bag', ordered)


class Player:
    """A bag player in a separate process, and a node that listens to it."""

    def __init__(self, bag, *options):
        import rclpy

        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node('listener', context=self.context)
        self._executor = rclpy.executors.SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self._process = subprocess.Popen(
            [*COMMAND, str(bag), '--play', '--start-paused', *options],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def listen(self, type_, name, **quality):
        from rclpy.qos import QoSProfile

        received = []
        profile = QoSProfile(depth=1000, **quality)
        self.node.create_subscription(type_, name, received.append, profile, raw=True)
        return received

    def spin(self):
        self._executor.spin_once(timeout_sec=0.02)

    def until(self, condition):
        deadline = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < deadline, 'still waiting'
            self.spin()

    def call(self, name):
        from std_srvs.srv import Trigger

        client = self.node.create_client(Trigger, f'/rosbag2_player/{name}')
        self.until(client.service_is_ready)
        future = client.call_async(Trigger.Request())
        self.until(future.done)
        return future.result()

    def end(self):
        """Wait for the end; return the output and the errors printed."""
        out, err = self._process.communicate(timeout=PATIENCE)
        assert self._process.returncode == 0, err
        return out, err

    def close(self):
        self._process.kill()
        self._process.communicate()
        self.node.destroy_node()
        self.context.try_shutdown()


@pytest.fixture
def play(bag):
    pytest.importorskip('rclpy', reason='needs ROS 2')
    players = []

    def start(*options):
        players.append(Player(bag, *options))
        return players[-1]

    yield start
    for player in players:
        player.close()


def latched():
    from rclpy.qos import DurabilityPolicy

    return {'durability': DurabilityPolicy.TRANSIENT_LOCAL}


def test_bag_is_played_over_ros_byte_for_byte_under_another_name(play, bag):
    from sensor_msgs.msg import JointState
    from std_msgs.msg import String

    sent = [raw for topic, _, _, raw in recorded_run.messages(bag) if topic == '/joint_states']
    player = play('--rate', '0', '--remap', 'joint_states:=again')
    received = player.listen(JointState, '/again')
    player.until(lambda: player.node.count_publishers('/again') > 0)
    player.until(lambda: player.call('is_paused').success)
    assert received == []
    while not received:  # the first messages are of other topics
        assert player.call('play_next').success
        player.spin()
    assert bytes(received[0]) == sent[0]
    # A late subscriber, such as RViz, still receives the URDF.
    urdf = player.listen(String, '/robot_description', **latched())
    player.until(lambda: urdf)
    assert bytes(urdf[0]) == string('<robot 0/>')
    assert player.call('resume').success
    player.until(lambda: len(received) == len(sent))
    assert [bytes(raw) for raw in received] == sent
    out, err = player.end()
    assert f'/rosbag2_player plays 0.199 s of {bag} as fast as possible' in out
    assert '/again' in out.split()
    assert 'ros2 service call /rosbag2_player/resume' in out
    assert err == 'played 0.2/0.199 s\n'


def test_publishers_have_the_recorded_quality_of_service(play):
    from rclpy.qos import DurabilityPolicy

    player = play('--delay', '0')
    expected = {
        '/robot_description': DurabilityPolicy.TRANSIENT_LOCAL,
        '/blf_dsc_controller/bound': DurabilityPolicy.TRANSIENT_LOCAL,
        '/blf_dsc_controller/tracking_error': DurabilityPolicy.VOLATILE,
    }
    for name, durability in expected.items():
        player.until(lambda name=name: player.node.get_publishers_info_by_topic(name))
        (found,) = player.node.get_publishers_info_by_topic(name)
        assert found.qos_profile.durability is durability, name


def test_part_of_a_bag_starts_with_the_messages_latched_before_it(play):
    from sensor_msgs.msg import JointState
    from std_msgs.msg import String

    part = ('--start-offset', '0.1', '--playback-duration', '0.0505')
    player = play(*part, '--topics', 'joint_states', '/robot_description', '--rate', '0.5')
    states = player.listen(JointState, '/joint_states', **latched())
    urdf = player.listen(String, '/robot_description', **latched())
    for name in ('/joint_states', '/robot_description'):
        player.until(lambda name=name: player.node.count_publishers(name) > 0)
    assert player.node.count_publishers('/blf_dsc_controller/bound') == 0
    assert player.call('resume').success
    player.end()
    player.until(lambda: urdf)
    assert [bytes(raw) for raw in urdf] == [string('<robot 50000000/>')]
    player.until(lambda: len(states) == 52)
    from rclpy.serialization import deserialize_message

    stamps = [deserialize_message(raw, JointState).header.stamp.nanosec for raw in states]
    assert stamps[0] == 99 * MEGABYTE  # the last state before the offset
    assert stamps[1:] == [k * MEGABYTE for k in range(100, 151)]
    assert all(before < after for before, after in pairwise(stamps))


def test_large_bag_is_not_loaded_into_memory(tmp_path):
    pytest.importorskip('rclpy', reason='needs ROS 2')
    size = 300
    large = ((ROBOT_DESCRIPTION, START + k, bytes(MEGABYTE)) for k in range(size))
    path = synthetic_bag.write(tmp_path / 'bag', large, lambda _: '/large')
    command = [sys.executable, '-c', PLAY_AND_SHOW_PEAK, str(path)]
    shown = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    # Of this program alone: ru_maxrss starts with that of the parent process.
    peak = int(shown.rsplit('VmHWM:', 1)[1].split()[0])  # KiB
    assert peak * 1024 < size * MEGABYTE


@pytest.mark.parametrize(
    ('options', 'message'),
    [
        (['--rate', 'nan'], '--rate nan: expected a speed from 0.001 to 1e+06, or 0'),
        (['--rate', 'inf'], '--rate inf: expected'),
        (['--rate', '-1'], '--rate -1: expected'),
        (['--delay', 'nan'], '--delay nan: expected a time in seconds, 0 or more'),
        (['--remap', 'foo'], '--remap foo: expected FROM:=TO'),
        (['--remap', 'a:=1b'], '--remap a:=1b: expected FROM:=TO'),
        (['--start-offset', '9'], 'nothing is left after 9 s: the bag lasts 0.199 s'),
        (['--topics', '/x'], 'the bag has no topic /x; it holds /'),
    ],
)
def test_invalid_option_is_rejected_in_one_line(bag, capfd, options, message):
    pytest.importorskip('rclpy', reason='needs ROS 2')
    assert main(['replay', str(bag), '--play', *options]) == 1
    out, err = capfd.readouterr()
    assert err.startswith(f'blf_dsc replay: {message}')
    assert (out, err.count('\n')) == ('', 1)


def test_bag_without_messages_is_reported_as_empty(tmp_path):
    pytest.importorskip('rclpy', reason='needs ROS 2')
    path = recorded_run.write(tmp_path / 'bag', [])
    run = subprocess.run(
        [*COMMAND, str(path), '--play'],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    assert run.returncode == 1
    assert f'blf_dsc replay: {path} is empty' in run.stderr
    assert 'Traceback' not in run.stderr
