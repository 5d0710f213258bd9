# SPDX-License-Identifier: Apache-2.0
"""The Lyapunov function (29) of the two-link arm, term by term, from what a run has recorded.

    V = sum_i w (k^2 / pi) tan s_i + xi2^T M xi2 / 2 + P~^T Gamma^-1 P~ / 2 + |d~|^2 / (2 gamma)

with s = pi xi1^2 / (2 k^2), past the knee of the barrier its parabola (`law.barrier`), P~ = P - P^
and d~ = tau_dist - d^3, of the parameters and joints that are adapted.  The truth is what the
simulated arm says of itself.
"""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.configuration.two_link import STEEPEST
from blf_dsc_controller.law.barrier import knee
from blf_dsc_controller.messages.topics import DISTURBANCE
from blf_dsc_controller.run import Floats, Run, Series

TERMS = ('barrier', 'velocity', 'parameters', 'disturbance')
"""Names of the terms of (29)."""

_BARRIERS = ('blf_dsc', 'paper', 'model_based')
_PARAMETERS = 3  # of two links


def energies(run: Run) -> Series | None:
    """Return the terms of (29) [J]; None where the truth is unknown, or (29) is not of the law."""
    given = run.parameters
    if given.get('law') not in _BARRIERS or given.get('robot.urdf'):
        return None
    truth, monitor = run.truth, run.monitor
    xi2, error, bound = run.xi2, run.error, run.bound
    if truth is None or monitor is None:
        return None
    if xi2 is None or error is None or bound is None:
        return None
    stamps = np.intersect1d(np.intersect1d(truth.stamp, monitor.stamp), run.stamp)
    rows, true, shown = (
        np.searchsorted(each, stamps)
        for each in (run.stamp, truth.stamp, monitor.stamp)
    )
    names = truth.names[:_PARAMETERS]
    learns = given.get('learning.enabled', True)
    disturbances = [DISTURBANCE + joint for joint in run.joints]
    P = truth.select(names)[true]
    off = P - monitor.select(names)[shown]
    missed = truth.select(disturbances)[true] - monitor.select(disturbances)[shown]
    with np.errstate(over='ignore', invalid='ignore'):  # of a run that diverges
        terms = (
            _potential(run, np.abs(error[rows]), bound[rows]),
            _kinetic(P, run.position[rows], xi2[rows]),
            _weighted(off, given['two_link.adaptation_gain'] if learns else 0.0),
            _weighted(missed, given['disturbance.gain']),
        )
    return Series(TERMS, stamps, np.stack(terms, axis=1))


def _potential(run: Run, error: Floats, k: Floats) -> Floats:
    """Return V1 (k,) for |xi1| and the bound (k, n)."""
    bound = np.array(run.parameters['barrier.bound'])
    w = np.array(run.parameters['two_link.barrier_weight'])
    limit = np.full(bound.shape, STEEPEST)
    at_bound = [knee(*joint) for joint in zip(bound, w, limit, strict=True)]
    edge = np.minimum(error, np.array(at_bound) * (k / bound))
    past = error - edge
    s = 0.5 * np.pi * (edge / k) ** 2
    inside = w * k**2 / np.pi * np.tan(s)
    slope = w * edge / np.cos(s) ** 2
    V = inside + past * (slope + 0.5 * limit * past)
    return np.asarray(V.sum(axis=1))


def _kinetic(P: Floats, q: Floats, xi2: Floats) -> Floats:
    """Return xi2^T M(q) xi2 / 2 (k,) for P (k, 3), q and xi2 (k, 2)."""
    first, second, coupling = P.T
    along = xi2.sum(axis=1)
    outer = second * along**2
    both = 2.0 * coupling * np.cos(q[:, 1]) * xi2[:, 0] * along
    return np.asarray(0.5 * (first * xi2[:, 0] ** 2 + outer + both))


def _weighted(error: Floats, gain: object) -> Floats:
    """Return the sum of squares (k,) over twice the gains, where these are above 0."""
    of = np.broadcast_to(np.array(gain, dtype=float), error.shape[-1:])
    adapted = of > 0.0
    return np.asarray((0.5 * error[:, adapted] ** 2 / of[adapted]).sum(axis=1))
