# SPDX-License-Identifier: Apache-2.0
"""Whether something touches the arm: external torque that is large, and of no load in the tip.

A contact is r of `external_torque` with r^T S^-1 r > h^2, unless a load explains it.  A load in
the tip with phi = D z adds X_L N D z (see `payload`).  Once r is past h, z ~ (0, 1) is filtered
from r, and only what is past h of S + X_L N D Cov(z) (X_L N D)^T is a contact: a load follows the
arm in every posture and acceleration, another force does not.  A load cannot have negative mass: an
arm that is known to hold no more than what z takes away presses on something.  A contact ends when
r has stayed below half of h, or when a load has explained it for `_EXPLAINED_TIME`.

`perception` calls `update` once r has settled.
"""

from math import sqrt
from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array, Cell

_CORRELATION_TIME = 0.2  # s, correlation time of r in the load filter
_FORGETTING_TIME = 1.0  # s, in which the filtered load returns to its prior
_CALM_TIME = 0.2  # s below half of the threshold, after which a contact is over
_EXPLAINED_TIME = 0.5  # s, likewise for a load that explains it
_NEGATIVE_SIGMAS = 3.0  # standard deviations below zero, from which a mass is negative

QUIET, EXPLAINED, TOUCHED = range(3)
"""Phases: r is small; it is large, but a load explains it; something touches the arm."""


class Settings(NamedTuple):
    """The parameters `contact.*`, but for the bandwidth of r."""

    enabled: int  # 1: r is computed, and contacts are detected
    threshold: float  # h
    loads: int  # 1: what a load in the tip explains is not a contact
    freezes: int  # 1: nothing is learned while something touches the arm


class State(NamedTuple):
    """What is kept from one sample to the next."""

    phase: Cell  # QUIET, EXPLAINED or TOUCHED
    calm: Cell  # s, since r has been small
    explained: Cell  # s, since a load has explained a contact
    load: Annotated[Array, '10 * contact.enabled']  # z, filtered from r
    load_covariance: Annotated[Array, '10 * contact.enabled', 10]


class Workspace(NamedTuple):
    """Scratch of one sample."""

    columns: Annotated[Array, 'n * contact.enabled', 10]  # X_L N D, whitened
    load: Annotated[Array, '10 * contact.enabled']  # z by this sample alone
    load_covariance: Annotated[Array, '10 * contact.enabled', 10]
    gain: Annotated[Array, '10 * contact.enabled']


class Residual(NamedTuple):
    """The external torque r of a sample, with its covariance."""

    rows: Array  # [X_L | u_L] (n, m + 1)
    spread: Array  # factor of S (n, n)
    white: Array  # r (n,), whitened by it
    distance: float  # its length


class TipLoad(NamedTuple):
    """How a load in the tip acts, and what the tip is known to hold."""

    columns: Array  # of `payload`: those of N D are first
    scale: Array  # rows of D, likewise: mass [kg] and moments [kg m]
    mass: float  # kg
    deviation: float  # of the mass, kg; infinite where it is unknown


@inner
def is_touched(state: State) -> bool:
    """Whether something touches the arm."""
    return bool(state.phase[0] == TOUCHED)


@inner
def kalman_update(
    columns: Array,
    e: Array,
    noise: float,
    z: Array,
    covariance: Array,
    workspace: Array,
) -> float:
    """Update z (k,) and its covariance (k, k) by e = columns z + white noise of variance `noise`.

    A Kalman filter whose entries of e (n,) come one after the other.  `columns` is (n, k),
    `workspace` (k,) scratch.  Returns the sum of the squared innovations, each over its variance.
    """
    size = z.size
    square = 0.0
    for i in range(e.size):
        innovation = e[i]
        variance = noise
        for a in range(size):
            innovation -= columns[i, a] * z[a]
            workspace[a] = 0.0
            for b in range(size):
                workspace[a] += covariance[a, b] * columns[i, b]
            variance += columns[i, a] * workspace[a]
        square += innovation * innovation / variance
        for a in range(size):
            z[a] += workspace[a] * innovation / variance
            for b in range(size):
                covariance[a, b] -= workspace[a] * workspace[b] / variance
    return square


@inner
def forget_load(state: State) -> None:
    """Return to the prior of the load."""
    for a in range(state.load.size):
        state.load[a] = 0.0
        for b in range(state.load.size):
            state.load_covariance[a, b] = 1.0 if a == b else 0.0


