# SPDX-License-Identifier: Apache-2.0
"""How long torques take after their state, counted in bins.

Its size does not grow with the run.
"""

from __future__ import annotations

import numpy as np

_BIN = 1e-6  # s
_BINS = 20_000


class Latency:
    """A histogram of durations, in microseconds up to 20 ms; longer ones are in its last bin."""

    def __init__(self) -> None:
        self._counts = np.zeros(_BINS, dtype=np.int64)
        self.largest = 0.0  # s

    def add(self, duration: float) -> None:
        """Count a duration [s]."""
        self._counts[min(int(duration / _BIN), _BINS - 1)] += 1
        self.largest = max(self.largest, duration)

    def quantile(self, share: float) -> float:
        """Return the duration [s] that a `share` of all does not exceed; 0 without any."""
        total = int(self._counts.sum())
        if not total:
            return 0.0
        bins = int(np.searchsorted(np.cumsum(self._counts), share * total)) + 1
        return min(bins * _BIN, self.largest)
