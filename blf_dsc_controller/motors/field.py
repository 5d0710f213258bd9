# SPDX-License-Identifier: Apache-2.0
"""A number in a frame: its range, and the bits that it has."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Vector = NDArray[np.float64]


class Field(NamedTuple):
    """Numbers from `least` to `most`, in so many bits; with 0 bits, any of them.

    Both limits are of all joints, or one for each.
    """

    least: ArrayLike
    most: ArrayLike
    bits: int = 0

    @property
    def step(self) -> Vector:
        """Distance of two numbers: 0 without bits."""
        span = np.subtract(self.most, self.least)
        return np.asarray(span / (2**self.bits - 1) if self.bits else 0.0 * span)

    def codes(self, values: ArrayLike) -> NDArray[np.int64]:
        """Return the integers of the nearest numbers within the range."""
        above = self.cut(values) - np.asarray(self.least)
        return np.asarray(np.rint(above / self.step), np.int64)

    def values(self, codes: ArrayLike) -> Vector:
        """Return the numbers of integers."""
        return np.asarray(np.asarray(self.least) + np.asarray(codes) * self.step)

    def nearest(self, values: ArrayLike) -> Vector:
        """Return the nearest numbers that a frame can carry."""
        if not self.bits:
            return self.cut(values)
        return self.values(self.codes(values))

    def cut(self, values: ArrayLike) -> Vector:
        """Return values within the range, not rounded."""
        return np.asarray(np.clip(values, self.least, self.most))

    def holds(self, values: ArrayLike) -> NDArray[np.bool_]:
        """Return which values are within the range."""
        return np.asarray(
            (np.asarray(values) >= self.least) & (np.asarray(values) <= self.most)
        )
