# SPDX-License-Identifier: Apache-2.0
"""What takes more than some seconds says so before it begins, and how far it is.

Always in one line on stderr: it is no result. On a terminal a bar follows. Elsewhere, in a
pipe or the log of a CI, whose every redraw would be another line, each step is a line.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from typing import TypeVar

from tqdm import tqdm

T = TypeVar('T')


def print_notice(notice: str) -> None:
    """Print a notice to stderr, at once, since it is not part of the results."""
    sys.stderr.write(f'{notice}\n')
    sys.stderr.flush()


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
        """Say what begins, and how long it takes."""
        print_notice(begun)
        self._names = names
        self._bar = tqdm(total=len(names), unit='stage', leave=False, disable=None)

    def begin(self, name: str) -> None:
        """Say which stage begins; one may begin again."""
        k = self._names.index(name)
        if self._bar.disable:
            print_notice(f'stage {k + 1} of {len(self._names)}: {name}')
            return
        self._bar.set_description(name)
        self._bar.update(k - self._bar.n)

    def close(self) -> None:
        """Take the bar away."""
        self._bar.close()
