# SPDX-License-Identifier: Apache-2.0
"""Settings of a law, its state between samples, signals within one, telemetry: flat vectors.

A controller is saved, restored and compared by copying and comparing its state vector: the package
keeps no other state of the loop.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

from blf_dsc_controller.arms.model import ArmModel
from blf_dsc_controller.compiled.layout import Array, Cell, Fixed, size_of, view_of

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


class State(NamedTuple):
    """Values that a law keeps from one sample to the next."""

    samples: Cell  # number of samples so far
    cursor: Cell  # index of the oldest row of the window
    rows: Cell  # number of rows in the window
    latched: Cell  # 1 while a window (Phi_e, b_e) is latched
    latch_time: Cell  # T_e, s
    lambda_min: Cell  # of Phi at the last check
    best_lambda: Cell  # largest of a full window since the last change, with decay
    columns_checked: Cell  # 1 once the disturbance columns are accepted or rejected
    residual: Cell  # mean square torque residual of the latched window, (N m)^2
    least_residual: Cell  # smallest residual of any full window, (N m)^2
    split_residual: Cell  # of the last first window that its parts contradicted, (N m)^2
    recent_residual: Cell  # of the last rows against `solution`, (N m)^2
    changes: Cell  # number of times that the arm was found to have changed
    contradiction: Cell  # `recent_residual` at the last change, (N m)^2
    alpha2: Annotated[Array, 'n']  # rad/s
    torque: Annotated[Array, 'n']  # last commanded torque, N m
    added: Annotated[Array, 'n']  # what the drive added to it then, N m
    disturbance: Annotated[Array, 'n']  # d^3, N m
    observed: Annotated[Array, 'n']  # xi2 filtered by (8), rad/s
    observed_rate: Annotated[Array, 'n']  # its derivative, rad/s^2
    level_cuts: Annotated[Array, 'n']  # number of samples in which the torque was cut at its limit
    rate_cuts: Annotated[Array, 'n']  # number of samples in which it was cut at its rate limit
    estimate: Annotated[Array, 'm']  # theta^ = [P^; columns]
    momentum: Annotated[Array, 'n', 'p']  # Yp of the last sample
    rest: Annotated[Array, 'n', 'm']  # [Yr | columns] of the last sample
    filter1: Annotated[Array, 'n', 'm + 1']  # first pole of the regressor filter
    filter2: Annotated[Array, 'n', 'm + 1']  # second pole
    running: Annotated[Array, 'm + 1', 'm + 1']  # S of the window
    fresh: Annotated[Array, 'm + 1', 'm + 1']  # F of the window
    half: Annotated[Array, 'm + 1', 'm + 1']  # L of the window
    Phi: Annotated[Array, 'm', 'm']  # latched Phi_e
    b: Annotated[Array, 'm']  # latched b_e
    factor: Annotated[Array, 'm', 'm']  # Cholesky factor of Phi_e + rho R
    solution: Annotated[Array, 'm']  # of the latched window, (Phi_e + rho R)^-1 b_e
    anchor: Annotated[Array, 'm']  # theta^ to which windows with little information are pulled
    min_eigenvector: Annotated[Array, 'm']  # x of Phi x = lambda R x, x^T R x = 1
    active: Annotated[Array, 'm']  # 0 where a disturbance column has been rejected
    lags: Annotated[Array, 14, 'n']  # of `apparent_inertia`
    rotor_sums: Annotated[Array, 2, 'n']  # of z (tau - M_0 a) and z a
    rotor_error: Annotated[Array, 'n']  # J~ <= 0 of the assumed rotor inertias, kg m^2
    gain_scale: Annotated[Array, 'n']  # measured inertia of each joint over the assumed
    since_latch: Cell  # s
    column_lags: Annotated[Array, 2, 'n']  # of c_h in `friction`
    torque_lags: Annotated[Array, 2, 'n']  # of e_h, N m
    flip_sums: Annotated[Array, 2, 'n']  # p int c_h e_h dt, N m, and p int c_h^2 dt
    weighed_rows: Annotated[Array, 3]  # moving rows of the first window, and of two parts since
    weighed_sums: Annotated[Array, 3, 'weighed', 'weighed']  # of their [X | u]^T [X | u]
    weighed_model: Annotated[Array, 'weighed']  # theta with the load
    weighed_noise: Annotated[Array, 2]  # mean square residual before and since, (N m)^2
    weighed_recent: Cell  # of the last rows, (N m)^2
    weighed_changes: Cell  # `changes` at the last row
    weighing_wait: Cell  # rows until the filters have settled
    load: Annotated[Array, 8]  # mass [kg] and centre [m] in the tip, their deviations; 0: unknown
    ring: Annotated[Array, 'window', 'n', 'm + 1']  # the window's rows


class Signals(NamedTuple):
    """Values that a law reads and computes in one sample."""

    q: Annotated[Array, 'n']  # rad
    dq: Annotated[Array, 'n']  # rad/s
    qr: Annotated[Array, 'n']  # rad
    dqr: Annotated[Array, 'n']  # rad/s
    ddqr: Annotated[Array, 'n']  # rad/s^2
    xi1: Annotated[Array, 'n']  # rad
    beta2: Annotated[Array, 'n']  # rad/s
    dalpha2: Annotated[Array, 'n']  # rad/s^2
    xi2: Annotated[Array, 'n']  # rad/s
    damped: Annotated[Array, 'n']  # alpha2' - omega_v xi2, rad/s^2
    model_torque: Annotated[Array, 'n']  # H(q, dq, alpha2, damped) P^(0), N m
    known: Annotated[Array, 'n']  # disturbance known to the law, N m
    acceleration: Annotated[Array, 'n']  # estimated ddq, rad/s^2
    added: Annotated[Array, 'n']  # torque that the drive adds to the command, N m
    applied: Annotated[Array, 'n']  # mean whole torque of the last interval, N m
    demand: Annotated[Array, 'n']  # whole torque (28) before saturation, N m
    torque: Annotated[Array, 'n']  # commanded torque, N m
    cuts: Annotated[Array, 'n']  # how the torque was cut: 0, LEVEL_CUT, RATE_CUT, or their sum
    bound: Annotated[Array, 'n']  # k(t), rad
    knee: Annotated[Array, 'n']  # knee of the barrier for that bound, rad
    narrowing: Annotated[Array, 'n']  # k'/k, 1/s
    H: Annotated[Array, 'n', 'm']  # of what is learned: [H | compensated columns]
    momentum: Annotated[Array, 'n', 'p']  # Yp
    rest: Annotated[Array, 'n', 'm']  # [Yr | columns]
    row: Annotated[Array, 'n', 'm + 1']  # filtered [X | u]
    Phi: Annotated[Array, 'm', 'm']  # of the current window
    b: Annotated[Array, 'm']
    factor: Annotated[Array, 'm', 'm']
    newer: Annotated[Array, 'm + 1', 'm + 1']  # sum of the newer part of the window
    part: Annotated[Array, 'm + 1', 'm + 1']  # of the part that is fitted
    inertia: Annotated[Array, 'n', 'n']  # M^(q) minus its least admissible value, or its factor
    unit: Annotated[Array, 'n']  # scratch
    still: Annotated[Array, 'n']  # zeros
    drive: Annotated[Array, 'n', 'drive']  # columns of the gravity that the drive adds
    swing: Annotated[Array, 'n']  # acceleration in the band of `apparent_inertia`, rad/s^2
    rate: Annotated[Array, 'm']  # theta^' [1/s]
    work: Annotated[Array, 'm']  # scratch
    since: Annotated[Array, 'weighed', 'weighed']  # sum of the rows since the first window
    load_normal: Annotated[Array, 'weighed + 9', 'weighed + 9']  # normal equations, or their factor
    load_solution: Annotated[Array, 'weighed + 9']  # theta and z of `weighing`
    load_spread: Annotated[Array, 4, 10]  # scratch


class Sample(NamedTuple):
    """Telemetry of one sample; a run is a matrix of such rows."""

    qr: Annotated[Array, 'n']  # rad
    dqr: Annotated[Array, 'n']  # rad/s
    xi1: Annotated[Array, 'n']  # rad
    xi2: Annotated[Array, 'n']  # rad/s
    torque: Annotated[Array, 'n']  # commanded, after saturation, N m
    disturbance: Annotated[Array, 'n']  # d^3 plus the learned friction, N m
    bound: Annotated[Array, 'n']  # k(t), rad
    cuts: Annotated[Array, 'n']  # how the torque was cut: 0, LEVEL_CUT, RATE_CUT, or their sum
    estimate: Annotated[Array, 'm']  # theta^; NaN for a disturbance column that has been rejected
    lyapunov: Annotated[Array, 4]  # terms of (29): error, kinetic, parameters, disturbance; or NaN
    lambda_min: Cell  # of the current window's Phi
    latched: Cell  # 0 or 1
    changes: Cell  # number of times that the arm was found to have changed
    load: Annotated[Array, 8]  # of the state, with 95 % intervals (half); NaN where unknown


settings_of = view_of(Settings)
state_of, state_size = view_of(State), size_of(State)
signals_of, signals_size = view_of(Signals), size_of(Signals)
sample_of, sample_size = view_of(Sample), size_of(Sample)
