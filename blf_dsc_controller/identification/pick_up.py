# SPDX-License-Identifier: Apache-2.0
"""The time at which a load is picked up."""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.identification.prior import Prior
from blf_dsc_controller.identification.regression import regression, successive
from blf_dsc_controller.identification.values import indices
from blf_dsc_controller.identification.windows import Indices, Rows
from blf_dsc_controller.run import Floats

_PER_STEP = 10  # windows from one time to the next at which a load may be picked up


def pick_up_time(rows: Rows, fit: Indices, G: Floats, prior: Prior) -> float:
    """Return the time [s] from which a load explains the torques best."""
    steps = len(fit) // _PER_STEP
    found = regression(rows, fit, G, prior)
    load = indices(prior.joints).load
    Q = found.folds.sum(axis=(0, 1))
    costs = []
    for products in successive(rows, fit, G, prior, found, steps):
        b = Q[:-1, -1]
        z = np.linalg.solve(Q[:-1, :-1] + np.eye(b.size), b)
        costs.append(Q[-1, -1] - b @ z)
        loaded = products.sum(axis=0)
        empty = loaded.copy()
        empty[load] = 0.0
        empty[:, load] = 0.0
        Q += empty - loaded
    first = np.array_split(fit, steps)[int(np.argmin(costs))][0]
    return float(rows.time[first])