@inner
def fill_load_columns(
    workspace: Workspace, residual: Residual, load_columns: Array
) -> None:
    """Compute -X_L N D (n, 10), whitened by the factor of S, as `workspace.columns`.

    The sign is that of a load which X theta^ = u + r lacks.  `load_columns` (m, 10 or more) are
    N D first.
    """
    rows, spread, columns = residual.rows, residual.spread, workspace.columns
    n = rows.shape[0]
    m = rows.shape[1] - 1
    for a in range(columns.shape[1]):
        for i in range(n):
            columns[i, a] = 0.0
            for j in range(m):
                columns[i, a] -= rows[i, j] * load_columns[j, a]
        for k in range(n):
            columns[k, a] *= spread[k, k]
            for i in range(k + 1, n):
                columns[i, a] -= spread[k, i] * columns[k, a]


@inner
def filter_load(state: State, workspace: Workspace, white: Array, dt: float) -> float:
    """Filter z of the load from r, which is `white` (n,); return the distance of r from any load.

    That distance is by this sample alone, with the filtered z as prior.  `dt` [s] is the sample
    time.
    """
    size = state.load.size
    gain = min(1.0, dt / _FORGETTING_TIME)
    for a in range(size):
        state.load[a] -= gain * state.load[a]
        workspace.load[a] = state.load[a]
        for b in range(size):
            prior = 1.0 if a == b else 0.0
            state.load_covariance[a, b] += gain * (prior - state.load_covariance[a, b])
            workspace.load_covariance[a, b] = state.load_covariance[a, b]
    square = kalman_update(
        workspace.columns,
        white,
        1.0,
        workspace.load,
        workspace.load_covariance,
        workspace.gain,
    )
    kalman_update(
        workspace.columns,
        white,
        _CORRELATION_TIME / dt,
        state.load,
        state.load_covariance,
        workspace.gain,
    )
    return sqrt(square)


@inner
def removes_too_much_mass(state: State, load: TipLoad) -> bool:
    """Whether the filtered load removes more mass than the tip holds, by three deviations."""
    mass = load.mass
    variance = load.deviation * load.deviation
    for a in range(state.load.size):
        mass += load.scale[0, a] * state.load[a]
        for b in range(state.load.size):
            scale = load.scale[0, a] * load.scale[0, b]
            variance += scale * state.load_covariance[a, b]
    return bool(mass < -_NEGATIVE_SIGMAS * sqrt(variance))


@inner
def is_small(phase: float, distance: float, threshold: float) -> bool:
    """Whether a `distance` of r is within the threshold h, or h / 2 of a contact that lasts."""
    return bool(distance <= (0.5 if phase == TOUCHED else 1.0) * threshold)


@inner
def next_phase(
    phase: float,
    distance: float,
    remaining: float,
    calm: float,
    explained: float,
    threshold: float,
) -> int:
    """Return the phase that follows: QUIET, EXPLAINED or TOUCHED.

    Args:
        phase: the phase so far.
        distance: of r from zero, in standard deviations.
        remaining: of r from what a load explains.
        calm: time for which r has been small [s].
        explained: time for which a load has explained a contact [s].
        threshold: h.
    """
    if is_small(phase, distance, threshold):
        return TOUCHED if phase == TOUCHED and calm < _CALM_TIME else QUIET
    if remaining > threshold:
        return TOUCHED
    return TOUCHED if phase == TOUCHED and explained < _EXPLAINED_TIME else EXPLAINED


@inner
def update(
    settings: Settings,
    state: State,
    workspace: Workspace,
    residual: Residual,
    load: TipLoad,
    dt: float,
) -> float:
    """Update the phase by r of a sample, `dt` [s] long; return the distance that is unexplained.

    A load in the tip explains r if `settings.loads`, unless its mass would be negative.
    """
    phase = state.phase[0]
    distance = remaining = residual.distance
    if is_small(phase, distance, settings.threshold):
        state.calm[0] += dt
        state.explained[0] = 0.0
    else:
        state.calm[0] = 0.0
        if settings.loads == 1:
            fill_load_columns(workspace, residual, load.columns)
            unexplained = filter_load(state, workspace, residual.white, dt)
            if not removes_too_much_mass(state, load):
                remaining = unexplained
        is_explained = phase == TOUCHED and not remaining > settings.threshold
        state.explained[0] = state.explained[0] + dt if is_explained else 0.0
    state.phase[0] = next_phase(
        phase,
        distance,
        remaining,
        state.calm[0],
        state.explained[0],
        settings.threshold,
    )
    if state.phase[0] == QUIET or remaining > settings.threshold:
        forget_load(state)
    return remaining
