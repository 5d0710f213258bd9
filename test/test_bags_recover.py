# SPDX-License-Identifier: Apache-2.0
"""Every intact chunk of a damaged bag is recovered, losses are reported, the bag is untouched."""

from __future__ import annotations

import hashlib
import os
from contextlib import suppress
from io import BytesIO
from pathlib import Path

import pytest
from foreign_readers import read
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader, StoragePlugin, Writer

from blf_dsc_controller.bags.context import read_context
from blf_dsc_controller.bags.mcap_reader import MalformedRecordError, read_messages, scan
from blf_dsc_controller.bags.recover import recover
from blf_dsc_controller.bags.salvage import Salvage
from blf_dsc_controller.bags.sources import BagError
from blf_dsc_controller.bags.writer import BagWriter
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.messages.codecs import Float64MultiArrayEncoder, JointStateEncoder
from blf_dsc_controller.messages.topics import COMMANDS, JOINT_STATES
from blf_dsc_controller.messages.types import typestore

EXAMPLES = int(os.environ.get('BLF_DSC_EXAMPLES', '60'))
START = 1_734_000_000_000_000_000
MILLISECOND = 1_000_000
CHUNKS = 6
PER_CHUNK = 5  # messages of each topic
CONFIGURATION = '/blf_dsc_controller:\n  ros__parameters:\n    law: "blf_dsc"\n'


def write(path, compression='none', ends=range(PER_CHUNK - 1, CHUNKS * PER_CHUNK, PER_CHUNK)):
    """Write a bag of two topics with chunks that end after the messages `ends`, each flushed."""
    states, torques = JointStateEncoder(['joint1']), Float64MultiArrayEncoder(1)
    with BagWriter(path, flush_interval=None, compression=compression) as bag:
        bag.configure(CONFIGURATION, 17)
        first = bag.add_topic(JOINT_STATES.resolved, JOINT_STATES.type, [JOINT_STATES.offered])
        second = bag.add_topic(COMMANDS.resolved, COMMANDS.type, [COMMANDS.offered])
        for k in range(CHUNKS * PER_CHUNK):
            stamp = START + k * MILLISECOND
            bag.write(first, states.encode(stamp, [k], [0], [0]), stamp, stamp - 7, k + 1)
            bag.write(second, torques.encode([k]), stamp + 1, stamp, k + 1)
            if k in ends:
                bag.flush()
    return path / f'{path.name}_0.mcap'


def chunks(data):
    """Start, end and index entry of each chunk of an intact file."""
    indexes = make_reader(BytesIO(data)).get_summary().chunk_indexes
    starts = [index.chunk_start_offset for index in indexes]
    return [(at, at + index.chunk_length, index) for at, index in zip(starts, indexes, strict=True)]


def indexed(path):
    """Number of messages found through the index of a recovered bag."""
    (file,) = path.glob('*.mcap')
    with file.open('rb') as stream:
        return sum(1 for _ in make_reader(stream).iter_messages())


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
    data = plain.read_bytes()
    ends = [end for _, end, _ in chunks(data)]
    all_messages = read(plain.parent)
    # Reading is quick enough for every length; writing thousands of bags would take minutes.
    for size in range(len(data) + 1):
        expected = 2 * PER_CHUNK * sum(end <= size for end in ends)
        salvage = Salvage(plain)
        assert sum(1 for _ in salvage.messages(data[:size])) == expected
        if size not in (*ends, *range(0, len(data), 499)):
            continue
        recovery = recover(damaged(tmp_path / str(size), data[:size]), tmp_path / f'{size}_clean')
        assert sum(recovery.messages.values()) == expected
        assert read(recovery.path) == all_messages[:expected]
        assert indexed(recovery.path) == expected
        assert recovery.is_whole == salvage.is_complete


