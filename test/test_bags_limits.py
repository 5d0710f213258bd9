# SPDX-License-Identifier: Apache-2.0
"""A bag at its limits: a full disk, files that are split, a ring in memory."""

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


def write_without_end(bag, handle, times):
    for k in itertools.count():
        bag.write(handle, message(k) * times, k)


@pytest.mark.parametrize('compression', ['none', 'zstd'])
@pytest.mark.parametrize('interval', [0.0, None])  # a chunk for each message; chunks of 1 MiB
def test_a_full_disk_leaves_a_whole_bag_and_one_clear_error(tmp_path, compression, interval):
    with small_disk(tmp_path / 'disk', 3) as disk:
        bag = BagWriter(disk / 'bag', compression=compression, flush_interval=interval)
        handle = bag.add_topic('/a', JOINT_STATES.type, [STREAM])
        with pytest.raises(DiskFullError, match='the disk is full') as caught:
            write_without_end(bag, handle, 8 if interval is None else 1)
        bag.close()
        written = caught.value.messages
        assert written == bag.message_counts['/a']  # with the one that filled the disk
        assert f'{written} messages' in str(caught.value)
        assert len(read(disk / 'bag')) == written
        with (disk / 'bag' / 'bag_0.mcap').open('rb') as stream:
            assert make_reader(stream).get_summary().statistics.message_count == written
        assert recover(disk / 'bag', tmp_path / 'clean').is_whole
        assert sorted(one.name for one in (disk / 'bag').iterdir()) == [
            'bag_0.mcap',
            'metadata.yaml',
        ]


def test_room_for_the_index_grows_with_it(tmp_path):
    # A chunk for each message: the index of 16 MB of them is larger than the first reserve, 2 MB.
    with small_disk(tmp_path / 'disk', 16) as disk:
        bag = BagWriter(disk / 'bag', flush_interval=0.0)
        handle = bag.add_topic('/a', JOINT_STATES.type, [STREAM])
        with pytest.raises(DiskFullError):
            write_without_end(bag, handle, 1)
        with (disk / 'bag' / 'bag_0.mcap').open('rb') as stream:
            summary = make_reader(stream).get_summary()
        assert summary.statistics.message_count == bag.message_counts['/a']
        assert len(summary.chunk_indexes) == bag.message_counts['/a'] > 20_000


def test_no_room_at_all_is_an_error_at_the_start(tmp_path):
    with small_disk(tmp_path / 'disk', 1) as disk, pytest.raises(OSError, match='No space left'):
        BagWriter(disk / 'bag')


def test_the_reserve_is_gone_when_the_bag_is_closed(tmp_path):
    with BagWriter(tmp_path / 'bag') as bag:
        assert len(list((tmp_path / 'bag').iterdir())) == 2
        bag.flush()
    assert sorted(one.name for one in (tmp_path / 'bag').iterdir()) == [
        'bag_0.mcap',
        'metadata.yaml',
    ]


@pytest.mark.parametrize(
    ('limits', 'count'),
    [
        ({'split_size': 20_000}, 3),  # 200 messages, each with its chunk and index some 290 bytes
        ({'split_duration': 0.5}, 4),  # of 2 s
    ],
)
def test_a_bag_is_split_and_reads_as_one(tmp_path, limits, count):
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


def test_a_ring_keeps_the_last_seconds_and_what_is_latched(tmp_path):
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
    # It goes on: a second trigger writes what has come since.
    ring.write(states, message(100), 10 * SECOND, 100, 100)
    ring.dump(tmp_path / 'again', {})
    assert read(tmp_path / 'again')[-1][2] == message(100)


def test_a_split_bag_knows_its_run_though_the_first_file_does_not(tmp_path):
    """The parameters come after the first split, what was missed is known at the end."""
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


def test_no_file_is_begun_without_a_message_for_it(tmp_path):
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
