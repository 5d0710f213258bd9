# SPDX-License-Identifier: Apache-2.0
"""Telemetry samples of many rows as columns."""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.law.state import Sample, Settings, sample_of


def sample_columns(rows: Array, settings: Settings) -> Sample:
    """Return packed samples (N, s) as columns by name: field of shape (k,) is (N, k)."""
    places = sample_of(np.arange(rows.shape[1], dtype=np.float64), settings)
    return Sample(*(rows[:, place.astype(np.intp)] for place in places))
