# SPDX-License-Identifier: Apache-2.0
"""Bags are what rosbag2 would have written, also at their limits, and damaged ones are recovered.

Every intact chunk of a damaged bag is recovered, losses are reported, the bag is
untouched.
"""

from __future__ import annotations

import re
from threading import Event

import pytest
import yaml
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.reader import make_reader
from recorded_run import MILLISECOND, messages_on_disk, raw_records, read
from rosbags.rosbag2 import (
    Reader,
)
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from blf_dsc_controller import BagError
from blf_dsc_controller.bags import writer
from blf_dsc_controller.bags.background_file import BackgroundFile
from blf_dsc_controller.bags.recovery import recover
from blf_dsc_controller.bags.sources import open_bag
from blf_dsc_controller.bags.writer import BagWriter
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.messages.codecs import (
    Float64MultiArrayEncoder,
    JointStateEncoder,
)
from blf_dsc_controller.messages.topics import COMMANDS, JOINT_STATES, STREAM, Quality

START = 1_734_000_000_000_000_000
STATES = JointStateEncoder(['joint1', 'elbow'])
TORQUES = Float64MultiArrayEncoder(2)
HASHES = {  # as `ros2 topic info --verbose` shows them on Jazzy
    JOINT_STATES: 'RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e',
    COMMANDS: 'RIHS01_1025ddc6b9552d191f89ef1a8d2f60f3d373e28b283d8891ddcc974e8c55397f',
}


def message(k):
    return STATES.encode(k, [k, 0], [0, 0], [0, 0])


def write_messages(path, count, per_chunk=0, **options):
    """Write messages of two topics; return the size of the bag."""
    with BagWriter(path, **options) as bag:
        first = bag.add_topic(
            JOINT_STATES.resolved, JOINT_STATES.type, [Quality(depth=100)]
        )
        second = bag.add_topic(COMMANDS.resolved, COMMANDS.type, [Quality(depth=100)])
        for k in range(count):
            stamp = START + k * MILLISECOND
            bag.write(
                first,
                STATES.encode(stamp, [k, -k], [0, 1], [2, 3]),
                stamp,
                stamp - 5,
                k + 1,
            )
            bag.write(second, TORQUES.encode([k, k]), stamp + 1)
            if per_chunk and k % per_chunk == per_chunk - 1:
                bag.flush()
    return sum(file.stat().st_size for file in path.iterdir())


def information(path):
    return yaml.safe_load((path / 'metadata.yaml').read_text())[
        'rosbag2_bagfile_information'
    ]


@pytest.mark.parametrize('compression', ['none', 'zstd'])
def test_other_libraries_read_the_whole_bag_by_its_own_definitions(
    tmp_path, compression
):
    size = write_messages(tmp_path / 'bag', 300, compression=compression)
    # names and counts repeat in each message
    assert (size < 60_000) == (compression == 'zstd')
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
    assert [
        (c.topic, m.log_time, m.publish_time, m.sequence) for _, c, m in found
    ] == in_order
    for schema in {schema.name: schema for schema, _, _ in found}.values():
        assert schema.encoding == 'ros2msg'
        types.register(get_types_from_msg(schema.data.decode(), schema.name))
    channels = {
        (c.topic, c.message_encoding, c.metadata['topic_type_hash'])
        for _, c, _ in found
    }
    assert channels == {
        (topic.resolved, 'cdr', hash_) for topic, hash_ in HASHES.items()
    }
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
        'custom_data': {},
        'ros_distro': 'jazzy',
    }
    found = information(tmp_path / 'run')
    assert found == expected
    assert list(found) == list(expected)  # in rosbag2's order
    with (tmp_path / 'run' / 'run_0.mcap').open('rb') as stream:
        for channel in make_reader(stream).get_summary().channels.values():
            assert yaml.safe_load(channel.metadata['offered_qos_profiles']) == [quality]


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
        # at every phase of the flush interval; one message per millisecond
        if k % 7 == 0:
            assert messages_on_disk(path / 'bag_0.mcap') >= k - 100
    bag.close()
    complete = read(path)
    bag.flush()  # by a timer that fires once more
    bag.close()
    assert read(path) == complete


