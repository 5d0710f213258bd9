# SPDX-License-Identifier: Apache-2.0
"""Parameters of the nodes beside the loop: recorder, watchdog and view."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Literal

from blf_dsc_controller.configuration.schema import parameter

_of_bag = partial(parameter, read_only='a bag is opened once, when the recorder starts')
_of_watchdog = partial(parameter, read_only='it is read once, when the node starts')
_of_view = partial(parameter, read_only='the page is served once, when the node starts')


@dataclass(frozen=True)
class RecorderConfig:
    """Parameters of the node `bag_recorder`."""

    output: str = _of_bag('bag', 'folder of the bag; it must not exist yet')
    topics: tuple[str, ...] = _of_bag(
        (), 'topics to record; empty: all', omittable=True
    )
    compression: Literal['none', 'zstd'] = _of_bag(
        'none', 'compression of the chunks of the bag'
    )
    queue_depth: int = _of_bag(
        100_000,
        'messages buffered per topic while the disk is busy',
        'messages',
        at_least=1,
    )
    clock: Literal['wall', 'plant'] = _of_bag(
        'wall',
        'log times: as received, or the stamp of the last joint state (lock-step)',
    )


@dataclass(frozen=True)
class WatchdogConfig:
    """Parameters of the node `torque_watchdog`."""

    timeout: float = _of_watchdog(
        0.05,
        'time without a command, while joint states continue, until the watchdog '
        'commands',
        's',
        at_least=0.005,
        at_most=10.0,
    )
    armed: bool = _of_watchdog(
        False,
        'do not wait for a first command: for a restart after the controller died, with its '
        'parameter file',
    )


@dataclass(frozen=True)
class ViewConfig:
    """Parameters of the node `view`."""

    host: str = _of_view(
        '127.0.0.1', 'address of this computer on which the page is served'
    )
    port: int = _of_view(
        8080, 'port of the page; if taken, the next free one', at_least=1, at_most=65535
    )
