# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc replay` against the reader of the package mcap, which only yields the messages."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from harness import Ratio, interleaved, ratio
from mcap.reader import make_reader

from blf_dsc_controller.bags.content import read_content
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.replay.verify import verify
from blf_dsc_controller.simulation.bag import write_bag
from blf_dsc_controller.simulation.loop import simulate

_DURATION = 60.0  # s
_ROUNDS = 5
_READER = 'mcap reader, messages as bytes'
_CONTENT = 'messages read and decoded'
_REPLAY = 'bag replayed through the law and compared'


def measure() -> Iterator[Ratio]:
    """Measure messages per second relative to the reader alone, on a bag of all topics."""
    controller, plant = ControllerConfig(), PlantConfig(duration=_DURATION)
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder, 'bag')
        write_bag(bag, simulate(controller, plant), controller, 'none', plant)
        messages = _iterated(bag)

        def replayed() -> int:
            found = verify(bag)
            if found.difference is not None:
                raise ValueError(f'{bag}: {found.difference}')
            return messages

        contestants = {
            _READER: lambda: _iterated(bag),
            _CONTENT: lambda: sum(read_content(bag).message_counts.values()),
            _REPLAY: replayed,
        }
        times = interleaved(contestants, _ROUNDS)
    for name in (_CONTENT, _REPLAY):
        note = f'{1e-3 / np.median(times[name]):.0f} thousand messages a second here'
        what = f'{name}: messages a second'
        yield ratio('replay', what, _READER, 1.0 / times[name], 1.0 / times[_READER], note)


def _iterated(bag: Path) -> int:
    """Iterate over the messages of a bag of one file and return their number."""
    (file,) = bag.glob('*.mcap')
    with file.open('rb') as stream:
        return sum(1 for _ in make_reader(stream).iter_messages(log_time_order=False))
