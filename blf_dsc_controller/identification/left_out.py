# SPDX-License-Identifier: Apache-2.0
"""Columns of what the model leaves out, for `wider_model`: friction, sensors, elastic joints.

Each kind has one or more columns of every joint, in units that are of order 1 if they
matter:

    fading       Coulomb friction fades with speed, in one of four ways
    contact      contacts slide after another distance
    direction    friction is larger in one direction: |v|
    load         friction grows with the torque that moves the bodies: gears lose a part of it
    gain         the torque of the joint is measured with another gain
    elasticity   the link lags behind its motor, which has the encoder, by torque / stiffness
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.arms.serial_chain import SerialChain
from blf_dsc_controller.bags.on_disk import Samples, mapped
from blf_dsc_controller.identification.recording import Indices
from blf_dsc_controller.identification.sliding import DISTANCES
from blf_dsc_controller.identification.values import (
    COULOMB,
    LOAD,
    OFFSET,
    ROTOR_INERTIA,
    VISCOUS,
    parts,
)
from blf_dsc_controller.identification.windows import (
    STILL,
    Rows,
    add_windows,
    of_each_joint,
    smoothing_width,
    weighting,
)
from blf_dsc_controller.run import Floats

KINDS = ('fading', 'contact', 'direction', 'load', 'gain', 'elasticity')
"""What the model may leave out."""

LARGEST = np.array((1.0, 1.0, 1.0, 0.2, 0.2, 3.0))
"""Largest plausible standard deviation of the columns of each kind."""

# rad/s or m/s, and exponent: scales and shapes that are published for gears and
# bearings
_FADINGS = ((0.05, 2.0), (0.2, 2.0), (0.1, 1.0), (0.4, 1.0))
_SMALL = 0.01  # of a joint's largest torque, least friction that is a unit
_TWIST = 0.01  # rad or m, unit of what a joint gives way under its largest torque
_STEP = 0.1  # of that twist, by which columns are differences
_TINY = 1e-6  # N m or N, least torque of a joint that scales its twist


class LeftOut(NamedTuple):
    """Columns of R windows and n joints: e of each joint itself, and the twist of each joint."""

    own: Floats  # (R, e, n), N m or N
    elastic: Floats  # (R, n, n) torque of each joint by the twist of each
    kind: Indices  # (e n + n,) of each column, in KINDS

    def matrix(self, windows: Indices) -> Floats:
        """Return the columns (k, n, e n + n) of some windows."""
        own = of_each_joint(self.own[windows])
        return np.concatenate((own, self.elastic[windows]), axis=2)


def left_out(rows: Rows, model: SerialChain, G: Floats, values: Floats) -> LeftOut:
    """Return the columns for the values of a fit, and the rows that it has (`Fit`)."""
    columns = [*_of_friction(rows, values), *_of_torque(rows, G @ values)]
    kinds = [KINDS.index(kind) for kind, _ in columns]
    return LeftOut(
        np.stack([column for _, column in columns], axis=1),
        _elastic(rows, model, G, values),
        np.repeat([*kinds, KINDS.index('elasticity')], rows.speed.size),
    )


def _of_friction(rows: Rows, values: Floats) -> Iterator[tuple[str, Floats]]:
    """Yield kinds and columns (R, n) of other laws of friction."""
    terms = parts(values).terms
    least = _SMALL * rows.largest_torque
    coulomb = np.maximum(terms[COULOMB], least)
    speed = np.maximum(rows.speed, STILL)
    viscous = np.maximum(terms[VISCOUS], least / speed)
    contacts = (np.full(speed.size, distance) for distance in DISTANCES)
    sliding = [rows.with_sliding(each).columns['Coulomb'] for each in contacts]
    for fading in _FADINGS:
        yield 'fading', coulomb * rows.stribeck(*fading)
    for a, b in pairwise(sliding):
        yield 'contact', coulomb * (b - a)
    yield 'direction', viscous * rows.speeds


def _of_torque(rows: Rows, theta: Floats) -> Iterator[tuple[str, Floats]]:
    """Yield kinds and columns (R, n) in proportion to the torques of the unknowns `theta`.

    Measured torques would explain themselves.
    """
    of_bodies = theta.copy()
    of_bodies[rows.p : rows.unknowns - LOAD] = 0.0
    everything = np.arange(rows.time.size)
    loads = np.abs(rows.torques(everything, of_bodies))
    yield 'load', loads * rows.columns['Coulomb']
    yield 'gain', rows.torques(everything, theta)


def _elastic(rows: Rows, model: SerialChain, G: Floats, values: Floats) -> Floats:
    """Return what the links' torque (R, n, n) changes by if joints give way.

    The link of a joint is at  q - s / K  if its motor is at q and transmits the torque s.
    Every hundredth of a second is enough: these columns are smooth.
    """
    n = rows.speed.size
    links = values.copy()
    parts(links).terms[ROTOR_INERTIA] = 0.0
    theta = G @ links
    P = theta[: rows.p]
    P_loaded = P + rows.load @ theta[rows.unknowns - LOAD : rows.unknowns]
    transmitted = transmitted_torques(rows, values)
    twist = _TWIST / np.maximum(rows.largest_torque, _TINY)
    steps = np.vstack((np.zeros(n), np.diag(_STEP * twist)))
    g, slope = weighting(rows.every * rows.period)
    regressors = np.zeros((2, n, rows.p))
    found = np.zeros((rows.starts.size, n, n))
    for block, samples in rows.in_blocks():
        starts = np.round((rows.starts[block] - samples.start) / rows.every)
        q, dq, s = (
            each[samples][:: rows.every] for each in (rows.q, rows.dq, transmitted)
        )
        starts = np.minimum(starts, len(q) - g.size).astype(np.intp)
        carries = rows.carried.at(rows.time[block, None])
        P_of = np.where(carries, P_loaded, P)
        torques = []  # of rigid joints, and with each of them giving way
        for step in steps:
            X = np.zeros((starts.size, n, rows.p))
            at, speed = q - step * s[:, :n], dq - step * s[:, n:]
            add_windows(model, at, speed, g, slope, starts, regressors, X)
            torques.append(np.einsum('kip,kp->ki', X, P_of))
        rigid, *others = torques
        found[block] = (np.stack(others, axis=2) - rigid[:, :, None]) / _STEP
    return found


def transmitted_torques(rows: Rows, values: Floats) -> Samples:
    """Return the torque that each joint transmits to its link, and its rate (N, 2 n)."""
    from scipy.signal import savgol_filter

    h = rows.period
    width = smoothing_width(h)
    terms = parts(values).terms

    def found(at: slice) -> Floats:
        dq = rows.dq[at]
        torque = savgol_filter(rows.torque[at], width, 3, axis=0)
        torque -= terms[ROTOR_INERTIA] * np.gradient(dq, h, axis=0)
        torque -= terms[VISCOUS] * dq + terms[COULOMB] * rows.sliding[at]
        torque -= terms[OFFSET]
        return np.hstack((torque, np.gradient(torque, h, axis=0)))

    return mapped(len(rows.q), found, width)
