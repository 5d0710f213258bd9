# SPDX-License-Identifier: Apache-2.0
"""SIGINT and SIGTERM as a flag, for what must be brought to its end in order."""

from __future__ import annotations

import signal
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interruption:
    """Notes the signals that come between `with` and its end, instead of raising.

    Attributes:
        came: whether there was any.
    """

    def __init__(self) -> None:
        self.came = False

    def __enter__(self) -> Interruption:
        self._before = {number: signal.signal(number, self._note) for number in _SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _note(self, _number: int, _frame: FrameType | None) -> None:
        self.came = True
