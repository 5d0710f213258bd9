# SPDX-License-Identifier: Apache-2.0
"""What is told of one sample: the part of signals and state that leaves the law."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blf_dsc_controller.core.kernel import kernel
from blf_dsc_controller.core.state import Signals, State


class Sample(NamedTuple):
    """Views on a sample vector; a run is a matrix of such rows."""

    qr: np.ndarray  # (n,) rad
    dqr: np.ndarray  # (n,) rad/s
    xi1: np.ndarray  # (n,) rad
    xi2: np.ndarray  # (n,) rad/s
    torque: np.ndarray  # (n,) commanded, after the limit, N m
    disturbance: np.ndarray  # (n,) d^3, N m
    estimate: np.ndarray  # (m,) theta^
    lambda_min: np.ndarray  # (1,) of the present window's Phi
    latched: np.ndarray  # (1,) 0 or 1


def sample_size(n: int, m: int) -> int:
    """Length of a sample vector."""
    return 6 * n + m + 2


@kernel
def sample_of(vector: np.ndarray, n: int, m: int) -> Sample:
    """Name the parts of a sample vector."""
    at = 6 * n + m
    return Sample(
        qr=vector[0:n],
        dqr=vector[n : 2 * n],
        xi1=vector[2 * n : 3 * n],
        xi2=vector[3 * n : 4 * n],
        torque=vector[4 * n : 5 * n],
        disturbance=vector[5 * n : 6 * n],
        estimate=vector[6 * n : at],
        lambda_min=vector[at : at + 1],
        latched=vector[at + 1 : at + 2],
    )


@kernel
def tell(state: State, signals: Signals, sample: Sample) -> None:
    """Fill a sample from what the law has just computed."""
    for i in range(sample.qr.size):
        sample.qr[i] = signals.qr[i]
        sample.dqr[i] = signals.dqr[i]
        sample.xi1[i] = signals.xi1[i]
        sample.xi2[i] = signals.xi2[i]
        sample.torque[i] = signals.torque[i]
        sample.disturbance[i] = state.disturbance[i]
    for j in range(sample.estimate.size):
        sample.estimate[j] = state.estimate[j]
    sample.lambda_min[0] = state.lambda_min[0]
    sample.latched[0] = state.latched[0]
