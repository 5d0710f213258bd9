# SPDX-License-Identifier: Apache-2.0
"""Every intact chunk of a damaged bag is recovered, losses are reported, the bag is untouched."""

from __future__ import annotations

import os
from io import BytesIO

import pytest
from foreign_readers import raw_records, read
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.reader import make_reader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer

from blf_dsc_controller.bags.recover import recover
from blf_dsc_controller.bags.sources import BagError, open_bag
from blf_dsc_controller.bags.writer import BagWriter
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.messages.codecs import (
    Float64MultiArrayEncoder,
    JointStateEncoder,
    typestore,
)
from blf_dsc_controller.messages.topics import COMMANDS, JOINT_STATES

EXAMPLES = int(os.environ.get('BLF_DSC_EXAMPLES', '60'))
START = 1_734_000_000_000_000_000
MILLISECOND = 1_000_000
CHUNKS = 6
PER_CHUNK = 5  # messages of each topic
ALL = 2 * PER_CHUNK * CHUNKS


def write(path, compression='none'):
    """Write a bag of two topics in chunks that are flushed; return its file."""
    states, torques = JointStateEncoder(['joint1']), Float64MultiArrayEncoder(1)
    with BagWriter(path, flush_interval=None, compression=compression) as bag:
        bag.note({'arm': 'left'})
        first = bag.add_topic(JOINT_STATES.resolved, JOINT_STATES.type, [JOINT_STATES.offered])
        second = bag.add_topic(COMMANDS.resolved, COMMANDS.type, [COMMANDS.offered])
        for k in range(CHUNKS * PER_CHUNK):
            stamp = START + k * MILLISECOND
            bag.write(first, states.encode(stamp, [k], [0], [0]), stamp, stamp - 7, k + 1)
            bag.write(second, torques.encode([k]), stamp + 1, stamp, k + 1)
            if k % PER_CHUNK == PER_CHUNK - 1:
                bag.flush()
    return path / f'{path.name}_0.mcap'


def chunks(data):
    """Start and end of each chunk of an intact file."""
    indexes = make_reader(BytesIO(data)).get_summary().chunk_indexes
    return [
        (index.chunk_start_offset, index.chunk_start_offset + index.chunk_length)
        for index in indexes
    ]


@pytest.fixture(scope='module', params=['none', 'zstd'])
def whole(request, tmp_path_factory):
    return write(tmp_path_factory.mktemp('whole') / 'bag', request.param)


@pytest.fixture(scope='module')
def plain(tmp_path_factory):
    return write(tmp_path_factory.mktemp('plain') / 'bag')


def damaged(folder, data):
    """A bag folder with only this file content, as a killed recorder leaves it."""
    folder.mkdir()
    (folder / 'bag_0.mcap').write_bytes(data)
    return folder


def test_every_intact_chunk_is_recovered_at_any_truncation(plain, tmp_path):
    data, all_messages = plain.read_bytes(), read(plain.parent)
    ends = [end for _, end in chunks(data)]
    (closed,) = [at + len(raw) for at, raw in raw_records(data) if raw[0] == Opcode.DATA_END]
    for size in sorted({*ends, *range(0, len(data), 499), len(data)}):
        expected = 2 * PER_CHUNK * sum(end <= size for end in ends)
        clean = tmp_path / f'{size}_clean'
        recovery = recover(damaged(tmp_path / str(size), data[:size]), clean)
        assert sum(recovery.messages.values()) == expected
        assert read(clean) == all_messages[:expected]
        assert (not recovery.losses) == (size >= closed)


