# SPDX-License-Identifier: Apache-2.0
"""Bags at their limits: a full disk, split files, many chunks."""

from __future__ import annotations

import itertools
import tracemalloc

import pytest
from foreign_readers import read
from mcap.reader import make_reader
from small_disk import small_disk

from blf_dsc_controller.bags import writer
from blf_dsc_controller.bags.mcap_file import McapFile
from blf_dsc_controller.bags.recover import recover
from blf_dsc_controller.bags.sources import open_bag
from blf_dsc_controller.bags.writer import BagWriter, DiskFullError
from blf_dsc_controller.messages.codecs import JointStateEncoder
from blf_dsc_controller.messages.topics import JOINT_STATES, STREAM

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


def test_reserve_for_the_index_grows_with_it(tmp_path, monkeypatch):
    monkeypatch.setattr(writer, '_MOST_CHUNKS', 10**9)
    # A chunk for each message: the index of 12 MB of them is larger than the first reserve, 2 MB.
    with small_disk(tmp_path / 'disk', 12) as disk:
        bag = BagWriter(disk / 'bag', flush_interval=0.0)
        handle = bag.add_topic('/a', JOINT_STATES.type, [STREAM])
        with pytest.raises(DiskFullError):
            write_endlessly(bag, handle, 1)
        with (disk / 'bag' / 'bag_0.mcap').open('rb') as stream:
            summary = make_reader(stream).get_summary()
        assert summary.statistics.message_count == bag.message_counts['/a']
        assert len(summary.chunk_indexes) == bag.message_counts['/a'] > 15_000


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
    bag.note({'law': 'blf_dsc'})
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
        assert McapFile(file).statistics is not None
        with file.open('rb') as stream:
            assert make_reader(stream).get_summary().statistics.message_count > 0
    assert recover(tmp_path / 'bag', tmp_path / 'clean').is_whole
    assert read(tmp_path / 'clean') == read(tmp_path / 'bag')


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


def test_memory_of_a_recorder_is_bounded(tmp_path):
    """Every chunk has an entry in the index, which is in memory until its file ends."""
    with BagWriter(tmp_path / 'bag', flush_interval=0.0) as bag:
        handle = bag.add_topic('/a', JOINT_STATES.type, [STREAM])
        peaks = []
        tracemalloc.start()
        for k in range(100_000):
            bag.write(handle, message(k), k)
            if k % 20_000 == 19_999:
                peaks.append(tracemalloc.get_traced_memory()[1])
                tracemalloc.reset_peak()
        tracemalloc.stop()
    assert len(list((tmp_path / 'bag').glob('*.mcap'))) == 5
    assert max(peaks) < 1.1 * peaks[1]
    with open_bag(tmp_path / 'bag') as found:
        assert sum(1 for _ in found.messages({'/a'})) == 100_000
