# SPDX-License-Identifier: Apache-2.0
"""What the bag recorder can be told."""

from __future__ import annotations

from dataclasses import dataclass

from blf_dsc_controller.configuration.parameter import parameter

_AT_START = 'a bag is opened once, when the recorder starts'


@dataclass(frozen=True)
class RecorderConfig:
    """Parameters of `bag_recorder`."""

    output: str = parameter(
        'bag',
        'folder the bag is written into; it must not exist yet',
        read_only=_AT_START,
    )
    topics: tuple[str, ...] = parameter(
        (),
        'topics to record; none named: all that appear',
        may_be_empty=True,
        read_only=_AT_START,
    )
    compression: str = parameter(
        'none',
        'compression of the chunks of the bag',
        choices=('none', 'zstd'),
        read_only=_AT_START,
    )
    queue_depth: int = parameter(
        100_000,
        'messages of a topic that may wait while the disk is busy',
        unit='messages',
        at_least=1,
        read_only=_AT_START,
    )

    split_size: float = parameter(
        0.0,
        'size at which a new file of the bag is begun; 0: never',
        unit='MB',
        at_least=0.0,
        read_only=_AT_START,
    )
    split_duration: float = parameter(
        0.0,
        'time after which a new file of the bag is begun; 0: never',
        unit='s',
        at_least=0.0,
        read_only=_AT_START,
    )
    ring: float = parameter(
        0.0,
        'keep only this last time, in memory, and write it on the service trigger; 0: write all',
        unit='s',
        at_least=0.0,
        read_only=_AT_START,
    )

    def problems(self) -> list[str]:
        """Return what is wrong beside the ranges of single parameters, in words."""
        return [] if self.output.strip() else ['output: got no folder name to write the bag into']
