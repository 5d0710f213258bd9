# SPDX-License-Identifier: Apache-2.0
"""Settings of a law: gains and choices, packed into one flat vector."""

from __future__ import annotations

from typing import Annotated, NamedTuple

from blf_dsc_controller.arms.model import ArmModel
from blf_dsc_controller.compiled.layout import Array, Fixed, view_of

CHOICES = {
    'surface': ('filtered', 'linear'),
    'prediction': ('filtered', 'lambda'),
    'update': ('gradient', 'newton'),
    'compensation': ('reference', 'state'),
}
"""Settings that are choices: the vector holds the index."""

LINEAR = CHOICES['surface'].index('linear')
FILTERED = CHOICES['prediction'].index('filtered')
NEWTON = CHOICES['update'].index('newton')
REFERENCE = CHOICES['compensation'].index('reference')


class Settings(NamedTuple):
    """Gains and choices of a law for n joints, p parameters and m - p disturbance columns.

    The model is passed to kernels as is, everything else in one vector.
    """

    model: ArmModel
    n: Fixed
    p: Fixed
    m: Fixed
    surface: int
    prediction: int
    update: int
    effort_is_whole: int  # 1: measured efforts contain what the drive adds, 0: they do not
    drive: int  # columns of the gravity that the drive adds; 0: it adds none
    drive_size: int  # of drive_chain
    compensation: int
    rotors_unsure: int  # 1: errors of the assumed rotor inertias are measured
    weighed: int  # m + 1 where the load in the tip is weighed, else 0
    window: int  # N, rows in tau_d
    row_interval: int  # samples between two rows of the window
    interval: int  # samples between two checks of the excitation
    bias: int  # 1: a constant column per joint
    viscous: int  # 1: a column dq_i per joint
    coulomb: int  # 1: a column tanh(dq_i / coulomb_velocity) per joint
    tones: int  # number of frequencies, each with a sine and a cosine column per joint
    truth_known: int  # 1: true_parameters and true_disturbance are valid
    feed_forward: int  # 1: the true disturbance is compensated, as by model_based
    bumpless: int  # 1: d^3 gives up what the prediction error adds to the torque
    change_detection: int  # 1: windows must be consistent (see `excitation`)
    time_constant: float  # lambda of (13), s
    eta: float  # leakage of (30)
    kappa: float  # weight of the prediction error
    rho: float  # regularisation of the Newton update
    sigma: float  # excitation threshold on lambda_min(Phi)
    learning_start: float  # tau_d + T_a, s
    residual_floor: float  # mean square residual that noise and unmodelled torque explain, (N m)^2
    anchor_weight: float  # pull to `anchor` while the window is empty
    prior_weight: float  # pull to `initial_estimate`, always
    motion_scale: float  # reference velocity below which rows count less, rad/s; 0: off
    damping_rate: float  # omega_v, of the damping by the initial estimate's inertia, 1/s
    pole: float  # of the regressor filter, rad/s
    lag: float  # of measured velocities and applied torques together, s
    omega: float  # of the differentiating filter (8), rad/s
    coulomb_velocity: float  # rad/s
    radius: float  # omega_a of (4)
    Wc: float  # leakage of P^ in (35)
    funnel_rate: float  # a, rate at which the bound narrows, 1/s
    bound: Annotated[Array, 'n']  # k_c, rad
    initial_bound: Annotated[Array, 'n']  # k_0, rad; k_c: constant bound
    weight: Annotated[Array, 'n']  # w, N m/rad; of z1 in (35)
    slope_limit: Annotated[Array, 'n']  # S_lim, N m/rad
    knee: Annotated[Array, 'n']  # error at which the slope reaches S_lim if the bound is k_c, rad
    K: Annotated[Array, 'n']  # 1/s; lambda_s of (35)
    mu: Annotated[Array, 'n']  # 1/s
    Kp: Annotated[Array, 'n']  # N m s/rad
    d2: Annotated[Array, 'n']  # N m/rad
    mu_bar: Annotated[Array, 'n']  # N m
    gamma: Annotated[Array, 'n']  # gain of (30)
    row_weight: Annotated[Array, 'n']  # of a joint's rows: smaller where more torque is unmodelled
    torque_limit: Annotated[Array, 'n']  # N m
    rate_limit: Annotated[Array, 'n']  # N m/s; 0: none
    true_disturbance: Annotated[Array, 4, 'n']  # constant, then amplitude, frequency, phase
    Gamma: Annotated[Array, 'm']  # diagonal of the adaptation gain
    initial_estimate: Annotated[Array, 'm']  # P^(0), then that of the columns
    information: Annotated[Array, 'm', 'm']  # R, inverse covariance of the prior of theta
    variance: Annotated[Array, 'm']  # diagonal of R^-1
    unsure_rotor: Annotated[Array, 'n']  # assumed rotor inertias J that are a guess, kg m^2
    joint_inertia: Annotated[Array, 'n']  # with the others free, kg m^2
    link_inertia: Annotated[Array, 'n']  # likewise, without J
    least: Annotated[Array, 'm']  # value that theta^ can have: friction is not negative
    most: Annotated[Array, 'm']  # value that theta^ can have
    true_parameters: Annotated[Array, 'p']
    frequencies: Annotated[Array, 'tones']  # of the sine and cosine columns, rad/s
    load_columns: Annotated[Array, 'weighed', 10]  # N D of `weighing`, and a row of zeros
    load_scale: Annotated[Array, 4, 10]  # rows of D: mass [kg] and moments [kg m] in the tip
    drive_chain: Annotated[Array, 'drive_size']  # `Bodies` of the drive's model, with its memory
    drive_inertias: Annotated[Array, 'drive']  # masses [kg] and moments [kg m] of the drive's model


settings_of = view_of(Settings)
