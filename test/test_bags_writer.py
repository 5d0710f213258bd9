# SPDX-License-Identifier: Apache-2.0
"""Bags are what rosbag2 would have written, also at their limits: full disks, splits, kills."""

from __future__ import annotations

import tracemalloc

import pytest
import yaml
from foreign_readers import messages_on_disk, read
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from blf_dsc_controller import __version__
from blf_dsc_controller.bags.recover import recover
from blf_dsc_controller.bags.sources import BagError, open_bag
from blf_dsc_controller.bags.writer import BagWriter, Losses
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


def message(k):
    return STATES.encode(k, [k, 0], [0, 0], [0, 0])


def write_messages(path, count, **options):
    with BagWriter(path, **options) as bag:
        first = bag.add_topic(JOINT_STATES.resolved, JOINT_STATES.type, [Quality(depth=100)])
        second = bag.add_topic(COMMANDS.resolved, COMMANDS.type, [Quality(depth=100)])
        for k in range(count):
            stamp = START + k * MILLISECOND
            bag.write(first, STATES.encode(stamp, [k, -k], [0, 1], [2, 3]), stamp, stamp - 5, k + 1)
            bag.write(second, TORQUES.encode([k, k]), stamp + 1)
    return sum(file.stat().st_size for file in path.iterdir())


def information(path):
    return yaml.safe_load((path / 'metadata.yaml').read_text())['rosbag2_bagfile_information']


@pytest.mark.parametrize('compression', ['none', 'zstd'])
def test_other_libraries_read_the_whole_bag_by_its_own_definitions(tmp_path, compression):
    size = write_messages(tmp_path / 'bag', 300, compression=compression)
    assert (size < 60_000) == (compression == 'zstd')  # names and counts repeat in each message
    stamps = [START + k * MILLISECOND for k in range(300)]
    in_order = [
        entry
        for k, stamp in enumerate(stamps)
        for entry in (
            ('/joint_states', stamp, stamp - 5, k + 1),
            (COMMANDS.resolved, stamp + 1, stamp + 1, 0),
        )
    ]
    types = get_typestore(Stores.EMPTY)
    with (tmp_path / 'bag' / 'bag_0.mcap').open('rb') as stream:
        reader = make_reader(stream)
        found = list(reader.iter_messages(log_time_order=False))
        assert reader.get_header().profile == 'ros2'
    assert [(c.topic, m.log_time, m.publish_time, m.sequence) for _, c, m in found] == in_order
    for schema in {schema.name: schema for schema, _, _ in found}.values():
        assert schema.encoding == 'ros2msg'
        types.register(get_types_from_msg(schema.data.decode(), schema.name))
    channels = {(c.topic, c.message_encoding, c.metadata['topic_type_hash']) for _, c, _ in found}
    assert channels == {(topic.resolved, 'cdr', hash_) for topic, hash_ in HASHES.items()}
    with Reader(tmp_path / 'bag') as bag:
        assert [c.msgcount for c in bag.connections] == [300, 300]
        messages = list(bag.messages())
    assert [(c.topic, at) for c, at, _ in messages] == [entry[:2] for entry in in_order]
    for k, (connection, _, raw) in enumerate(messages[::2]):
        state = types.deserialize_cdr(raw, connection.msgtype)
        assert state.header.stamp.sec * 10**9 + state.header.stamp.nanosec == stamps[k]
        assert (state.name, state.position.tolist()) == (['joint1', 'elbow'], [k, -k])


QUALITY = """
history: keep_last
depth: 100
reliability: reliable
durability: volatile
deadline: {sec: 9223372036, nsec: 854775807}
lifespan: {sec: 9223372036, nsec: 854775807}
liveliness: automatic
liveliness_lease_duration: {sec: 9223372036, nsec: 854775807}
avoid_ros_namespace_conventions: false
"""


