# SPDX-License-Identifier: Apache-2.0
"""Rows [H | D] of the identity H P + D d = tau along a motion that is known beforehand."""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.arms.model import ArmModel
from blf_dsc_controller.compiled.jit import kernel
from blf_dsc_controller.law import columns
from blf_dsc_controller.law.settings import settings_of


@kernel
def rows_along(
    model: ArmModel,
    settings_vector: np.ndarray,
    times: np.ndarray,
    motion: np.ndarray,
    rows: np.ndarray,
) -> None:
    """Fill `rows` (k, n, m) with [H(q, dq, dq, ddq) | D].

    Args:
        model: of the arm.
        settings_vector: packed `Settings`: the columns are read.
        times: (k,) [s].
        motion: q, dq, ddq at each time (k, 3, n).
        rows: filled.
    """
    settings = settings_of(settings_vector, model)
    H = np.zeros((settings.n, settings.p))
    for k in range(times.size):
        q = motion[k, 0]
        dq = motion[k, 1]
        model.regressor(q, dq, dq, motion[k, 2], H)
        columns.fill(settings, times[k], dq, rows[k])
        for i in range(settings.n):
            for j in range(settings.p):
                rows[k, i, j] = H[i, j]
