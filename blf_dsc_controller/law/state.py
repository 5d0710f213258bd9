# SPDX-License-Identifier: Apache-2.0
"""Settings of a law, its state between samples, signals within one, telemetry: flat vectors.

Each part of the law has its own `Settings`, `State` and `Workspace` beside its functions.  Here
they are put together, with the arrays that a sample passes on from one part to the next.  A
`Workspace` that other parts read is among the `Signals`, any other is `Scratch`.

A controller is saved, restored and compared by copying and comparing its state vector:
the package keeps no other state of the loop.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

from blf_dsc_controller.arms.model import ArmModel
from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array, Cell, Passed, size_of, view_of
from blf_dsc_controller.law import (
    adaptation,
    barrier,
    change,
    columns,
    contact,
    disturbance,
    excitation,
    external_torque,
    feedback,
    friction,
    load_observer,
    motor_friction,
    payload,
    prediction,
    surface,
    torque,
    torque_sensors,
    window,
)


class Settings(NamedTuple):
    """Gains and choices of a law for n joints, p parameters and m - p disturbance columns.

    The model is passed to kernels as is, everything else in one vector.
    """

    model: ArmModel
    n: Passed
    p: Passed
    m: int
    memory: int  # numbers in the memory of a law of a file
    has_barrier: int  # 1: the law keeps the error inside its bound
    initial_estimate: Annotated[Array, 'm']  # P^(0), then that of the columns
    # mean of the prior of theta: P^(0) with the load that the tip is expected to hold
    prior_mean: Annotated[Array, 'm']
    # R, inverse covariance of the prior of theta
    information: Annotated[Array, 'm', 'm']
    # of the prior that rows are compared with, which doubts guessed drives
    row_information: Annotated[Array, 'm', 'm']
    # m, least inertia of a joint with the others free, kg m^2
    joint_inertia: Annotated[Array, 'n']
    barrier: barrier.Settings
    surface: surface.Settings
    feedback: feedback.Settings
    disturbance: disturbance.Settings
    observer: load_observer.Settings
    motors: motor_friction.Settings
    torque: torque.Settings
    columns: columns.Settings
    row: prediction.Settings
    window: window.Settings
    excitation: excitation.Settings
    adaptation: adaptation.Settings
    external: external_torque.Settings
    contact: contact.Settings
    friction: friction.Settings
    payload: payload.Settings


class State(NamedTuple):
    """Values that a law keeps from one sample to the next."""

    samples: Cell  # number of samples so far
    frozen: Cell  # s, for which nothing is learned
    alpha2: Annotated[Array, 'n']  # rad/s
    torque: Annotated[Array, 'n']  # last commanded torque, N m
    disturbance: Annotated[Array, 'n']  # d^3, N m
    estimate: Annotated[Array, 'm']  # theta^ = [P^; columns]
    feedback: feedback.State
    saturation: torque.State
    row: prediction.State
    observer: load_observer.State
    motors: motor_friction.State
    sensors: torque_sensors.State
    latch: excitation.State
    change: change.State
    external: external_torque.State
    contact: contact.State
    friction: friction.State
    payload: payload.State
    memory: Annotated[Array, 'memory']  # of a law of a file
    window: window.State


class Momentum(NamedTuple):
    """What `momentum_regressor` of the model writes for a vector x: Yp P = M(q) x."""

    Yp: Annotated[Array, 'n', 'p']
    Yr: Annotated[Array, 'n', 'm']


class Scratch(NamedTuple):
    """What each part computes for itself: nothing of it outlasts the work of that part."""

    momentum: Momentum
    disturbance: disturbance.Workspace
    observer: load_observer.Workspace
    motors: motor_friction.Workspace
    window: window.Workspace
    latch: excitation.Workspace
    change: change.Workspace
    adaptation: adaptation.Workspace
    external: external_torque.Workspace
    contact: contact.Workspace
    payload: payload.Workspace


class Signals(NamedTuple):
    """Values of one sample that the parts of a law pass on to one another."""

    t: Cell  # s, since the start
    dt: Cell  # s, since the last sample
    q: Annotated[Array, 'n']  # rad
    dq: Annotated[Array, 'n']  # rad/s
    qr: Annotated[Array, 'n']  # rad
    dqr: Annotated[Array, 'n']  # rad/s
    ddqr: Annotated[Array, 'n']  # rad/s^2
    xi1: Annotated[Array, 'n']  # rad
    bound: Annotated[Array, 'n']  # k(t), rad
    dalpha2: Annotated[Array, 'n']  # rad/s^2
    xi2: Annotated[Array, 'n']  # rad/s
    model_torque: Annotated[Array, 'n']  # H(q, dq, v, a_f) P^(0), N m
    gear_torque: Annotated[Array, 'n']  # tau_L, of the learned model, N m
    applied: Annotated[Array, 'n']  # mean whole torque of the last interval, N m
    effort: Annotated[Array, 'n']  # measured torque of the last interval, N m
    demand: Annotated[Array, 'n']  # whole torque (28) before saturation, N m
    torque: Annotated[Array, 'n']  # commanded torque, N m
    H: Annotated[Array, 'n', 'm']  # of what is learned: [H | compensated columns]
    barrier: barrier.Workspace
    surface: surface.Workspace
    feedback: feedback.Workspace
    saturation: torque.Workspace
    row: prediction.Workspace
    sensors: torque_sensors.Workspace
    friction: friction.Workspace
    scratch: Scratch


class Sample(NamedTuple):
    """Telemetry of one sample; a run is a matrix of such rows."""

    qr: Annotated[Array, 'n']  # rad
    dqr: Annotated[Array, 'n']  # rad/s
    xi1: Annotated[Array, 'n']  # rad
    xi2: Annotated[Array, 'n']  # rad/s
    torque: Annotated[Array, 'n']  # commanded, after saturation, N m
    # d^3, r of `load_observer` and learned friction, N m
    disturbance: Annotated[Array, 'n']
    bound: Annotated[Array, 'n']  # k(t), rad
    # how the torque was cut: 0, LEVEL_CUT, RATE_CUT, or their sum
    cuts: Annotated[Array, 'n']
    # theta^; NaN for a disturbance column that has been rejected
    estimate: Annotated[Array, 'm']
    lambda_min: Cell  # of the current window's Phi
    latched: Cell  # 0 or 1
    changes: Cell  # number of changes of the arm that were detected
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
