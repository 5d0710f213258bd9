# SPDX-License-Identifier: Apache-2.0
"""The settings of a law: named in Python and in the kernels, one flat vector in between."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.views import part

# What these settings may be called; the vector holds the index.
SURFACES = ('filtered', 'linear')
PREDICTIONS = ('filtered', 'acceleration', 'lambda')
LATCHES = ('last', 'max')
UPDATES = ('gradient', 'newton')
TORQUE_SOURCES = ('command', 'effort')

LINEAR = SURFACES.index('linear')
FILTERED = PREDICTIONS.index('filtered')
LAMBDA = PREDICTIONS.index('lambda')
BEST = LATCHES.index('max')
NEWTON = UPDATES.index('newton')
EFFORT = TORQUE_SOURCES.index('effort')


class Settings(NamedTuple):
    """Gains and choices of a law for n joints, p parameters and m - p disturbance columns.

    The kernels' view of the flat vector that `pack` makes; the order of the fields is its layout.
    """

    n: int
    p: int
    m: int
    model: int  # code of the model
    surface: int
    prediction: int
    latch: int
    update: int
    torque_source: int
    window: int  # N, samples in tau_d
    interval: int  # samples between two looks at the excitation
    bias: int  # 1: a constant column per joint
    viscous: int  # 1: a column dq_i per joint
    coulomb: int  # 1: a column tanh(dq_i / coulomb_velocity) per joint
    tones: int  # sine and cosine columns per joint, for as many frequencies
    truth_known: int  # 1: true_parameters and true_disturbance hold
    feed_forward: int  # 1: the true disturbance is compensated
    time_constant: float  # lambda of (13), s
    boundary_layer: float  # b, rad/s
    eta: float  # leakage of (30)
    kappa: float  # weight of the prediction error
    rho: float  # regularisation of the Newton update
    sigma: float  # excitation threshold on lambda_min(Phi)
    learning_start: float  # tau_d + T_a, s
    pole: float  # of the regressor filter, rad/s
    omega: float  # of the differentiating filter (8), rad/s
    coulomb_velocity: float  # rad/s
    radius: float  # omega_a of (4)
    Wc: float  # leakage of P^ in (35)
    funnel_rate: float  # a, at which the bound narrows, 1/s
    bound: np.ndarray  # (n,) k_c, rad
    initial_bound: np.ndarray  # (n,) k_0, rad; k_c: the bound stands still
    weight: np.ndarray  # (n,) w, N m/rad; of z1 in (35)
    slope_limit: np.ndarray  # (n,) S_lim, N m/rad
    knee: np.ndarray  # (n,) where the slope reaches S_lim if the bound is k_c, rad
    K: np.ndarray  # (n,) 1/s; lambda_s of (35)
    mu: np.ndarray  # (n,) 1/s
    Kp: np.ndarray  # (n,) N m s/rad
    d2: np.ndarray  # (n,) N m/rad
    mu_bar: np.ndarray  # (n,) N m
    gamma: np.ndarray  # (n,) gain of (30)
    torque_limit: np.ndarray  # (n,) N m
    rate_limit: np.ndarray  # (n,) N m/s; 0: none
    true_disturbance: np.ndarray  # (4, n) constant, amplitude [N m], frequency, phase of a sine
    Gamma: np.ndarray  # (m,) diagonal of the adaptation gain
    initial_estimate: np.ndarray  # (m,) P^(0), zeros for the columns
    true_parameters: np.ndarray  # (p,)
    frequencies: np.ndarray  # (tones,) of the sine and cosine columns, rad/s
    constants: np.ndarray  # what the model's regressors know of the geometry


def pack(settings: Settings) -> np.ndarray:
    """Flatten `settings` in the order of its fields; `settings_of` is the inverse."""
    return np.concatenate([np.ravel(np.asarray(value, dtype=np.float64)) for value in settings])


@inner
def settings_of(vector: np.ndarray) -> Settings:
    """Name the parts of a packed vector; the arrays are views on it."""
    n = int(vector[0])
    p = int(vector[1])
    m = int(vector[2])
    tones = int(vector[14])
    at = 30 + 17 * n
    tail = at + 2 * m + p + tones
    return Settings(
        n=n,
        p=p,
        m=m,
        model=int(vector[3]),
        surface=int(vector[4]),
        prediction=int(vector[5]),
        latch=int(vector[6]),
        update=int(vector[7]),
        torque_source=int(vector[8]),
        window=int(vector[9]),
        interval=int(vector[10]),
        bias=int(vector[11]),
        viscous=int(vector[12]),
        coulomb=int(vector[13]),
        tones=tones,
        truth_known=int(vector[15]),
        feed_forward=int(vector[16]),
        time_constant=vector[17],
        boundary_layer=vector[18],
        eta=vector[19],
        kappa=vector[20],
        rho=vector[21],
        sigma=vector[22],
        learning_start=vector[23],
        pole=vector[24],
        omega=vector[25],
        coulomb_velocity=vector[26],
        radius=vector[27],
        Wc=vector[28],
        funnel_rate=vector[29],
        bound=part(vector, 30, (n,)),
        initial_bound=part(vector, 30 + n, (n,)),
        weight=part(vector, 30 + 2 * n, (n,)),
        slope_limit=part(vector, 30 + 3 * n, (n,)),
        knee=part(vector, 30 + 4 * n, (n,)),
        K=part(vector, 30 + 5 * n, (n,)),
        mu=part(vector, 30 + 6 * n, (n,)),
        Kp=part(vector, 30 + 7 * n, (n,)),
        d2=part(vector, 30 + 8 * n, (n,)),
        mu_bar=part(vector, 30 + 9 * n, (n,)),
        gamma=part(vector, 30 + 10 * n, (n,)),
        torque_limit=part(vector, 30 + 11 * n, (n,)),
        rate_limit=part(vector, 30 + 12 * n, (n,)),
        true_disturbance=part(vector, 30 + 13 * n, (4, n)),
        Gamma=part(vector, at, (m,)),
        initial_estimate=part(vector, at + m, (m,)),
        true_parameters=part(vector, at + 2 * m, (p,)),
        frequencies=part(vector, at + 2 * m + p, (tones,)),
        constants=part(vector, tail, (vector.size - tail,)),
    )
