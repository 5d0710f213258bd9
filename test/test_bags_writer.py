# SPDX-License-Identifier: Apache-2.0
"""Bags are what rosbag2 would have written, also at their limits: full disks, splits, kills."""

from __future__ import annotations

import itertools
import json
import subprocess
import sys
import tracemalloc

import pytest
import yaml
from foreign_readers import messages_on_disk, read
from mcap.reader import make_reader
from small_disk import small_disk

from blf_dsc_controller import __version__
from blf_dsc_controller.bags.recover import recover
from blf_dsc_controller.bags.sources import BagError, open_bag
from blf_dsc_controller.bags.writer import BagWriter, DiskFullError, Losses
from blf_dsc_controller.messages.codecs import (
    Definition,
    Float64MultiArrayEncoder,
    JointStateEncoder,
    UnknownTypeError,
)
from blf_dsc_controller.messages.topics import BOUND, COMMANDS, JOINT_STATES, STREAM, Quality

START = 1_734_000_000_000_000_000
MILLISECOND = 1_000_000
STATES = JointStateEncoder(['joint1', 'elbow'])
TORQUES = Float64MultiArrayEncoder(2)
HASHES = {  # as `ros2 topic info --verbose` shows them on Jazzy
    JOINT_STATES: 'RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e',
    COMMANDS: 'RIHS01_1025ddc6b9552d191f89ef1a8d2f60f3d373e28b283d8891ddcc974e8c55397f',
}

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
    found['schemas'] = len(reader.get_summary().schemas)
    for schema, channel, message in reader.iter_messages(log_time_order=False):
        found['mcap'].append([channel.topic, message.log_time, message.publish_time])
        found['texts'][schema.name] = schema.data.decode()
        found['hashes'][channel.topic] = channel.metadata['topic_type_hash']
        found['encodings'] = [schema.encoding, channel.message_encoding]
for name, text in found['texts'].items():
    types.register(get_types_from_msg(text, name))
with Reader(folder) as reader:
    found['counts'] = {c.topic: c.msgcount for c in reader.connections}
    for connection, timestamp, raw in reader.messages():
        found['rosbags'].append([connection.topic, timestamp])
        if connection.topic == '/joint_states':
            message = types.deserialize_cdr(raw, connection.msgtype)
            stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            found['decoded'].append([stamp, *message.name, *message.position])
