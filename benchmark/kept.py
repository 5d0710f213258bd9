# SPDX-License-Identifier: Apache-2.0
"""Results of long studies, kept in a file of a line each, from which the same command goes on."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Generic, TypeVar

K = TypeVar('K')
V = TypeVar('V')


class Results(Generic[K, V]):
    """Results by keys.

    Attributes:
        results: what is there so far, by its key.
    """

    def __init__(
        self,
        path: Path | None,
        key_of: Callable[[list[Any]], K],
        value_of: Callable[[list[Any]], V],
    ) -> None:
        """Read those of a file, if one is named and there; `key_of` and `value_of` read JSON."""
        self._path = path
        self.results: dict[K, V] = {}
        if path is not None and path.exists():
            for line in path.read_text(encoding='utf-8').splitlines():
                key, value = json.loads(line)
                self.results[key_of(key)] = value_of(value)

    def get(self, key: K, compute: Callable[[], V]) -> V:
        """Return the result of a key, from the file or computed now, which the file gets."""
        if key not in self.results:
            self.results[key] = compute()
            if self._path is not None:
                with self._path.open('a', encoding='utf-8') as file:
                    file.write(json.dumps([key, self.results[key]]) + '\n')
        return self.results[key]
