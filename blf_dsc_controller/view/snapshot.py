# SPDX-License-Identifier: Apache-2.0
"""What the page shows of one moment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.run import Floats


class Snapshot(NamedTuple):
    """Values of n joints and m estimates at one time; NaN where unknown."""

    time: float  # s
    position: Floats  # (n,) rad, q
    error: Floats  # (n,) rad, xi1
    bound: Floats  # (n,) rad, k_c
    torque: Floats  # (n,) N m
    estimate: Floats  # (m,) theta^; NaN: a rejected column
    truth: Floats  # (m,)
    lambda_min: float
    squares: Floats  # (3,) (N m)^2, see `ModelError`
    load: Sequence[float] = (np.nan,) * 8  # of topics.LOAD
    loaded: bool = False  # the true parameters differ from those at the start
    tool: Sequence[float] = (np.nan,) * 4  # of topics.TOOL
    external: Floats = np.zeros(0)  # (n,) N m, from outside
    interval: Floats = np.zeros(0)  # (n,) N m, what model and noise explain of it
    touched: bool = False  # whether something touches the arm

    @property
    def felt_at(self) -> int | None:
        """Number of the joint where a contact shows most; None: no contact."""
        if not self.touched or not np.isfinite(self.external).all():
            return None
        return int(np.argmax(np.abs(self.external) / self.interval))
