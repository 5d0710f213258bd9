# SPDX-License-Identifier: Apache-2.0
"""Packed messages keep every byte, in less memory than the file takes."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
import synthetic_bag
from synthetic_bag import Synthetic

from blf_dsc_controller.bags.packed_messages import BLOCK, PackedMessages
from blf_dsc_controller.bags.reader import read_run


@pytest.mark.parametrize('count', [0, 1, BLOCK, BLOCK + 1, 2 * BLOCK + 7])
@pytest.mark.parametrize('lengths', [(16,), (3, 5)])
def test_packed_messages_round_trip(count, lengths):
    rng = np.random.default_rng(count)
    messages = [b'head' + rng.bytes(rng.choice(lengths)) for _ in range(count)]
    packed = PackedMessages(messages)
    assert (len(packed), bool(packed)) == (count, count > 0)
    assert list(packed) == messages
    assert packed[count // 2 :] == messages[count // 2 :]
    for k in {0, count // 2, count - 1} if count else ():
        assert (packed[k], packed[k - count]) == (messages[k], messages[k])
    with pytest.raises(IndexError):
        packed[count]


def test_reading_a_bag_takes_less_memory_than_its_file(tmp_path):
    path = synthetic_bag.write(tmp_path / 'bag', Synthetic(5 * BLOCK).messages())
    tracemalloc.start()
    try:
        read_run(path)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < (path / 'bag_0.mcap').stat().st_size
