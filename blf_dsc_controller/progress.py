# SPDX-License-Identifier: Apache-2.0
"""What takes more than some seconds says so before it begins, and how far it is.

Always in one line on stderr: it is no result. On a terminal a bar follows. Elsewhere, in a
pipe or the log of a CI, whose every redraw would be another line, each step is a line.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NoReturn, TypeVar

from tqdm import tqdm

T = TypeVar('T')

_LARGE = 10_000_000  # bytes, from which reading takes more than some seconds


def print_notice(notice: str) -> None:
    """Print a notice to stderr, at once, since it is not part of the results."""
    sys.stderr.write(f'{notice}\n')
    sys.stderr.flush()


def announce_reading(paths: Sequence[Path], what: str) -> None:
    """Say what is done with files or folders, if they are so large that it takes seconds."""
    files = [
        file
        for path in paths
        for file in ([path] if path.is_file() else path.glob('*'))
    ]
    size = sum(file.stat().st_size for file in files if file.is_file())
    if size > _LARGE:
        listed = ', '.join(map(str, paths))
        print_notice(f'{listed}: {size / 1e6:.0f} MB are {what}')


def steps(items: Iterable[T], total: int, unit: str, begun: str) -> Iterator[T]:
    """Yield `total` items, and say before each is made which it is.

    `begun` is said before the first one: what is done, and how long it takes.
    """
    print_notice(begun)
    source = iter(items)
    with tqdm(total=total, unit=unit, leave=False, disable=None) as bar:
        for k in range(1, total + 1):
            if bar.disable:
                print_notice(f'{unit} {k} of {total}')
            item = next(source)
            bar.update()
            yield item


class Stages:
    """The named stages of a computation."""

    def __init__(self, names: tuple[str, ...], begun: str) -> None:
        """Take what is said as the first stage begins: what is done, and how long it takes."""
        self._names = names
        self._begun = begun
        self._bar: tqdm[NoReturn] | None = None

    def begin(self, name: str) -> None:
        """Say which stage begins; one may begin again."""
        bar = self._bar or self._first()
        k = self._names.index(name)
        if bar.disable:
            print_notice(f'stage {k + 1} of {bar.total}: {name}')
            return
        bar.set_description(name)
        bar.update(k - bar.n)

    def _first(self) -> tqdm[NoReturn]:
        print_notice(self._begun)
        total = len(self._names)
        self._bar = tqdm(total=total, unit='stage', leave=False, disable=None)
        return self._bar

    def close(self) -> None:
        """Take the bar away."""
        if self._bar is not None:
            self._bar.close()
