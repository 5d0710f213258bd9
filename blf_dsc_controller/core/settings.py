# SPDX-License-Identifier: Apache-2.0
"""The settings of a law: named in Python and in the kernels, one flat vector in between."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blf_dsc_controller.core.kernel import kernel

# What `law`, `update` and `torque_source` may be called; a setting holds the index.
LAWS = ('blf_dsc',)
UPDATES = ('gradient', 'newton')
TORQUE_SOURCES = ('command', 'effort')

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
    law: int
    update: int
    torque_source: int
    window: int  # N, samples in tau_d
    interval: int  # samples between two looks at the excitation
    time_constant: float  # lambda of (13), s
    boundary_layer: float  # b, rad/s
    eta: float  # leakage of (30)
    kappa: float  # weight of the prediction error
    rho: float  # regularisation of the Newton update
    sigma: float  # excitation threshold on lambda_min(Phi)
    learning_start: float  # tau_d + T_a, s
    pole: float  # of the regressor filter, rad/s
    radius: float  # omega_a of (4)
    bound: np.ndarray  # (n,) k_c, rad
    weight: np.ndarray  # (n,) w, N m/rad
    slope_limit: np.ndarray  # (n,) S_lim, N m/rad
    knee: np.ndarray  # (n,) where the barrier's slope reaches S_lim, rad
    K: np.ndarray  # (n,) 1/s
    mu: np.ndarray  # (n,) 1/s
    Kp: np.ndarray  # (n,) N m s/rad
    d2: np.ndarray  # (n,) N m/rad
    gamma: np.ndarray  # (n,) gain of (30)
    torque_limit: np.ndarray  # (n,) N m
    Gamma: np.ndarray  # (m,) diagonal of the adaptation gain
    initial_estimate: np.ndarray  # (m,) P^(0), zeros for the columns
    constants: np.ndarray  # what the model's regressors know of the geometry


def pack(settings: Settings) -> np.ndarray:
    """Flatten `settings` in the order of its fields; `settings_of` is the inverse."""
    return np.concatenate([np.ravel(np.asarray(value, dtype=np.float64)) for value in settings])


@kernel
def settings_of(vector: np.ndarray) -> Settings:
    """Name the parts of a packed vector; the arrays are views on it."""
    n = int(vector[0])
    m = int(vector[2])
    joint = vector[18 : 18 + 10 * n].reshape(10, n)
    rest = vector[18 + 10 * n :]
    return Settings(
        n=n,
        p=int(vector[1]),
        m=m,
        model=int(vector[3]),
        law=int(vector[4]),
        update=int(vector[5]),
        torque_source=int(vector[6]),
        window=int(vector[7]),
        interval=int(vector[8]),
        time_constant=vector[9],
        boundary_layer=vector[10],
        eta=vector[11],
        kappa=vector[12],
        rho=vector[13],
        sigma=vector[14],
        learning_start=vector[15],
        pole=vector[16],
        radius=vector[17],
        bound=joint[0],
        weight=joint[1],
        slope_limit=joint[2],
        knee=joint[3],
        K=joint[4],
        mu=joint[5],
        Kp=joint[6],
        d2=joint[7],
        gamma=joint[8],
        torque_limit=joint[9],
        Gamma=rest[:m],
        initial_estimate=rest[m : 2 * m],
        constants=rest[2 * m :],
    )
