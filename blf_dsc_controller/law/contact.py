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

    enabled: int  # 1: r is found, and whether it is a contact
    threshold: float  # h
    loads: int  # 1: what a load in the tip explains is not a contact
    freezes: int  # 1: nothing is learned while something touches the arm


class State(NamedTuple):
    """What it keeps from one sample to the next."""

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
    """What `external_torque` sees."""

    rows: Array  # [X_L | u_L] (n, m + 1)
    spread: Array  # factor of S (n, n)
    white: Array  # r (n,), whitened by it
    distance: float  # its length


class TipLoad(NamedTuple):
    """How a load in the tip acts, and what is known to be held."""

    columns: Array  # of `payload`: those of N D are first
    scale: Array  # rows of D, likewise: mass [kg] and moments [kg m]
    mass: float  # kg
    deviation: float  # of the mass, kg; infinite where it is unknown


@inner
def is_touched(state: State) -> bool:
    """Whether something touches the arm."""
    return bool(state.phase[0] == TOUCHED)


@inner
def absorb(
    columns: Array,
    e: Array,
    noise: float,
    z: Array,
    covariance: Array,
    workspace: Array,
) -> float:
    """Update z and its covariance by e = columns z + white noise of variance `noise`.

    Returns the sum of the squared innovations, each over its variance.
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
    """Compute -X_L N D, whitened: the load is missing in X theta^ = u + r."""
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
    """Filter the load from r, which is `white` (n,); return how far r is from what any explains."""
    size = state.load.size
    gain = min(1.0, dt / _FORGETTING_TIME)
    for a in range(size):
        state.load[a] -= gain * state.load[a]
        workspace.load[a] = state.load[a]
        for b in range(size):
            prior = 1.0 if a == b else 0.0
            state.load_covariance[a, b] += gain * (prior - state.load_covariance[a, b])
            workspace.load_covariance[a, b] = state.load_covariance[a, b]
    square = absorb(
        workspace.columns,
        white,
        1.0,
        workspace.load,
        workspace.load_covariance,
        workspace.gain,
    )
    absorb(
        workspace.columns,
        white,
        _CORRELATION_TIME / dt,
        state.load,
        state.load_covariance,
        workspace.gain,
    )
    return sqrt(square)


@inner
def is_negative_mass(mass: float, variance: float) -> bool:
    """Whether a mass [kg] is below zero beyond doubt, with its variance [kg^2]."""
    return bool(mass < -_NEGATIVE_SIGMAS * sqrt(variance))


@inner
def removes_too_much_mass(state: State, load: TipLoad) -> bool:
    """Whether the filtered load takes away more mass than is held."""
    mass = load.mass
    variance = load.deviation * load.deviation
    for a in range(state.load.size):
        mass += load.scale[0, a] * state.load[a]
        for b in range(state.load.size):
            scale = load.scale[0, a] * load.scale[0, b]
            variance += scale * state.load_covariance[a, b]
    return is_negative_mass(mass, variance)


@inner
def explain_by_load(
    settings: Settings,
    state: State,
    workspace: Workspace,
    residual: Residual,
    load: TipLoad,
    dt: float,
) -> float:
    """Return the distance of r from what a load explains, or from zero if none does."""
    if settings.loads == 0:
        return residual.distance
    fill_load_columns(workspace, residual, load.columns)
    remaining = filter_load(state, workspace, residual.white, dt)
    return residual.distance if removes_too_much_mass(state, load) else remaining


@inner
def is_small(phase: float, distance: float, threshold: float) -> bool:
    """Whether r is too small for a contact, or for one that lasts."""
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
    """Return the phase that follows.

    r is at a `distance`, which a load leaves `remaining`.  It has been small for `calm`
    [s]; a load has explained a contact for `explained` [s].
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
    """Update the phase; return the distance of r from what explains it."""
    phase = state.phase[0]
    distance = remaining = residual.distance
    if is_small(phase, distance, settings.threshold):
        state.calm[0] += dt
        state.explained[0] = 0.0
    else:
        state.calm[0] = 0.0
        remaining = explain_by_load(settings, state, workspace, residual, load, dt)
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
