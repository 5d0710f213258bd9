# SPDX-License-Identifier: Apache-2.0
"""Sliding-window sum of X^T [X | u], the integrals (21) and (22), in constant time and drift-free.

A running sum that adds the new and subtracts the old collects one rounding error a sample for ever.
Beside the running sum S this window keeps F, the sum of what was written since the ring last
wrapped; at the wrap F is the exact content of the ring and replaces S.
"""

import numpy as np

from blf_dsc_controller.compiled.jit import inner


@inner
def push(
    ring: np.ndarray, cursor: int, running: np.ndarray, fresh: np.ndarray, row: np.ndarray
) -> int:
    """Replace the oldest row of the window by `row` and return the next cursor.

    Args:
        ring: the window's rows (N, n, m + 1), oldest at `cursor`; zeros before it is full.
        cursor: place of the oldest row.
        running: S (m, m + 1), sum of X^T [X | u] over the ring; upper triangle and last column.
        fresh: F, like S, over what was written since the last wrap.
        row: newest [X | u] (n, m + 1).
    """
    old = ring[cursor]
    n = row.shape[0]
    m = row.shape[1] - 1
    for a in range(m):
        for b in range(a, m + 1):
            new_term = 0.0
            old_term = 0.0
            for i in range(n):
                new_term += row[i, a] * row[i, b]
                old_term += old[i, a] * old[i, b]
            running[a, b] += new_term - old_term
            fresh[a, b] += new_term
    for i in range(n):
        for a in range(m + 1):
            old[i, a] = row[i, a]
    cursor += 1
    if cursor < ring.shape[0]:
        return cursor
    for a in range(m):
        for b in range(a, m + 1):
            running[a, b] = fresh[a, b]
            fresh[a, b] = 0.0
    return 0


@inner
def average(running: np.ndarray, samples: int, Phi: np.ndarray, b: np.ndarray) -> None:
    """Fill Phi (m, m), whole, and b (m,): both integrals over the window, by the same 1/tau_d."""
    m = Phi.shape[0]
    for i in range(m):
        b[i] = running[i, m] / samples
        for j in range(i, m):
            Phi[i, j] = running[i, j] / samples
            Phi[j, i] = Phi[i, j]
