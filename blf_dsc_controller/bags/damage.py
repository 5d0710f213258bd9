# SPDX-License-Identifier: Apache-2.0
"""What could not be had from a damaged bag, in words."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime, timezone

_NANOSECONDS = 1_000_000_000


@dataclass
class Loss:
    """A piece of a file that is not in the clean bag.

    Attributes:
        file: its name.
        at: place of the piece in it [bytes].
        size: of the piece [bytes].
        reason: why it cannot be read.
        start: earliest time of its messages [ns], None if that cannot be told.
        end: latest.
        messages: how many of each topic were in it, as far as the file's index tells.
    """

    file: str
    at: int
    size: int
    reason: str
    start: int | None = None
    end: int | None = None
    messages: dict[str, int] = field(default_factory=dict)

    def __str__(self) -> str:
        counts = ', '.join(f'{count} of {topic}' for topic, count in self.messages.items())
        lost = f'; messages lost: {counts}' if counts else ''
        return (
            f'{self.file}: {self.size} bytes at byte {self.at} ({self.reason}), {self.span}{lost}'
        )

    @property
    def span(self) -> str:
        """Times of the lost messages, in words."""
        if self.start is None and self.end is None:
            return 'of unknown time'
        if self.end is None:
            return f'after {clock(self.start)}'
        if self.start is None:
            return f'before {clock(self.end)}'
        seconds = (self.end - self.start) / _NANOSECONDS
        return f'from {clock(self.start)} to {clock(self.end)} ({seconds:.3f} s)'


def clock(stamp: int | None) -> str:
    """Time of a log stamp [ns] as UTC and as a plain number; a wild one as the number alone."""
    assert stamp is not None  # noqa: S101 - for the type checker: asked for known times alone
    plain = f'{stamp // _NANOSECONDS}.{stamp % _NANOSECONDS:09d} s'
    try:
        moment = datetime.fromtimestamp(stamp // _NANOSECONDS, tz=timezone.utc)
    except (OverflowError, OSError, ValueError):
        return plain
    return f'{plain} ({moment:%Y-%m-%d %H:%M:%S} UTC)'
