# SPDX-License-Identifier: Apache-2.0
"""Bags are what rosbag2 would have written, and third-party software reads them."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
import yaml
from foreign_readers import messages_on_disk
from mcap.reader import make_reader

from blf_dsc_controller import __version__
from blf_dsc_controller.bags.sources import BagError
from blf_dsc_controller.bags.writer import BagWriter
from blf_dsc_controller.messages.codecs import Float64MultiArrayEncoder, JointStateEncoder
from blf_dsc_controller.messages.topics import BOUND, COMMANDS, JOINT_STATES, Quality
from blf_dsc_controller.messages.types import Definition, UnknownTypeError

START = 1_734_000_000_000_000_000
MILLISECOND = 1_000_000

# Reads a bag with public libraries only and prints its contents.
READER = """
import json, sys
from pathlib import Path
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore, get_types_from_msg

folder = Path(sys.argv[1])
types = get_typestore(Stores.EMPTY)
found = {'mcap': [], 'rosbags': [], 'texts': {}, 'hashes': {}, 'decoded': []}
with next(folder.glob('*.mcap')).open('rb') as stream:
    reader = make_reader(stream)
    found['profile'] = reader.get_header().profile
    for schema, channel, message in reader.iter_messages(log_time_order=False):
        found['mcap'].append([channel.topic, message.log_time, message.publish_time])
        found['texts'][schema.name] = schema.data.decode()
        found['hashes'][channel.topic] = channel.metadata['topic_type_hash']
        found['encodings'] = [schema.encoding, channel.message_encoding]
for name, text in found['texts'].items():
    types.register(get_types_from_msg(text, name))
with Reader(folder) as reader:
    found['counts'] = {c.topic: c.msgcount for c in reader.connections}
    found['types'] = {c.topic: c.msgtype for c in reader.connections}
    for connection, timestamp, raw in reader.messages():
        found['rosbags'].append([connection.topic, timestamp])
        message = types.deserialize_cdr(raw, connection.msgtype)
        if connection.topic == '/joint_states':
            stamp = message.header.stamp
            found['decoded'].append(
                [stamp.sec * 10**9 + stamp.nanosec, *message.name, *message.position]
            )