def test_metadata_matches_rosbag2(tmp_path):
    write_messages(tmp_path / 'run', 3)
    quality = yaml.safe_load(QUALITY)
    period = {
        'duration': {'nanoseconds': 2 * MILLISECOND + 1},
        'starting_time': {'nanoseconds_since_epoch': START},
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
    expected = {
        'version': 9,
        'storage_identifier': 'mcap',
        **period,
        'message_count': 6,
        'topics_with_message_count': topics,
        'compression_format': '',
        'compression_mode': '',
        'relative_file_paths': ['run_0.mcap'],
        'files': [{'path': 'run_0.mcap', **period, 'message_count': 6}],
        'custom_data': {'package_version': __version__},
        'ros_distro': 'jazzy',
    }
    found = information(tmp_path / 'run')
    assert found == expected
    assert list(found) == list(expected)  # in rosbag2's order
    with (tmp_path / 'run' / 'run_0.mcap').open('rb') as stream:
        for channel in make_reader(stream).get_summary().channels.values():
            assert yaml.safe_load(channel.metadata['offered_qos_profiles']) == [quality]


def test_topics_are_described_as_offered(tmp_path):
    """A topic of two publishers, types that are unknown or given, two of the same type."""
    with BagWriter(tmp_path / 'bag') as bag:
        bag.add_topic(BOUND.resolved, BOUND.type, [BOUND.offered, Quality(0, history='unknown')])
        with pytest.raises(UnknownTypeError, match='nowhere_msgs/msg/Nothing'):
            bag.add_topic('/nothing', 'nowhere_msgs/msg/Nothing', [])
        given = bag.add_topic('/x', 'my_msgs/msg/X', [], Definition('int32 a\n', 'RIHS01_5'))
        bag.write(given, b'\0\1\0\0\7\0\0\0', START)
        bag.write(bag.add_topic('/a', JOINT_STATES.type, []), message(0), START)
    with Reader(tmp_path / 'bag') as reader:
        bound, own, states = reader.connections
    assert [each.msgcount for each in (bound, own, states)] == [0, 1, 1]
    offered = [(qos.durability.name, qos.history.name) for qos in bound.ext.offered_qos_profiles]
    assert offered == [('TRANSIENT_LOCAL', 'KEEP_LAST'), ('VOLATILE', 'UNKNOWN')]
    assert (own.msgdef.data, own.digest) == ('int32 a\n', 'RIHS01_5')
    assert bound.msgdef == states.msgdef


def test_empty_bag_is_valid_and_an_existing_folder_is_left_alone(tmp_path):
    BagWriter(tmp_path / 'bag').close()
    assert read(tmp_path / 'bag') == []
    (file,) = information(tmp_path / 'bag')['files']
    assert file['duration'] == {'nanoseconds': 0}  # rosbag2 reads it as unsigned
    before = {path.name: path.read_bytes() for path in (tmp_path / 'bag').iterdir()}
    with pytest.raises(BagError, match=r'bag exists already.*choose another folder'):
        BagWriter(tmp_path / 'bag')
    assert {path.name: path.read_bytes() for path in (tmp_path / 'bag').iterdir()} == before


@pytest.mark.parametrize('compression', ['none', 'zstd'])
def test_data_is_flushed_periodically(tmp_path, compression, monkeypatch):
    """What another process sees on the disk survives a kill of this one."""
    now, path = 0.0, tmp_path / 'bag'
    monkeypatch.setattr('blf_dsc_controller.bags.writer.monotonic', lambda: now)
    bag = BagWriter(path, flush_interval=0.1, compression=compression)
    handle = bag.add_topic('/command', COMMANDS.type, [COMMANDS.offered])
    for k in range(1, 1001):
        now = k * 1e-3
        bag.write(handle, TORQUES.encode([1, 2]), START + k)
        if k % 7 == 0:  # at every phase of the flush interval; one message per millisecond
            assert messages_on_disk(path / 'bag_0.mcap') >= k - 100
    bag.close()
    complete = read(path)
    bag.flush()  # by a timer that fires once more
    bag.close()
    assert read(path) == complete


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
    assert max(peaks) < 1.1 * peaks[1]
    found = information(tmp_path / 'bag')
    assert (found['starting_time'], found['duration']) == (
        {'nanoseconds_since_epoch': 0},
        {'nanoseconds': 59_999},
    )
    files = [(file['starting_time'], file['message_count']) for file in found['files']]
    assert files == [({'nanoseconds_since_epoch': k}, 10_000) for k in range(0, 60_000, 10_000)]
    expected = [*map(message, range(60_000))]
    assert not recover(tmp_path / 'bag', tmp_path / 'clean').losses
    for name in ('bag', 'clean'):
        with open_bag(tmp_path / name) as opened:
            assert [each.raw for each in opened.messages({'/a'})] == expected


def test_gaps_in_sequence_numbers_are_counted_as_losses():
    losses = Losses(publishers=1)
    for sequence in (4, 5, 8, 9, 2, 3):  # the 2 is from a new publisher
        losses.count(sequence)
    assert losses.text() == ', 2 missed, 4 sent before the recorder connected'
    losses.publishers_seen(2)
    losses.count(100)
    assert losses.text() == ''