assert not [name for name in sys.modules if name.startswith('blf_dsc')]
print(json.dumps(found))
"""
"""Reads a bag with public libraries only and prints its contents."""


def message(k):
    return STATES.encode(k, [k, 0], [0, 0], [0, 0])


def write_messages(path, count=50, **options):
    with BagWriter(path, **options) as bag:
        first = bag.add_topic(JOINT_STATES.resolved, JOINT_STATES.type, [Quality(depth=100)])
        second = bag.add_topic(COMMANDS.resolved, COMMANDS.type, [Quality(depth=100)])
        for k in range(count):
            stamp = START + k * MILLISECOND
            bag.write(first, STATES.encode(stamp, [k, -k], [0, 1], [2, 3]), stamp, stamp - 5)
            bag.write(second, TORQUES.encode([k, k]), stamp + 1)
    return sum(file.stat().st_size for file in path.iterdir())


def write_endlessly(bag, handle, times):
    for k in itertools.count():
        bag.write(handle, message(k) * times, k)


def read_with_public_libraries(path):
    run = subprocess.run(
        [sys.executable, '-c', READER, str(path)], capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout)


def test_other_libraries_read_the_whole_bag(tmp_path):
    stamps = [START + k * MILLISECOND for k in range(300)]
    in_order = [
        entry
        for stamp in stamps
        for entry in (['/joint_states', stamp, stamp - 5], [COMMANDS.resolved, *[stamp + 1] * 2])
    ]
    plain, packed = (
        write_messages(tmp_path / compression, 300, compression=compression)
        for compression in ('none', 'zstd')
    )
    assert packed < plain / 2  # both topics repeat their names and counts in each message
    for compression in ('none', 'zstd'):
        found = read_with_public_libraries(tmp_path / compression)
        assert found['mcap'] == in_order
        assert found['rosbags'] == [entry[:2] for entry in in_order]
        assert found['decoded'] == [
            [stamp, 'joint1', 'elbow', k, -k] for k, stamp in enumerate(stamps)
        ]
        assert found['counts'] == {'/joint_states': 300, COMMANDS.resolved: 300}
        assert found['hashes'] == {topic.resolved: hash_ for topic, hash_ in HASHES.items()}
        assert (found['profile'], found['encodings']) == ('ros2', ['ros2msg', 'cdr'])


def test_metadata_matches_rosbag2(tmp_path):
    write_messages(tmp_path / 'run', 3)
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
    period = {
        'starting_time': {'nanoseconds_since_epoch': START},
        'duration': {'nanoseconds': 2 * MILLISECOND + 1},
    }
    topics = [
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
        for topic, hash_ in HASHES.items()
    ]
    information = {
        'version': 9,
        'storage_identifier': 'mcap',
        'duration': period['duration'],
        'starting_time': period['starting_time'],
        'message_count': 6,
        'topics_with_message_count': topics,
        'compression_format': '',
        'compression_mode': '',
        'relative_file_paths': ['run_0.mcap'],
        'files': [{'path': 'run_0.mcap', **period, 'message_count': 6}],
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


def test_topics_are_described_as_offered(tmp_path):
    """A topic of two publishers, types that are unknown or given, two of the same type."""
    with BagWriter(tmp_path / 'bag') as bag:
        unknown = Quality(depth=0, history='unknown')
        bag.add_topic(BOUND.resolved, BOUND.type, [BOUND.offered, unknown])
        with pytest.raises(UnknownTypeError, match='nowhere_msgs/msg/Nothing'):
            bag.add_topic('/nothing', 'nowhere_msgs/msg/Nothing', [])
        given = bag.add_topic('/x', 'my_msgs/msg/X', [], Definition('int32 a\n', 'RIHS01_5'))
        bag.write(given, b'\0\1\0\0\7\0\0\0', START)
        bag.write(bag.add_topic('/a', JOINT_STATES.type, []), message(0), START)
    tree = yaml.safe_load((tmp_path / 'bag' / 'metadata.yaml').read_text())
    topic, *_ = tree['rosbag2_bagfile_information']['topics_with_message_count']
    offered = topic['topic_metadata']['offered_qos_profiles']
    assert [(each['durability'], each['history']) for each in offered] == [
        ('transient_local', 'keep_last'), ('volatile', 'unknown')
    ]  # fmt: skip
    found = read_with_public_libraries(tmp_path / 'bag')
    assert found['counts'] == {BOUND.resolved: 0, '/x': 1, '/a': 1}
    assert (found['texts']['my_msgs/msg/X'], found['hashes']['/x']) == ('int32 a\n', 'RIHS01_5')
    assert found['schemas'] == 2


def test_empty_bag_is_valid_and_an_existing_folder_is_left_alone(tmp_path):
    BagWriter(tmp_path / 'bag').close()
    assert read_with_public_libraries(tmp_path / 'bag')['counts'] == {}
    tree = yaml.safe_load((tmp_path / 'bag' / 'metadata.yaml').read_text())
    files = tree['rosbag2_bagfile_information']['files']
    assert files[0]['duration'] == {'nanoseconds': 0}  # rosbag2 reads it as unsigned
    before = {path.name: path.read_bytes() for path in (tmp_path / 'bag').iterdir()}
    with pytest.raises(BagError, match=r'bag exists already.*choose another folder'):
        BagWriter(tmp_path / 'bag')
    assert {path.name: path.read_bytes() for path in (tmp_path / 'bag').iterdir()} == before


def test_data_is_flushed_periodically(tmp_path):
    now = 0.0
    bag = BagWriter(tmp_path / 'bag', flush_interval=0.1, clock=lambda: now)
    handle = bag.add_topic('/command', COMMANDS.type, [COMMANDS.offered])
    for k in range(1, 1001):
        now = k * 1e-3
        bag.write(handle, TORQUES.encode([1, 2]), START + k)
        if k % 7 == 0:  # at every phase of the flush interval; one message per millisecond
            assert messages_on_disk(tmp_path / 'bag' / 'bag_0.mcap') >= k - 100
    bag.close()


KILLED = """
import os, signal, sys
from blf_dsc_controller.messages.topics import COMMANDS
from blf_dsc_controller.bags.writer import BagWriter