assert not [name for name in sys.modules if name.startswith('blf_dsc')]
print(json.dumps(found))
"""


def write_messages(path, count=50, **options):
    states = JointStateEncoder(['joint1', 'elbow'])
    torques = Float64MultiArrayEncoder(2)
    with BagWriter(path, **options) as bag:
        first = bag.add_topic(JOINT_STATES.resolved, JOINT_STATES.type, [Quality(depth=100)])
        second = bag.add_topic(COMMANDS.resolved, COMMANDS.type, [Quality(depth=100)])
        for k in range(count):
            stamp = START + k * MILLISECOND
            bag.write(first, states.encode(stamp, [k, -k], [0, 1], [2, 3]), stamp, stamp - 5)
            bag.write(second, torques.encode([k, k]), stamp + 1)


def read_with_public_libraries(path):
    run = subprocess.run(
        [sys.executable, '-c', READER, str(path)], capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout)


@pytest.mark.parametrize('compression', ['none', 'zstd'])
def test_other_libraries_read_the_whole_bag(tmp_path, compression):
    write_messages(tmp_path / 'bag', count=300, compression=compression)
    found = read_with_public_libraries(tmp_path / 'bag')

    stamps = [START + k * MILLISECOND for k in range(300)]
    in_order = [
        entry
        for stamp in stamps
        for entry in (['/joint_states', stamp, stamp - 5], [COMMANDS.resolved, *[stamp + 1] * 2])
    ]
    assert found['mcap'] == in_order
    assert found['rosbags'] == [entry[:2] for entry in in_order]
    assert found['decoded'] == [[stamp, 'joint1', 'elbow', k, -k] for k, stamp in enumerate(stamps)]
    assert found['counts'] == {'/joint_states': 300, COMMANDS.resolved: 300}
    assert found['types'] == {
        '/joint_states': 'sensor_msgs/msg/JointState',
        COMMANDS.resolved: 'std_msgs/msg/Float64MultiArray',
    }
    assert found['profile'] == 'ros2'
    assert found['encodings'] == ['ros2msg', 'cdr']


def test_compression_makes_the_bag_smaller(tmp_path):
    sizes = {}
    for compression in ('none', 'zstd'):
        write_messages(tmp_path / compression, count=300, compression=compression)
        sizes[compression] = (tmp_path / compression / f'{compression}_0.mcap').stat().st_size
    # Half: both topics repeat their names and counts in each message.
    assert sizes['zstd'] < sizes['none'] / 2


def test_metadata_matches_rosbag2(tmp_path):
    write_messages(tmp_path / 'run', count=3)
    with BagWriter(tmp_path / 'other') as bag:
        bag.add_topic(
            BOUND.resolved, BOUND.type, [BOUND.offered, Quality(depth=0, history='unknown')]
        )
    tree = yaml.safe_load((tmp_path / 'run' / 'metadata.yaml').read_text())
    forever = {'sec': 9223372036, 'nsec': 854775807}
    quality = {
        'history': 'keep_last',
        'depth': 100,
        'reliability': 'reliable',
        'durability': 'volatile',
        'deadline': forever,
        'lifespan': forever,
        'liveliness': 'automatic',
        'liveliness_lease_duration': forever,
        'avoid_ros_namespace_conventions': False,
    }
    information = {
        'version': 9,
        'storage_identifier': 'mcap',
        'duration': {'nanoseconds': 2 * MILLISECOND + 1},
        'starting_time': {'nanoseconds_since_epoch': START},
        'message_count': 6,
        'topics_with_message_count': [
            {
                'topic_metadata': {
                    'name': topic.resolved,
                    'type': topic.type,
                    'serialization_format': 'cdr',
                    'offered_qos_profiles': [quality],
                    'type_description_hash': hash_,
                },
                'message_count': 3,
            }
            for topic, hash_ in (
                # As `ros2 topic info --verbose` shows them on Jazzy.
                (
                    JOINT_STATES,
                    'RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e',
                ),
                (
                    COMMANDS,
                    'RIHS01_1025ddc6b9552d191f89ef1a8d2f60f3d373e28b283d8891ddcc974e8c55397f',
                ),
            )
        ],
        'compression_format': '',
        'compression_mode': '',
        'relative_file_paths': ['run_0.mcap'],
        'files': [
            {
                'path': 'run_0.mcap',
                'starting_time': {'nanoseconds_since_epoch': START},
                'duration': {'nanoseconds': 2 * MILLISECOND + 1},
                'message_count': 6,
            }
        ],
        'custom_data': {'package_version': __version__},
        'ros_distro': 'jazzy',
    }
    assert tree == {'rosbag2_bagfile_information': information}
    assert list(tree['rosbag2_bagfile_information']) == list(information)  # in rosbag2's order

    with (tmp_path / 'run' / 'run_0.mcap').open('rb') as stream:
        reader = make_reader(stream)
        record = list(reader.iter_metadata())[-1]
        channels = reader.get_summary().channels.values()
    assert record.name == 'rosbag2'
    assert yaml.safe_load(record.metadata['serialized_metadata']) == information
    for channel in channels:
        assert yaml.safe_load(channel.metadata['offered_qos_profiles']) == [quality]

    tree = yaml.safe_load((tmp_path / 'other' / 'metadata.yaml').read_text())
    (topic,) = tree['rosbag2_bagfile_information']['topics_with_message_count']
    offered = topic['topic_metadata']['offered_qos_profiles']
    assert [profile['durability'] for profile in offered] == ['transient_local', 'volatile']
    assert [profile['history'] for profile in offered] == ['keep_last', 'unknown']
    assert topic['message_count'] == 0


def test_existing_folder_is_rejected_and_left_alone(tmp_path):
    (tmp_path / 'bag').mkdir()
    (tmp_path / 'bag' / 'precious').write_text('kept')
    with pytest.raises(BagError, match=r'bag exists already.*choose another folder'):
        BagWriter(tmp_path / 'bag')
    assert [entry.name for entry in (tmp_path / 'bag').iterdir()] == ['precious']


def test_unknown_type_is_reported_and_recording_continues(tmp_path):
    with BagWriter(tmp_path / 'bag') as bag:
        with pytest.raises(UnknownTypeError, match='nowhere_msgs/msg/Nothing'):
            bag.add_topic('/nothing', 'nowhere_msgs/msg/Nothing', [])
        known = bag.add_topic('/command', COMMANDS.type, [COMMANDS.offered])
        bag.write(known, Float64MultiArrayEncoder(1).encode([1]), START)
    assert read_with_public_libraries(tmp_path / 'bag')['counts'] == {'/command': 1}


def test_given_definition_and_hash_are_stored(tmp_path):
    with BagWriter(tmp_path / 'bag') as bag:
        handle = bag.add_topic('/x', 'my_msgs/msg/X', [], Definition('int32 a\n', 'RIHS01_5'))
        bag.write(handle, b'\0\1\0\0\7\0\0\0', START)
    found = read_with_public_libraries(tmp_path / 'bag')
    assert found['texts'] == {'my_msgs/msg/X': 'int32 a\n'}
    assert found['hashes'] == {'/x': 'RIHS01_5'}


def test_data_is_flushed_periodically(tmp_path):
    now = 0.0
    bag = BagWriter(tmp_path / 'bag', flush_interval=0.1, clock=lambda: now)
    handle = bag.add_topic('/command', COMMANDS.type, [COMMANDS.offered])
    raw = Float64MultiArrayEncoder(2).encode([1, 2])
    for k in range(1, 1001):
        now = k * 1e-3
        bag.write(handle, raw, START + k)
        if k % 7 == 0:  # at every phase of the flush interval
            on_disk = messages_on_disk(tmp_path / 'bag' / 'bag_0.mcap')
            assert on_disk >= k - 100  # at one message per millisecond
    bag.close()


KILLED = """
import os, signal, sys
from blf_dsc_controller.messages.topics import COMMANDS
from blf_dsc_controller.bags.writer import BagWriter