def test_long_recording_is_in_several_files_that_are_read_as_one(tmp_path, monkeypatch):
    """Every chunk has an entry in the index, which is in memory until its file ends."""
    monkeypatch.setattr(writer, '_MOST_CHUNKS', 1_000)  # 10_000 for users
    with BagWriter(tmp_path / 'bag', flush_interval=0.0) as bag:
        handle = bag.add_topic('/a', JOINT_STATES.type, [STREAM])
        for k in range(4_000):
            bag.write(handle, message(k), k)
    found = information(tmp_path / 'bag')
    assert (found['starting_time'], found['duration']) == (
        {'nanoseconds_since_epoch': 0},
        {'nanoseconds': 3_999},
    )
    files = [(file['starting_time'], file['message_count']) for file in found['files']]
    assert files == [
        ({'nanoseconds_since_epoch': k}, 1_000) for k in range(0, 4_000, 1_000)
    ]
    with open_bag(tmp_path / 'bag' / 'bag_3.mcap') as opened:
        assert len(list(opened.messages({'/a'}))) == 1_000
    expected = [*map(message, range(4_000))]
    assert not recover(tmp_path / 'bag', tmp_path / 'clean').losses
    for name in ('bag', 'clean'):
        with open_bag(tmp_path / name) as opened:
            assert [each.raw for each in opened.messages({'/a'})] == expected


# Recovery.

CHUNKS = 6
PER_CHUNK = 5  # messages of each topic


def write(path, compression='none'):
    """Write a bag of two topics in chunks that are flushed; return its file."""
    options = {'flush_interval': None, 'compression': compression}
    write_messages(path, CHUNKS * PER_CHUNK, PER_CHUNK, **options)
    return path / f'{path.name}_0.mcap'


def chunks(data):
    """Start and end of each chunk of an intact file."""
    return [
        (at, at + len(raw)) for at, raw in raw_records(data) if raw[0] == Opcode.CHUNK
    ]


@pytest.fixture(scope='module', params=['none', 'zstd'])
def whole(request, tmp_path_factory):
    return write(tmp_path_factory.mktemp('whole') / 'bag', request.param)


@pytest.fixture(scope='module')
def plain(tmp_path_factory):
    """An uncompressed file: its content and messages."""
    file = write(tmp_path_factory.mktemp('plain') / 'bag')
    return file.read_bytes(), read(file.parent)


def damaged(folder, data):
    """A bag folder with only this file content, as a killed recorder leaves it."""
    folder.mkdir()
    (folder / 'bag_0.mcap').write_bytes(data)
    return folder


def recovered(folder, data):
    """Recover this file content; return the messages and the losses."""
    clean = folder.with_name(f'{folder.name}_clean')
    losses = recover(damaged(folder, data), clean).losses
    return read(clean), losses


def test_every_intact_chunk_is_recovered_at_any_truncation(plain, tmp_path):
    data, written = plain
    ends = [end for _, end in chunks(data)]
    (closed,) = [
        at + len(raw) for at, raw in raw_records(data) if raw[0] == Opcode.DATA_END
    ]
    for size in sorted({*ends, 1, *range(499, len(data), 499), len(data)}):
        messages, losses = recovered(tmp_path / str(size), data[:size])
        assert messages == written[: 2 * PER_CHUNK * sum(end <= size for end in ends)]
        assert (not losses) == (size >= closed)


