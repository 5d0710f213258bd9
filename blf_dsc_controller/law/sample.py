# SPDX-License-Identifier: Apache-2.0
"""What is told of one sample: the part of signals and state that leaves the law."""

from __future__ import annotations

from math import nan
from typing import Annotated, NamedTuple

import numpy as np

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array, Cell, size_of, view_of
from blf_dsc_controller.law import lyapunov
from blf_dsc_controller.law.settings import Settings
from blf_dsc_controller.law.state import Signals, State


class Sample(NamedTuple):
    """Views on a sample vector; a run is a matrix of such rows."""

    qr: Annotated[Array, 'n']  # rad
    dqr: Annotated[Array, 'n']  # rad/s
    xi1: Annotated[Array, 'n']  # rad
    xi2: Annotated[Array, 'n']  # rad/s
    torque: Annotated[Array, 'n']  # commanded, after the limit, N m
    disturbance: Annotated[Array, 'n']  # d^3, N m
    bound: Annotated[Array, 'n']  # k(t), rad
    cuts: Annotated[Array, 'n']  # 0, or LEVEL_CUT + RATE_CUT as the torque was cut in this sample
    estimate: Annotated[Array, 'm']  # theta^; NaN for a disturbance column that has been refused
    lyapunov: Annotated[Array, 4]  # terms of (29): error, kinetic, parameters, disturbance; or NaN
    lambda_min: Cell  # of the present window's Phi
    latched: Cell  # 0 or 1


sample_of, sample_size = view_of(Sample), size_of(Sample)


@inner
def tell(settings: Settings, state: State, signals: Signals, sample: Sample) -> None:
    """Fill the sample with what the update that has just been made says, but for its energies."""
    for i in range(settings.n):
        sample.qr[i] = signals.qr[i]
        sample.dqr[i] = signals.dqr[i]
        sample.xi1[i] = signals.xi1[i]
        sample.xi2[i] = signals.xi2[i]
        sample.torque[i] = signals.torque[i]
        sample.disturbance[i] = state.disturbance[i]
        sample.bound[i] = signals.bound[i]
        sample.cuts[i] = signals.cuts[i]
    for j in range(settings.m):
        sample.estimate[j] = state.estimate[j] if state.active[j] != 0.0 else nan
    sample.lambda_min[0] = state.lambda_min[0]
    sample.latched[0] = state.latched[0]


@inner
def tell_energies(
    settings: Settings, state: State, signals: Signals, q: np.ndarray, sample: Sample
) -> None:
    """Fill in the terms of (29): a tangent for each joint, which only who watches pays for."""
    sample.lyapunov[0] = lyapunov.error_term(settings, signals)
    if settings.truth_known == 1:
        sample.lyapunov[1] = lyapunov.kinetic_term(settings, signals, q)
        sample.lyapunov[2] = lyapunov.parameter_term(settings, state)
        sample.lyapunov[3] = lyapunov.disturbance_term(settings, state, signals)
    else:
        for k in range(1, 4):
            sample.lyapunov[k] = nan
