# SPDX-License-Identifier: Apache-2.0
"""Every intact chunk of a damaged bag is recovered, losses are reported, the bag is untouched."""

from __future__ import annotations

import os

import pytest
from foreign_readers import raw_records, read
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
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
        first, second = (
            bag.add_topic(topic.resolved, topic.type, [topic.offered])
            for topic in (JOINT_STATES, COMMANDS)
        )
        for k in range(CHUNKS * PER_CHUNK):
            stamp = START + k * MILLISECOND
            bag.write(first, states.encode(stamp, [k], [0], [0]), stamp, stamp - 7, k + 1)
            bag.write(second, torques.encode([k]), stamp + 1, stamp, k + 1)
            if k % PER_CHUNK == PER_CHUNK - 1:
                bag.flush()
    return path / f'{path.name}_0.mcap'


def chunks(data):
    """Start and end of each chunk of an intact file."""
    return [(at, at + len(raw)) for at, raw in raw_records(data) if raw[0] == Opcode.CHUNK]


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
    (closed,) = [at + len(raw) for at, raw in raw_records(data) if raw[0] == Opcode.DATA_END]
    for size in sorted({*ends, *range(0, len(data), 499), len(data)}):
        messages, losses = recovered(tmp_path / str(size), data[:size])
        assert messages == written[: 2 * PER_CHUNK * sum(end <= size for end in ends)]
        assert (not losses) == (size >= closed)


@settings(max_examples=EXAMPLES, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_flipped_bytes_lose_nothing_silently(whole, tmp_path_factory, data):
    """Reading fails or returns what was written; recovery loses only the chunks that were hit."""
    original, written = whole.read_bytes(), read(whole.parent)
    places = data.draw(st.lists(st.integers(0, len(original) - 1), min_size=1, max_size=4))
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
    defined = not any(first[0] <= place < first[1] or place >= last[1] for place in places)
    assert len(found) >= 2 * PER_CHUNK * (CHUNKS - hit) or not defined
    try:
        with open_bag(folder / 'bag' / 'bag_0.mcap') as opened:
            found = [message[:3] for message in opened.messages(opened.counts)]
    except BagError:
        return
    assert found == written


def test_every_flipped_head_of_a_record_is_noticed(plain, tmp_path):
    """A chunk may look like another record, or the end; no later chunk is lost with it."""
    original, _ = plain
    last = chunks(original)[-1][1]
    for at, _ in raw_records(original):
        for place in range(at, at + 9 if at < last else at):
            content = bytearray(original)
            content[place] ^= 1 << place % 8
            messages, losses = recovered(tmp_path / f'{place}', content)
            assert len(messages) >= ALL - 2 * PER_CHUNK
            assert len(messages) == ALL or losses


def test_topics_are_not_taken_from_a_damaged_description(plain, tmp_path):
    """One flipped byte there would file messages under another name."""
    content, written = bytearray(plain[0]), plain[1]
    (at, end), *_, (_, last) = chunks(content)
    content[(at + end) // 2] ^= 0x40  # where the topics are defined, too
    kept = written[2 * PER_CHUNK :]
    assert recovered(tmp_path / 'first', content)[0] == kept
    name = content.index(b'/joint_states', last) + 1
    content[name] ^= 1
    messages, losses = recovered(tmp_path / 'both', content)
    assert messages == []
    assert any(f'{len(kept)} messages of topics whose name or' in loss for loss in losses)


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
    written = read(whole.parent)
    lost = slice(4 * PER_CHUNK, 6 * PER_CHUNK)
    assert read(tmp_path / 'clean') == [m for m in written if m not in written[lost]]


@pytest.mark.parametrize('times', [0, 2])
def test_missing_or_doubled_chunk_is_reported(plain, tmp_path, times):
    content, expected = plain
    at, end = chunks(content)[3]
    content = content[:at] + times * content[at:end] + content[end:]
    messages, losses = recovered(tmp_path / 'bag', content)
    if times:
        (loss,) = losses
        assert f'{end - at} bytes at byte {end} (a chunk that the file holds twice)' in loss
    else:
        assert losses[-1].endswith('5 of 30 messages of /blf_dsc_controller/commands')
        expected = expected[: 6 * PER_CHUNK] + expected[8 * PER_CHUNK :]
    assert messages == expected


def test_recording_that_was_not_closed_is_reported_and_keeps_its_topics(whole, tmp_path, capsys):
    content = whole.read_bytes()
    folder = damaged(tmp_path / 'bag', content[: chunks(content)[-1][0]])
    assert main(['recover', str(folder)]) == 0
    output, clean = capsys.readouterr().out, tmp_path / 'bag_recovered'
    assert 'bag_0.mcap: the recording was not closed; it ends at 1734000000.024000 s' in output
    assert f'wrote {clean}' in output
    with open_bag(clean) as opened:
        assert list(opened.messages(())) == []
    assert (opened.facts['arm'], opened.facts['recovered_from']) == ('left', str(folder))
    with Reader(clean) as reader, Reader(whole.parent) as before:
        for found, original in zip(reader.connections, before.connections, strict=True):
            assert (found.topic, found.digest) == (original.topic, original.digest)
            assert found.ext.offered_qos_profiles == original.ext.offered_qos_profiles


def test_files_of_a_split_bag_are_recovered_together(plain, tmp_path):
    for name in ('bag_0.mcap', 'bag_1.mcap'):
        folder = damaged(tmp_path / name, plain[0])
        (folder / 'bag_1.mcap').write_bytes(plain[0])
        (folder / 'bag_10.mcap').write_bytes(plain[0])
        (folder / name).write_bytes(b'')
        messages, (loss,) = recover(folder, tmp_path / f'{name}_clean')
        assert sum(messages.values()) == 2 * ALL
        assert loss.startswith(f'{name}: the recording was not closed; nothing in it could be read')


@pytest.mark.parametrize('mode', [CompressionMode.NONE, CompressionMode.MESSAGE])
def test_bag_from_rosbags_writer_is_recovered(tmp_path, mode):
    writer = Writer(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection('/x', COMMANDS.type, typestore=typestore())
        for k in range(100):
            writer.write(connection, START + k, Float64MultiArrayEncoder(1).encode([k]))
    (file,) = (tmp_path / 'bag').glob('*.mcap')
    messages, _ = recovered(tmp_path / 'cut', file.read_bytes()[:-1])
    assert messages == read(tmp_path / 'bag')


def test_nothing_to_recover_is_an_exit_code(plain, tmp_path, capsys):
    for k, data in enumerate([b'', plain[0][: chunks(plain[0])[0][0]]]):
        assert main(['recover', str(damaged(tmp_path / f'{k}', data))]) == 1
        assert 'ALL LOST' in capsys.readouterr().out
