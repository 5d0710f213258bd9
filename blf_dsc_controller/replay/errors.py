# SPDX-License-Identifier: Apache-2.0
"""What can be wrong with a replay, beside the bag itself."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from blf_dsc_controller.errors import BlfDscError


class NothingToCompareError(BlfDscError):
    """A bag in which the controller says nothing."""

    def __init__(self, path: Path, held: Mapping[str, int]) -> None:
        self.path = path
        listing = ''.join(f'\n  {name} ({count})' for name, count in held.items())
        super().__init__(
            f'{path} holds nothing that the controller said, so there is nothing to compare; '
            f'it holds:{listing}\nTo see what a configuration would command, give --config'
        )


class LateRecordingError(BlfDscError):
    """A bag that begins after the controller did, so that the state of the law is not known."""

    def __init__(self, path: Path, stamp: int) -> None:
        self.path = path
        super().__init__(
            f'{path} does not hold the first state that the controller answered, that of stamp '
            f'{stamp} ns, so what it knew at any later one cannot be told: start the recorder first'
        )


class ShortBagError(BlfDscError):
    """A bag that ends before a window of the learning is full."""

    def __init__(self, path: Path, duration: float, window: float) -> None:
        self.path = path
        super().__init__(
            f'{path} holds {duration:.3g} s, which is not enough for a window of {window:.3g} s '
            'and the time that the filters settle: record longer, or set learning.window shorter'
        )


class NoTorqueError(BlfDscError):
    """A bag that does not tell which torques acted on the arm."""

    def __init__(self, path: Path) -> None:
        self.path = path
        super().__init__(
            f'{path} does not tell the torques: there is no topic of commands (name it: --map '
            'commands=/its/name) and the effort of the joint states is empty'
        )


class NoCommandOrderError(BlfDscError):
    """Commands that are not one value for each joint, so that they cannot be told apart."""

    def __init__(self, topic: str, size: int, joints: int, names: tuple[str, ...]) -> None:
        self.topic = topic
        self.size = size
        super().__init__(
            f'{topic} has {size} values, but there are {joints} joints, and {len(names)} in the '
            f'joint states ({", ".join(names)}): which value is whose cannot be told'
        )
