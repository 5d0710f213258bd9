# SPDX-License-Identifier: Apache-2.0
"""Bags at their limits: a full disk, split files, a ring in memory."""

from __future__ import annotations

import itertools

import pytest
from foreign_readers import read
from mcap.reader import make_reader
from small_disk import small_disk

from blf_dsc_controller.bags.context import read_context
from blf_dsc_controller.bags.recover import recover
from blf_dsc_controller.bags.ring import Ring
from blf_dsc_controller.bags.writer import BagWriter, DiskFullError
from blf_dsc_controller.messages.codecs import JointStateEncoder
from blf_dsc_controller.messages.topics import BOUND, JOINT_STATES, STREAM

SECOND = 1_000_000_000
CONFIGURATION = '/blf_dsc_controller:\n  ros__parameters:\n    law: "blf_dsc"\n'
ENCODER = JointStateEncoder(['joint1', 'joint2'])


def message(k):
    return ENCODER.encode(k, [k, 0], [0, 0], [0, 0])


def write_endlessly(bag, handle, times):
    for k in itertools.count():
        bag.write(handle, message(k) * times, k)


@pytest.mark.parametrize('compression', ['none', 'zstd'])
@pytest.mark.parametrize('interval', [0.0, None])  # a chunk for each message; chunks of 1 MiB
def test_full_disk_leaves_a_whole_bag_and_one_error(tmp_path, compression, interval):
    with small_disk(tmp_path / 'disk', 3) as disk:
        bag = BagWriter(disk / 'bag', compression=compression, flush_interval=interval)
        handle = bag.add_topic('/a', JOINT_STATES.type, [STREAM])
        with pytest.raises(DiskFullError, match='the disk is full') as caught:
            write_endlessly(bag, handle, 8 if interval is None else 1)
        bag.close()
        written = caught.value.messages
        assert written == bag.message_counts['/a']  # including the one that filled the disk
        assert f'{written} messages' in str(caught.value)
        assert len(read(disk / 'bag')) == written
        with (disk / 'bag' / 'bag_0.mcap').open('rb') as stream:
            assert make_reader(stream).get_summary().statistics.message_count == written
        assert recover(disk / 'bag', tmp_path / 'clean').is_whole
        assert sorted(path.name for path in (disk / 'bag').iterdir()) == [
            'bag_0.mcap',
            'metadata.yaml',
        ]


def test_reserve_for_the_index_grows_with_it(tmp_path):
    # A chunk for each message: the index of 16 MB of them is larger than the first reserve, 2 MB.
    with small_disk(tmp_path / 'disk', 16) as disk:
        bag = BagWriter(disk / 'bag', flush_interval=0.0)
        handle = bag.add_topic('/a', JOINT_STATES.type, [STREAM])
        with pytest.raises(DiskFullError):
            write_endlessly(bag, handle, 1)
        with (disk / 'bag' / 'bag_0.mcap').open('rb') as stream:
            summary = make_reader(stream).get_summary()
        assert summary.statistics.message_count == bag.message_counts['/a']
        assert len(summary.chunk_indexes) == bag.message_counts['/a'] > 20_000


def test_disk_without_room_for_the_reserve_is_an_error_at_the_start(tmp_path):
    with small_disk(tmp_path / 'disk', 1) as disk, pytest.raises(OSError, match='No space left'):
        BagWriter(disk / 'bag')


def test_closing_the_bag_removes_the_reserve(tmp_path):
    with BagWriter(tmp_path / 'bag') as bag:
        assert len(list((tmp_path / 'bag').iterdir())) == 2
        bag.flush()
    assert sorted(path.name for path in (tmp_path / 'bag').iterdir()) == [
        'bag_0.mcap',
        'metadata.yaml',
    ]