@settings(max_examples=EXAMPLES, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_flipped_bytes_lose_only_the_chunks_they_hit(whole, tmp_path_factory, data):
    # Flip some bytes anywhere: only what was written is recovered, and no other chunk is lost.
    original = whole.read_bytes()
    places = data.draw(st.lists(st.integers(0, len(original) - 1), min_size=1, max_size=4))
    content = bytearray(original)
    for place in places:
        content[place] ^= data.draw(st.integers(1, 255))
    folder = tmp_path_factory.mktemp('flipped')
    recovery = recover(damaged(folder / 'bag', content), folder / 'clean')
    written = set(read(whole.parent))
    assert set(read(recovery.path)) <= written
    # Schemas and channels are in the first chunk and again after the last one; if both are hit,
    # a message has no topic, and is only counted.
    (first, *_, last) = chunks(original)
    defined = not any(first[0] <= place < first[1] for place in places)
    found = sum(recovery.messages.values())
    if not defined and any(place >= last[1] for place in places):
        found += recovery.unknown
    # A hit on a chunk loses that chunk alone; a hit on the records in between may hide one more.
    hit = sum(any(at <= place < end for place in places) for at, end, _ in chunks(original))
    outside = sum(not any(a <= place < e for a, e, _ in chunks(original)) for place in places)
    assert found >= 2 * PER_CHUNK * (CHUNKS - hit - outside)


@pytest.mark.parametrize('at_last', [0, 1])
@pytest.mark.parametrize('before', ['magic', 'metadata'])
def test_index_names_the_topics_if_every_earlier_copy_is_lost(plain, tmp_path, before, at_last):
    # What is hit: the magic or the metadata before the chunks, the first chunk, and the type or the
    # length of the last one.
    original = plain.read_bytes()
    (first, *_, last) = chunks(original)
    metadata = [piece.at for piece in scan(original) if piece.opcode == Opcode.METADATA]
    places = [0] if before == 'magic' else [at + 1 for at in metadata if at < first[0]]
    content = bytearray(original)
    for place in (*places, first[0] + 900, last[0] + at_last):
        content[place] ^= 1
    recovery = recover(damaged(tmp_path / 'bag', content), tmp_path / 'clean')
    assert list(recovery.messages.values()) == 2 * [PER_CHUNK * (CHUNKS - 2)]


def test_lost_messages_are_not_counted_by_the_index_of_the_next_chunk(tmp_path):
    original = write(tmp_path / 'whole', ends=(4, 7, 29)).read_bytes()
    _, (second, _, _), (third, _, _) = chunks(original)
    content = bytearray(original)
    content[second + 500] ^= 1
    content[third] ^= 1
    recovery = recover(damaged(tmp_path / 'bag', content), tmp_path / 'clean')
    counted, uncounted = (list(loss.messages.values()) for loss in recovery.losses)
    assert (counted, uncounted) == ([3, 3], [])


def test_damaged_chunk_header_loses_at_most_that_chunk(whole, tmp_path):
    original = whole.read_bytes()
    _, (at, _, _), *_ = chunks(original)
    for place in range(at, at + 60):
        content = bytearray(original)
        content[place] ^= 128
        folder = tmp_path / str(place)
        folder.mkdir()
        recovery = recover(damaged(folder / 'bag', content), folder / 'clean')
        assert sum(recovery.messages.values()) >= 2 * PER_CHUNK * (CHUNKS - 1)


def test_topic_is_never_recovered_under_a_damaged_name(plain, tmp_path):
    """MCAP has no checksum for a topic's name outside the chunks, where it is repeated."""
    original = plain.read_bytes()
    inside = [range(at, end) for at, end, _ in chunks(original)]
    name = COMMANDS.resolved.encode()
    named = [at for at in range(len(original)) if original.startswith(name, at)]
    places = [at for at in named if not any(at in chunk for chunk in inside)]
    first, _, second = places  # a record of its own, the metadata of the bag, the index
    written = set(read(plain.parent))
    for k, damage in enumerate([[first], [second], [first, second]]):
        content = bytearray(original)
        for at in (inside[0].start + 100, *damage):
            content[at] ^= 1
        recovery = recover(damaged(tmp_path / f'bag{k}', content), tmp_path / f'clean{k}')
        assert set(read(recovery.path)) <= written
        found = 2 if len(damage) == 1 else 1
        assert len(recovery.messages) == found
        assert recovery.unknown == (2 - found) * PER_CHUNK * (CHUNKS - 1)


def test_corrupted_chunk_is_skipped_and_reported_with_times_and_message_counts(whole, tmp_path):
    content = bytearray(whole.read_bytes())
    at, end, chunk = chunks(content)[2]
    content[(at + end) // 2] ^= 0x40
    recovery = recover(damaged(tmp_path / 'bag', content), tmp_path / 'clean')
    (loss,) = recovery.losses
    start, stop = START + 10 * MILLISECOND, START + 14 * MILLISECOND + 1
    assert (chunk.message_start_time, chunk.message_end_time) == (start, stop)
    assert (loss.start, loss.end) == (start, stop)
    assert loss.messages == {JOINT_STATES.resolved: PER_CHUNK, COMMANDS.resolved: PER_CHUNK}
    missed = {topic: missing.missed for topic, missing in recovery.missing.items()}
    assert missed == {JOINT_STATES.resolved: PER_CHUNK, COMMANDS.resolved: PER_CHUNK}
    remaining = [m for m in read(whole.parent) if not start <= m[1] <= stop]
    assert read(recovery.path) == remaining
    assert 'from 1734000000.010000000 s (2024-12-12 10:40:00 UTC)' in str(loss)
    assert 'messages lost: 5 of /joint_states' in str(loss)


def test_topics_are_known_without_the_first_chunk(plain, tmp_path):
    # Even of a recording that was killed, which has no index at the end.
    content = bytearray(plain.read_bytes())
    (first, *_, last) = chunks(content)
    content[(first[0] + first[1]) // 2] ^= 1
    recovery = recover(damaged(tmp_path / 'bag', content[: last[1]]), tmp_path / 'clean')
    assert recovery.unknown == 0
    assert read(recovery.path) == read(plain.parent)[2 * PER_CHUNK :]


def test_context_of_the_run_is_kept(plain, tmp_path):
    content = plain.read_bytes()[: chunks(plain.read_bytes())[3][1]]
    recovery = recover(damaged(tmp_path / 'bag', content), tmp_path / 'clean')
    context = read_context(recovery.path)
    assert context.configurations == ((17, CONFIGURATION),)
    assert context.facts['law'] == 'blf_dsc'
    assert context.facts['recovered_from'] == str(tmp_path / 'bag')
    with Reader(recovery.path) as reader, Reader(plain.parent) as before:
        for clean, original in zip(reader.connections, before.connections, strict=True):
            assert clean.topic == original.topic
            assert clean.digest == original.digest
            assert clean.ext.offered_qos_profiles == original.ext.offered_qos_profiles


def test_damaged_bag_is_not_modified(plain, tmp_path):
    folder = damaged(tmp_path / 'bag', plain.read_bytes()[:-2000])
    digest = hashlib.sha256((folder / 'bag_0.mcap').read_bytes()).hexdigest()
    recover(folder, tmp_path / 'clean')
    assert [file.name for file in folder.iterdir()] == ['bag_0.mcap']
    assert hashlib.sha256((folder / 'bag_0.mcap').read_bytes()).hexdigest() == digest
    with pytest.raises(BagError):
        recover(folder, tmp_path / 'clean')


def test_intact_bag_has_no_losses(whole, tmp_path, capsys):
    recovery = recover(whole.parent, tmp_path / 'clean')
    assert recovery.is_whole
    assert read(recovery.path) == read(whole.parent)
    assert main(['recover', str(whole.parent), '--out', str(tmp_path / 'again')]) == 0
    assert 'none of the recorded messages was lost' in capsys.readouterr().out


def test_recovered_bag_records_lost_messages(tmp_path, capsys):
    with BagWriter(tmp_path / 'bag') as bag:
        handle = bag.add_topic(JOINT_STATES.resolved, JOINT_STATES.type, [JOINT_STATES.offered])
        for number in (6, 7, 9):
            bag.write(handle, JointStateEncoder(['x']).encode(0, [0], [0], [0]), 0, 0, number)
    assert main(['recover', str(tmp_path / 'bag'), '--out', str(tmp_path / 'clean')]) == 0
    output = capsys.readouterr().out
    assert '3 messages, 1 numbers missing in between, 5 numbers missing before the first' in output
    assert read_context(tmp_path / 'clean').losses == {
        '/joint_states': '1 missed, 5 sent before the recorder connected'
    }


@pytest.mark.parametrize('name', ['bag_0.mcap', 'bag_1.mcap'])
def test_files_of_a_split_bag_are_recovered_together(plain, tmp_path, name):
    folder = damaged(tmp_path / 'bag', plain.read_bytes())
    (folder / 'bag_1.mcap').write_bytes(plain.read_bytes())
    (folder / 'bag_10.mcap').write_bytes(plain.read_bytes())
    (folder / name).write_bytes(b'')
    recovery = recover(folder, tmp_path / 'clean')
    assert sum(recovery.messages.values()) == 2 * len(read(plain.parent))
    assert recovery.unfinished == [(name, None)]


def test_bag_from_rosbags_writer_is_recovered(tmp_path):
    with Writer(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection('/x', COMMANDS.type, typestore=typestore())
        for k in range(100):
            writer.write(connection, START + k, Float64MultiArrayEncoder(1).encode([k]))
    expected = read(tmp_path / 'bag')
    (file,) = (tmp_path / 'bag').glob('*.mcap')
    recovery = recover(damaged(tmp_path / 'cut', file.read_bytes()[:-1]), tmp_path / 'clean')
    assert read(recovery.path) == expected


def test_folder_without_a_bag_is_one_error_line(tmp_path, capsys):
    with pytest.raises(BagError, match='there is no MCAP file'):
        recover(tmp_path, tmp_path / 'clean')
    assert main(['recover', str(tmp_path / 'nowhere')]) == 1
    assert capsys.readouterr().err.startswith('blf_dsc recover: ')
    assert not Path(tmp_path / 'clean').exists()


def test_command_reports_what_was_lost(plain, tmp_path, capsys):
    folder = damaged(tmp_path / 'bag', plain.read_bytes()[: chunks(plain.read_bytes())[-1][0]])
    assert main(['recover', str(folder)]) == 0
    output = capsys.readouterr().out
    assert 'bag_0.mcap: the recording was not closed; it ends at 1734000000.024000001 s' in output
    assert 'at most' not in output  # how much came later depends on the CPU load
    assert 'missing' not in output
    assert f'wrote {tmp_path / "bag_recovered"}' in output


def test_exit_code_is_nonzero_if_everything_is_lost(plain, tmp_path, capsys):
    for k, data in enumerate([b'', plain.read_bytes()[: chunks(plain.read_bytes())[0][0]]]):
        folder = damaged(tmp_path / f'{k}', data)
        assert main(['recover', str(folder)]) == 1
        assert 'ALL LOST' in capsys.readouterr().out


def test_damaged_record_type_neither_hides_nor_invents_messages(plain, tmp_path):
    """A chunk may then look like a footer, and an index like a message or like the end."""
    original = plain.read_bytes()
    topics = {JOINT_STATES.resolved, COMMANDS.resolved}
    expected_messages = list(read_messages(plain, topics))
    written = set(Salvage(plain).messages(original))
    file = tmp_path / 'bag_0.mcap'
    for at in [piece.at for piece in scan(original)]:
        for bit in range(8):
            content = bytearray(original)
            content[at] ^= 1 << bit
            file.write_bytes(content)
            with suppress(MalformedRecordError):
                assert list(read_messages(file, topics)) == expected_messages
            salvage = Salvage(file)
            found = list(salvage.messages(bytes(content)))
            assert {message for message in found if salvage.channel(message[0])} <= written
