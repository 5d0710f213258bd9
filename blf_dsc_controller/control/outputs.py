# SPDX-License-Identifier: Apache-2.0
"""Where the messages of a loop go: a bag, topics, a user's own.

None of them may disturb control: one that fails is dropped, and the loop goes on.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Protocol

from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.topics import Topic


class Output(Protocol):
    """Takes the messages of a loop."""

    def write(self, stamp: int, topic: Topic, raw: bytes) -> None:
        """Take a serialised message with the time [ns] of its state."""


class Outputs:
    """The outputs of a loop.

    Attributes:
        problem: why some of them were dropped, or could not be ended; empty without.
    """

    def __init__(self) -> None:
        self.problem = ''
        self._outputs: tuple[Output, ...] = ()

    def __bool__(self) -> bool:
        return bool(self._outputs)

    def add(self, output: Output) -> None:
        """Give all messages from now on to an output, too."""
        self._outputs = (*self._outputs, output)

    def write(self, stamp: int, topic: Topic, raw: bytes) -> None:
        """Pass on a serialised message with the time [ns] of its state."""
        for output in self._outputs:
            try:
                output.write(stamp, topic, raw)
            except Exception as error:  # noqa: BLE001 - the loop must go on
                self._drop(output)
                self._report(error)

    def end(self, output: Output, close: Callable[[], None]) -> None:
        """Drop an output, and close it."""
        self._drop(output)
        try:
            close()
        except Exception as error:  # noqa: BLE001 - the last torque must be returned
            self._report(error)

    def _drop(self, output: Output) -> None:
        self._outputs = tuple(each for each in self._outputs if each is not output)

    def _report(self, error: Exception) -> None:
        kind = '' if isinstance(error, BlfDscError) else f'{type(error).__name__}: '
        text = f'{kind}{error}'
        self.problem = '; '.join(filter(None, (self.problem, text)))
        logging.getLogger(__name__).error(text)