@pytest.mark.parametrize(
    ('limits', 'count'),
    [
        ({'split_size': 20_000}, 3),  # 200 messages, about 290 bytes each with chunk and index
        ({'split_duration': 0.5}, 4),  # of 2 s
    ],
)
def test_split_bag_is_read_as_one(tmp_path, limits, count):
    now = 0.0
    bag = BagWriter(tmp_path / 'bag', flush_interval=0.01, clock=lambda: now, **limits)
    bag.configure(CONFIGURATION, 5)
    first = bag.add_topic('/a', JOINT_STATES.type, [STREAM])
    for k in range(200):
        now = k * 0.01
        if k == 100:
            late = bag.add_topic('/late', JOINT_STATES.type, [STREAM])
        bag.write(first if k < 100 or k % 2 else late, message(k), k)
    bag.close()
    files = sorted((tmp_path / 'bag').glob('*.mcap'))
    assert len(files) == count
    assert [at for _, at, _ in read(tmp_path / 'bag')] == list(range(200))
    assert [raw for *_, raw in read(tmp_path / 'bag')] == [message(k) for k in range(200)]
    for file in files:
        assert file.stat().st_size < 30_000
        context = read_context(file)  # each file describes the run
        assert context.configurations == ((5, CONFIGURATION),)
        assert context.facts['law'] == 'blf_dsc'
        with file.open('rb') as stream:
            assert make_reader(stream).get_summary().statistics.message_count > 0
    assert recover(tmp_path / 'bag', tmp_path / 'clean').is_whole
    assert read(tmp_path / 'clean') == read(tmp_path / 'bag')


def test_ring_keeps_the_last_seconds_and_latched_messages(tmp_path):
    ring = Ring(2.0, 'none')
    ring.configure(CONFIGURATION, 5)
    states = ring.add_topic('/joint_states', JOINT_STATES.type, [STREAM])
    bound = ring.add_topic('/bound', BOUND.type, [BOUND.offered])
    ring.write(bound, message(7), 0, 0, 1)
    ring.write(bound, message(8), 1, 1, 2)
    for k in range(100):
        ring.write(states, message(k), k * SECOND // 10, k, k)
    assert ring.dump(tmp_path / 'bag', {}) == 22
    found = read(tmp_path / 'bag')
    assert found[0] == ('/bound', 1, message(8))
    assert [raw for _, _, raw in found[1:]] == [message(k) for k in range(79, 100)]
    assert read_context(tmp_path / 'bag').configurations == ((5, CONFIGURATION),)
    # It keeps recording: a second trigger writes newer messages.
    ring.write(states, message(100), 10 * SECOND, 100, 100)
    ring.dump(tmp_path / 'again', {})
    assert read(tmp_path / 'again')[-1][2] == message(100)


def test_split_bag_has_the_context_that_its_first_file_lacks(tmp_path):
    """Parameters arrive after the first split, missed messages are known at the end."""
    now = 0.0
    bag = BagWriter(tmp_path / 'bag', flush_interval=0.0, clock=lambda: now, split_duration=0.1)
    handle = bag.add_topic('/joint_states', JOINT_STATES.type, [STREAM])
    for k in range(12):
        now = 0.1 * k
        bag.write(handle, message(k), k)
        if k == 2:
            bag.configure(CONFIGURATION, 5)
    bag.note({'messages /joint_states': '12 written, 7 missed'})
    bag.close()
    assert read_context(tmp_path / 'bag' / 'bag_0.mcap').configurations == ()
    context = read_context(tmp_path / 'bag')
    assert context.configurations == ((5, CONFIGURATION),)
    assert context.losses == {'/joint_states': '7 missed'}


def test_no_file_is_started_without_a_message(tmp_path):
    now = 0.0
    bag = BagWriter(tmp_path / 'bag', flush_interval=0.0, clock=lambda: now, split_duration=0.1)
    handle = bag.add_topic('/a', JOINT_STATES.type, [STREAM])
    for k in range(50):  # mostly idle
        now = 0.1 * k
        bag.flush_if_due()
        if k in (3, 30):
            bag.write(handle, message(k), k)
    bag.close()
    files = sorted((tmp_path / 'bag').glob('*.mcap'))
    counts = []
    for file in files:
        with file.open('rb') as stream:
            counts.append(make_reader(stream).get_summary().statistics.message_count)
    assert counts == [1, 1]
    assert [at for _, at, _ in read(tmp_path / 'bag')] == [3, 30]