@settings(max_examples=EXAMPLES, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_flipped_bytes_lose_nothing_silently(whole, tmp_path_factory, data):
    """Reading fails or returns what was written; recovery loses only the chunks that were hit."""
    original = whole.read_bytes()
    places = data.draw(st.lists(st.integers(0, len(original) - 1), min_size=1, max_size=4))
    content = bytearray(original)
    for place in places:
        content[place] ^= data.draw(st.integers(1, 255))
    folder = tmp_path_factory.mktemp('flipped')
    bag, written = damaged(folder / 'bag', content), read(whole.parent)
    try:
        with open_bag(bag / 'bag_0.mcap') as opened:
            found = [message[:3] for message in opened.messages(opened.counts)]
    except BagError:
        pass
    else:
        assert found == written
    recovery = recover(bag, folder / 'clean')
    recovered = read(folder / 'clean')
    assert set(recovered) <= set(written)
    assert len(recovered) == len(written) or recovery.losses
    # Topics are defined in the first chunk and in the description at the end.
    (first, *_, last) = spans = chunks(original)
    hit = sum(any(at <= place < end for place in places) for at, end in spans)
    defined = not any(first[0] <= place < first[1] or place >= last[1] for place in places)
    assert len(recovered) >= 2 * PER_CHUNK * (CHUNKS - hit) or not defined


def test_every_flipped_head_of_a_record_is_noticed(plain, tmp_path):
    """A chunk may look like another record, or the end; no later chunk is lost with it."""
    original = plain.read_bytes()
    last = chunks(original)[-1][1]
    for at, _ in raw_records(original):
        for place in range(at, at + 9 if at < last else at):
            content = bytearray(original)
            content[place] ^= 1 << place % 8
            bag = damaged(tmp_path / f'{place}', content)
            recovery = recover(bag, tmp_path / f'{place}_clean')
            assert sum(recovery.messages.values()) >= ALL - 2 * PER_CHUNK
            assert sum(recovery.messages.values()) == ALL or recovery.losses


def test_corrupted_chunk_is_skipped_and_its_messages_are_counted(whole, tmp_path, capsys):
    content = bytearray(whole.read_bytes())
    at, end = chunks(content)[2]
    content[(at + end) // 2] ^= 0x40
    folder = damaged(tmp_path / 'bag', content)
    assert main(['recover', str(folder), '--out', str(tmp_path / 'clean')]) == 0
    output = capsys.readouterr().out
    assert f'bag_0.mcap: {end - at} bytes at byte {at} (' in output
    assert 'after 1734000000.009000 s' in output
    assert 'LOST bag_0.mcap: 5 of 30 messages of /joint_states' in output
    assert '/joint_states: 25 messages' in output
    assert 'none of the recorded' not in output
    start, stop = START + 10 * MILLISECOND, START + 14 * MILLISECOND + 1
    assert read(tmp_path / 'clean') == [m for m in read(whole.parent) if not start <= m[1] <= stop]


@pytest.mark.parametrize('times', [0, 2])
def test_missing_or_doubled_chunk_is_reported(plain, tmp_path, times):
    content, expected = plain.read_bytes(), read(plain.parent)
    at, end = chunks(content)[3]
    content = content[:at] + times * content[at:end] + content[end:]
    recovery = recover(damaged(tmp_path / 'bag', content), tmp_path / 'clean')
    if times:
        (loss,) = recovery.losses
        assert f'{end - at} bytes at byte {end} (a chunk that the file holds twice)' in loss
    else:
        assert recovery.losses[-1].endswith('5 of 30 messages of /blf_dsc_controller/commands')
        expected = expected[: 6 * PER_CHUNK] + expected[8 * PER_CHUNK :]
    assert read(tmp_path / 'clean') == expected


def test_recording_that_was_not_closed_is_reported_and_keeps_its_topics(plain, tmp_path, capsys):
    content = plain.read_bytes()[: chunks(plain.read_bytes())[-1][0]]
    folder = damaged(tmp_path / 'bag', content)
    assert main(['recover', str(folder)]) == 0
    output, clean = capsys.readouterr().out, tmp_path / 'bag_recovered'
    assert 'bag_0.mcap: the recording was not closed; it ends at 1734000000.024000 s' in output
    assert f'wrote {clean}' in output
    with open_bag(clean) as opened:
        assert list(opened.messages(())) == []
    assert (opened.facts['arm'], opened.facts['recovered_from']) == ('left', str(folder))
    with Reader(clean) as reader, Reader(plain.parent) as before:
        for found, original in zip(reader.connections, before.connections, strict=True):
            assert found.topic == original.topic
            assert found.digest == original.digest
            assert found.ext.offered_qos_profiles == original.ext.offered_qos_profiles


def test_files_of_a_split_bag_are_recovered_together(plain, tmp_path):
    for name in ('bag_0.mcap', 'bag_1.mcap'):
        folder = damaged(tmp_path / name, plain.read_bytes())
        (folder / 'bag_1.mcap').write_bytes(plain.read_bytes())
        (folder / 'bag_10.mcap').write_bytes(plain.read_bytes())
        (folder / name).write_bytes(b'')
        recovery = recover(folder, tmp_path / f'{name}_clean')
        assert sum(recovery.messages.values()) == 2 * ALL
        (loss,) = recovery.losses
        assert loss.startswith(f'{name}: the recording was not closed; nothing in it could be read')


@pytest.mark.parametrize('mode', [CompressionMode.NONE, CompressionMode.MESSAGE])
def test_bag_from_rosbags_writer_is_recovered(tmp_path, mode):
    writer = Writer(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection('/x', COMMANDS.type, typestore=typestore())
        for k in range(100):
            writer.write(connection, START + k, Float64MultiArrayEncoder(1).encode([k]))
    expected = read(tmp_path / 'bag')
    (file,) = (tmp_path / 'bag').glob('*.mcap')
    recover(damaged(tmp_path / 'cut', file.read_bytes()[:-1]), tmp_path / 'clean')
    assert read(tmp_path / 'clean') == expected


def test_nothing_to_recover_is_an_exit_code(plain, tmp_path, capsys):
    for k, data in enumerate([b'', plain.read_bytes()[: chunks(plain.read_bytes())[0][0]]]):
        assert main(['recover', str(damaged(tmp_path / f'{k}', data))]) == 1
        assert 'ALL LOST' in capsys.readouterr().out