bag = BagWriter(sys.argv[1], flush_interval=None, compression='zstd')
handle = bag.add_topic('/command', COMMANDS.type, [COMMANDS.offered])
for k in range(1000):
    bag.write(handle, bytes(36), k)
bag.flush()
for k in range(10):
    bag.write(handle, bytes(36), k)
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_flushed_data_survives_a_kill(tmp_path):
    run = subprocess.run([sys.executable, '-c', KILLED, str(tmp_path / 'bag')], check=False)
    assert run.returncode == -9
    assert messages_on_disk(tmp_path / 'bag' / 'bag_0.mcap') == 1000


@pytest.mark.parametrize('compression', ['none', 'zstd'])
@pytest.mark.parametrize('interval', [0.0, None])  # a chunk for each message; chunks of 1 MiB
def test_full_disk_leaves_a_whole_bag_and_one_error(tmp_path, compression, interval):
    with small_disk(tmp_path / 'disk', 18) as disk:
        bag = BagWriter(disk / 'bag', compression=compression, flush_interval=interval)
        handle = bag.add_topic('/a', JOINT_STATES.type, [STREAM])
        with pytest.raises(DiskFullError, match='the disk is full') as caught:
            write_endlessly(bag, handle, 8 if interval is None else 1)
        bag.close()
        written = caught.value.messages
        assert written == bag.message_counts['/a']  # including the one that filled the disk
        assert f'{written} messages' in str(caught.value)
        assert len(read(disk / 'bag')) == written
        assert not recover(disk / 'bag', tmp_path / 'clean').losses
        assert not list((disk / 'bag').glob('.*'))
    with small_disk(tmp_path / 'tiny', 1) as disk, pytest.raises(OSError, match='No space left'):
        BagWriter(disk / 'bag')


def test_memory_of_a_recorder_is_bounded_and_its_files_are_read_as_one(tmp_path):
    """Every chunk has an entry in the index, which is in memory until its file ends."""
    with BagWriter(tmp_path / 'bag', flush_interval=0.0) as bag:
        handle = bag.add_topic('/a', JOINT_STATES.type, [STREAM])
        peaks = []
        tracemalloc.start()
        for k in range(60_000):
            bag.write(handle, message(k), k)
            if k % 10_000 == 9_999:
                peaks.append(tracemalloc.get_traced_memory()[1])
                tracemalloc.reset_peak()
        tracemalloc.stop()
    assert len(list((tmp_path / 'bag').glob('*.mcap'))) == 6
    assert max(peaks) < 1.1 * peaks[1]
    expected = [*map(message, range(60_000))]
    with open_bag(tmp_path / 'bag') as opened:
        assert [each.raw for each in opened.messages({'/a'})] == expected
    assert not recover(tmp_path / 'bag', tmp_path / 'clean').losses
    assert [raw for *_, raw in read(tmp_path / 'clean')] == expected


def test_gaps_in_sequence_numbers_are_counted_as_losses():
    losses = Losses(publishers=1)
    for sequence in (4, 5, 8, 9, 2, 3):  # the 2 is from a new publisher
        losses.count(sequence)
    assert losses.text() == ', 2 missed, 4 sent before the recorder connected'
    losses.publishers_seen(2)
    losses.count(100)
    assert losses.text() == ''
