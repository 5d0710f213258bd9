# SPDX-License-Identifier: Apache-2.0
"""Settings of a law, its state between samples, signals within one, telemetry: flat vectors.

A controller is saved, restored and compared by copying and comparing its state vector:
the package keeps no other state of the loop.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

from blf_dsc_controller.arms.model import ArmModel
from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array, Cell, Passed, size_of, view_of
from blf_dsc_controller.law import apparent_inertia, external_torque, friction, weighing

CHOICES = {
    'prediction': ('filtered', 'lambda'),
    'update': ('gradient', 'newton'),
    'compensation': ('reference', 'state'),
}
"""Settings that are choices: the vector holds the index."""

FILTERED = CHOICES['prediction'].index('filtered')
NEWTON = CHOICES['update'].index('newton')
REFERENCE = CHOICES['compensation'].index('reference')


class Settings(NamedTuple):
    """Gains and choices of a law for n joints, p parameters and m - p disturbance columns.

    The model is passed to kernels as is, everything else in one vector.
    """

    model: ArmModel
    n: Passed
    p: Passed
    m: int
    prediction: int
    update: int
    has_barrier: int  # 1: the law keeps the error inside its bound
    # 1: measured efforts contain what the drive adds, 0: they do not
    effort_is_whole: int
    drive: int  # columns of the gravity that the drive adds; 0: it adds none
    drive_size: int  # of drive_chain
    compensation: int
    # 1: barrier and d^3 act through M(q, P^(0)) / m
    follows_inertia: int
    decoupled: int  # 1: no feedback acts through M(q, P^(0))
    known_rate: int  # 1: the surface filter follows the known rate of beta2
    memory: int  # numbers in the memory of a law of a file
    window: int  # N, rows in tau_d
    row_interval: int  # samples between two rows of the window
    interval: int  # samples between two checks of the excitation
    bias: int  # 1: a constant column per joint
    viscous: int  # 1: a column dq_i per joint
    coulomb: int  # 1: a column tanh(dq_i / coulomb_velocity) per joint
    tones: int  # number of frequencies, each with a sine and a cosine column per joint
    # number of ripple cycles, each with a sine and a cosine column per joint
    ripples: int
    truth_known: int  # 1: true_parameters and true_disturbance are valid
    feed_forward: int  # 1: the true disturbance is compensated, as by model_based
    bumpless: int  # 1: d^3 gives up what the prediction error adds to the torque
    change_detection: int  # 1: windows must be consistent (see `excitation`)
    eta: float  # leakage of (30)
    kappa: float  # weight of the prediction error
    rho: float  # regularisation of the Newton update
    sigma: float  # excitation threshold on lambda_min(Phi)
    learning_start: float  # tau_d + T_a, s
    # mean square residual that noise and unmodelled torque explain, (N m)^2
    residual_floor: float
    anchor_weight: float  # pull to `anchor` while the window is empty
    prior_weight: float  # pull to `initial_estimate`, always
    motion_scale: float  # reference velocity below which rows count less, rad/s; 0: off
    # omega_v, of the damping by the initial estimate's inertia, 1/s
    damping_rate: float
    pole: float  # of the regressor filter, rad/s
    # a of the covariance of theta: variance of rows that count
    row_variance: float
    lag: float  # of measured velocities and applied torques together, s
    time_constant: float  # lambda of (13), s
    omega: float  # of the differentiating filter (8), rad/s
    coulomb_velocity: float  # rad/s
    radius: float  # omega_a of (4)
    Wc: float  # leakage of P^ in (35)
    funnel_rate: float  # a, rate at which the bound narrows, 1/s
    bound: Annotated[Array, 'n']  # k_c, rad
    initial_bound: Annotated[Array, 'n']  # k_0, rad; k_c: constant bound
    weight: Annotated[Array, 'n']  # w, N m/rad; of z1 in (35)
    slope_limit: Annotated[Array, 'n']  # S_lim, N m/rad
    # error at which the slope reaches S_lim if the bound is k_c, rad
    knee: Annotated[Array, 'n']
    K: Annotated[Array, 'n']  # 1/s; lambda_s of (35)
    mu: Annotated[Array, 'n']  # 1/s
    Kp: Annotated[Array, 'n']  # N m s/rad
    d2: Annotated[Array, 'n']  # N m/rad
    mu_bar: Annotated[Array, 'n']  # N m
    gamma: Annotated[Array, 'n']  # gain of (30)
    # of a joint's rows: smaller where more torque is unmodelled
    row_weight: Annotated[Array, 'n']
    torque_limit: Annotated[Array, 'n']  # N m
    rate_limit: Annotated[Array, 'n']  # N m/s; 0: none
    # constant, then amplitude, frequency, phase
    true_disturbance: Annotated[Array, 4, 'n']
    Gamma: Annotated[Array, 'm']  # diagonal of the adaptation gain
    initial_estimate: Annotated[Array, 'm']  # P^(0), then that of the columns
    # R, inverse covariance of the prior of theta
    information: Annotated[Array, 'm', 'm']
    variance: Annotated[Array, 'm']  # diagonal of R^-1
    # m, least inertia of a joint with the others free, kg m^2
    joint_inertia: Annotated[Array, 'n']
    least: Annotated[Array, 'm']  # value that theta^ can have: friction is not negative
    most: Annotated[Array, 'm']  # value that theta^ can have
    true_parameters: Annotated[Array, 'p']
    frequencies: Annotated[Array, 'tones']  # of the sine and cosine columns, rad/s
    ripple_cycles: Annotated[Array, 'ripples']  # periods per turn
    # `Bodies` of the drive's model, with its memory
    drive_chain: Annotated[Array, 'drive_size']
    # masses [kg] and moments [kg m] of the drive's model
    drive_inertias: Annotated[Array, 'drive']
    contact: external_torque.Settings
    friction: friction.Settings
    rotors: apparent_inertia.Settings
    weighing: weighing.Settings


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
    # of the last first window that its parts contradicted, (N m)^2
    split_residual: Cell
    recent_residual: Cell  # of the last rows against `solution`, (N m)^2
    # of `change`, until a full window is known to be of one arm: theta of the rows so
    # far, the factor of its equations, and the statistics of `innovation`
    rows_fit: Annotated[Array, 'm']
    rows_factor: Annotated[Array, 'm', 'm']
    rows_statistics: Annotated[Array, 4]
    changes: Cell  # number of times that the arm was found to have changed
    contradiction: Cell  # `recent_residual` at the last change, (N m)^2
    alpha2: Annotated[Array, 'n']  # rad/s
    torque: Annotated[Array, 'n']  # last commanded torque, N m
    added: Annotated[Array, 'n']  # what the drive added to it then, N m
    # demand beyond the torque, that the rate limit has held back, N m
    held_back: Annotated[Array, 'n']
    takes_over: Cell  # 1: `torque` acts already when the first sample comes
    disturbance: Annotated[Array, 'n']  # d^3, N m
    observed: Annotated[Array, 'n']  # xi2 filtered by (8), rad/s
    observed_rate: Annotated[Array, 'n']  # its derivative, rad/s^2
    # number of samples in which the torque was cut at its limit
    level_cuts: Annotated[Array, 'n']
    # number of samples in which it was cut at its rate limit
    rate_cuts: Annotated[Array, 'n']
    estimate: Annotated[Array, 'm']  # theta^ = [P^; columns]
    Yp: Annotated[Array, 'n', 'p']  # Yp of the last sample
    Yr: Annotated[Array, 'n', 'm']  # [Yr | columns] of the last sample
    late: Annotated[
        Array, 2, 'n'
    ]  # applied torque behind half of `lag`, and behind all
    filter1: Annotated[Array, 'n', 'm + 1']  # first pole of the regressor filter
    filter2: Annotated[Array, 'n', 'm + 1']  # second pole
    running: Annotated[Array, 'm + 1', 'm + 1']  # S of the window
    fresh: Annotated[Array, 'm + 1', 'm + 1']  # F of the window
    half: Annotated[Array, 'm + 1', 'm + 1']  # L of the window
    Phi: Annotated[Array, 'm', 'm']  # latched Phi_e
    b: Annotated[Array, 'm']  # latched b_e
    factor: Annotated[Array, 'm', 'm']  # Cholesky factor of Phi_e + rho R
    solution: Annotated[Array, 'm']  # of the latched window, (Phi_e + rho R)^-1 b_e
    # theta^ to which windows with little information are pulled
    anchor: Annotated[Array, 'm']
    min_eigenvector: Annotated[Array, 'm']  # x of Phi x = lambda R x, x^T R x = 1
    active: Annotated[Array, 'm']  # 0 where a disturbance column has been rejected
    frozen: Cell  # s, for which nothing is learned
    contact: external_torque.State
    friction: friction.State
    rotors: apparent_inertia.State
    weighing: weighing.State
    memory: Annotated[Array, 'memory']  # of a law of a file
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
    # of beta2, as far as it is known before the filter (13); else zero, rad/s^2
    beta2_rate: Annotated[Array, 'n']
    xi2: Annotated[Array, 'n']  # rad/s
    restoring: Annotated[Array, 'n']  # torque by the error: -dV/dxi1 or -w z1, N m
    model_velocity: Annotated[Array, 'n']  # v of the model: alpha2, or dqr, rad/s
    # a of the model: alpha2' - omega_v xi2, with the restoring torque over m where the
    # feedback follows the inertia; ddqr where none of it does, rad/s^2
    damped: Annotated[Array, 'n']
    model_torque: Annotated[Array, 'n']  # H(q, dq, v, damped) P^(0), N m
    feedforward: Annotated[Array, 'n']  # known disturbance, fed forward, N m
    acceleration: Annotated[Array, 'n']  # estimated ddq, rad/s^2
    added: Annotated[Array, 'n']  # torque that the drive adds to the command, N m
    applied: Annotated[Array, 'n']  # mean whole torque of the last interval, N m
    demand: Annotated[Array, 'n']  # whole torque (28) before saturation, N m
    torque: Annotated[Array, 'n']  # commanded torque, N m
    # how the torque was cut: 0, LEVEL_CUT, RATE_CUT, or their sum
    cuts: Annotated[Array, 'n']
    bound: Annotated[Array, 'n']  # k(t), rad
    knee: Annotated[Array, 'n']  # knee of the barrier for that bound, rad
    narrowing: Annotated[Array, 'n']  # k'/k, 1/s
    H: Annotated[Array, 'n', 'm']  # of what is learned: [H | compensated columns]
    Yp: Annotated[Array, 'n', 'p']  # Yp P = M dq
    Yr: Annotated[Array, 'n', 'm']  # [Yr | columns], Yr P = G - C^T dq
    row: Annotated[Array, 'n', 'm + 1']  # filtered [X | u]
    Phi: Annotated[Array, 'm', 'm']  # of the current window
    b: Annotated[Array, 'm']
    factor: Annotated[Array, 'm', 'm']
    predicted: Annotated[Array, 'n', 'm']  # scratch of `innovation`
    innovation: Annotated[Array, 'n']
    covariance: Annotated[Array, 'n', 'n']
    newer: Annotated[Array, 'm + 1', 'm + 1']  # sum of the newer part of the window
    part: Annotated[Array, 'm + 1', 'm + 1']  # of the part that is fitted
    # M^(q) minus its least admissible value, or its factor
    inertia: Annotated[Array, 'n', 'n']
    unit: Annotated[Array, 'n']  # scratch
    zeros: Annotated[Array, 'n']
    drive: Annotated[Array, 'n', 'drive']  # columns of the gravity that the drive adds
    rate: Annotated[Array, 'm']  # theta^' [1/s]
    work: Annotated[Array, 'm']  # scratch
    contact: external_torque.Work
    friction: friction.Work
    rotors: apparent_inertia.Work
    weighing: weighing.Work


class Sample(NamedTuple):
    """Telemetry of one sample; a run is a matrix of such rows."""

    qr: Annotated[Array, 'n']  # rad
    dqr: Annotated[Array, 'n']  # rad/s
    xi1: Annotated[Array, 'n']  # rad
    xi2: Annotated[Array, 'n']  # rad/s
    torque: Annotated[Array, 'n']  # commanded, after saturation, N m
    disturbance: Annotated[Array, 'n']  # d^3 plus the learned friction, N m
    bound: Annotated[Array, 'n']  # k(t), rad
    # how the torque was cut: 0, LEVEL_CUT, RATE_CUT, or their sum
    cuts: Annotated[Array, 'n']
    # theta^; NaN for a disturbance column that has been rejected
    estimate: Annotated[Array, 'm']
    # terms of (29): error, kinetic, parameters, disturbance; or NaN
    lyapunov: Annotated[Array, 4]
    lambda_min: Cell  # of the current window's Phi
    latched: Cell  # 0 or 1
    changes: Cell  # number of times that the arm was found to have changed
    # of the state, with 95 % intervals (half); NaN where unknown
    load: Annotated[Array, 8]
    external: Annotated[Array, 'n * contact.enabled']  # r of `external_torque`, N m
    external_interval: Annotated[Array, 'n * contact.enabled']  # half of 95 %, N m
    # whether something touches the arm, and the distance of r from what explains it
    contact: Annotated[Array, '2 * contact.enabled']


_settings_of = view_of(Settings)


@inner
def settings_of(vector: Array, model: ArmModel) -> Settings:
    """Return the settings of a law for this arm: a view of their packed vector."""
    n, p = model.sizes()
    return _settings_of(vector, model, n, p)


state_of, state_size = view_of(State), size_of(State)
signals_of = view_of(Signals)
signals_size = size_of(Signals)
sample_of = view_of(Sample)
sample_size = size_of(Sample)