bag = BagWriter(sys.argv[1], flush_interval=None, compression=sys.argv[2])
handle = bag.add_topic('/command', COMMANDS.type, [COMMANDS.offered])
for k in range(1000):
    bag.write(handle, bytes(36), k)
bag.flush()
for k in range(10):
    bag.write(handle, bytes(36), k)
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize('compression', ['none', 'zstd'])
def test_flushed_data_survives_a_kill(tmp_path, compression):
    run = subprocess.run(
        [sys.executable, '-c', KILLED, str(tmp_path / 'bag'), compression], check=False
    )
    assert run.returncode == -9
    assert messages_on_disk(tmp_path / 'bag' / 'bag_0.mcap') == 1000


def test_empty_bag_is_valid(tmp_path):
    BagWriter(tmp_path / 'bag').close()
    assert read_with_public_libraries(tmp_path / 'bag')['counts'] == {}
    information = yaml.safe_load((tmp_path / 'bag' / 'metadata.yaml').read_text())
    information = information['rosbag2_bagfile_information']
    assert information['duration'] == {'nanoseconds': 0}  # rosbag2 reads it as unsigned
    assert information['files'][0]['duration'] == {'nanoseconds': 0}


def test_topics_of_the_same_type_share_one_definition(tmp_path):
    with BagWriter(tmp_path / 'bag') as bag:
        for topic in ('/a', '/b'):
            handle = bag.add_topic(topic, JOINT_STATES.type, [JOINT_STATES.offered])
            bag.write(handle, JointStateEncoder(['x']).encode(0, [0], [0], [0]), START)
    with (tmp_path / 'bag' / 'bag_0.mcap').open('rb') as stream:
        summary = make_reader(stream).get_summary()
    assert len(summary.schemas) == 1
    assert len(summary.channels) == 2