@settings(max_examples=60, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_flipped_bytes_lose_nothing_silently(whole, tmp_path_factory, data):
    """Reading fails or returns what was written.

    Recovery loses only the chunks that were hit.
    """
    original = whole.read_bytes()
    written = read(whole.parent)
    places = data.draw(
        st.lists(st.integers(0, len(original) - 1), min_size=1, max_size=4)
    )
    content = bytearray(original)
    for place in places:
        content[place] ^= data.draw(st.integers(1, 255))
    folder = tmp_path_factory.mktemp('flipped')
    found, losses = recovered(folder / 'bag', content)
    assert set(found) <= set(written)
    assert len(found) == len(written) or losses
    # Topics are defined in the first chunk and in the description at the end.
    (first, *_, last) = spans = chunks(original)
    hit = sum(any(at <= place < end for place in places) for at, end in spans)
    defined = not any(
        first[0] <= place < first[1] or place >= last[1] for place in places
    )
    assert len(found) >= 2 * PER_CHUNK * (CHUNKS - hit) or not defined
    try:
        with open_bag(folder / 'bag' / 'bag_0.mcap') as opened:
            found = [message[:3] for message in opened.messages(opened.counts)]
    except BagError:
        return
    assert found == written


@pytest.mark.parametrize(
    ('damage', 'lost', 'words'),
    [
        (
            lambda chunk: chunk[:-9] + bytes([chunk[-9] ^ 0x40]) + chunk[-8:],
            1,
            'at byte {at} (',
        ),
        (lambda _: b'', 1, '5 of 30 messages of /blf_dsc_controller/commands'),
        (
            lambda chunk: 2 * chunk,
            0,
            'at byte {end} (a chunk that the file holds twice), after 17',
        ),
    ],
)
def test_damaged_missing_or_doubled_chunk_is_reported(
    whole, tmp_path, capsys, damage, lost, words
):
    content = whole.read_bytes()
    written = read(whole.parent)
    at, end = chunks(content)[2]
    folder = damaged(
        tmp_path / 'bag', content[:at] + damage(content[at:end]) + content[end:]
    )
    assert main(['recover', str(folder), '--out', str(tmp_path / 'clean')]) == 0
    output = capsys.readouterr().out
    (loss, *missing) = re.findall('LOST bag_0.mcap: (.*)', output)
    assert words.format(at=at, end=end) in ' '.join([loss, *missing])
    assert loss.startswith(f'{end - at} bytes at ') == ('byte' in words)
    assert ('5 of 30 messages of /joint_states' in output) == (lost > 0)
    assert f'/joint_states: {30 - 5 * lost} messages' in output
    assert 'none of the recorded' not in output
    begin = 4 * PER_CHUNK
    assert (
        read(tmp_path / 'clean')
        == written[:begin] + written[begin + 2 * PER_CHUNK * lost :]
    )


def test_compressed_messages_that_cannot_be_unpacked_are_losses(tmp_path, capsys):
    """A recorder may compress each message by itself; some are cut off here.

    All of one topic are, which is no loss of everything.
    """
    whole = zstandard.compress(message(0))
    with BagWriter(tmp_path / 'bag', flush_interval=None) as bag:
        first, second = (bag.add_topic(f, JOINT_STATES.type, [STREAM]) for f in 'ab')
        for k, packed in enumerate((whole, whole[:-3], whole)):
            bag.write(first, packed, k)
        bag.write(second, whole[:-3], 3)
    out = tmp_path / 'clean'
    assert main(['recover', str(tmp_path / 'bag'), '--out', str(out)]) == 0
    output = capsys.readouterr().out
    loss = 'LOST bag_0.mcap: 2 compressed messages that cannot be unpacked'
    assert output.splitlines()[:-1] == ['a: 2 messages', 'b: 0 messages', loss]
    with open_bag(out) as opened:
        assert [each.raw for each in opened.messages({'a'})] == 2 * [message(0)]


class Stuck:
    """A disk that takes nothing until it is told to."""

    def __init__(self, file):
        self._file = file
        self.goes_on = Event()

    def write(self, data):
        self.goes_on.wait(60.0)
        return self._file.write(data[:1000])  # in pieces, as a disk may

    def close(self):
        self._file.close()


def test_a_loop_does_not_wait_for_a_disk_that_does_not_write(tmp_path):
    file = BackgroundFile(tmp_path / 'file', most=5000)
    disk = file._file = Stuck(file._file)
    pieces = [bytes([k]) * 100 * k for k in range(10)]
    for piece in pieces:
        assert file.write(piece) == len(piece)
        file.flush()
    assert file.tell() == 4500
    file.write(bytes(501))
    with pytest.raises(BagError, match='the disk, which is too slow'):
        file.flush()
    file.write(b'nothing is written from now on')
    disk.goes_on.set()
    file.close()
    assert (tmp_path / 'file').read_bytes() == b''.join(pieces)


@pytest.mark.parametrize('in_background', [False, True])
def test_bag_is_the_same_whichever_thread_writes_it(tmp_path, in_background):
    stamps = range(1, 2000)
    with BagWriter(
        tmp_path / 'bag', flush_interval=0.0, in_background=in_background
    ) as bag:
        handle = bag.add_topic('/x', COMMANDS.type, [Quality(1)])
        for stamp in stamps:
            bag.write(handle, TORQUES.encode([stamp, 0]), stamp)
    with (tmp_path / 'bag' / 'bag_0.mcap').open('rb') as file:
        found = [message.log_time for *_, message in make_reader(file).iter_messages()]
    assert found == list(stamps)
