# SPDX-License-Identifier: Apache-2.0
"""What the law of friction leaves open: variances of viscous and Coulomb friction.

A fit cannot tell that its law of friction is not the joint's: it finds other viscous
and Coulomb friction, with narrow intervals.  So the recording is also fitted with other
laws: a Stribeck term in all joints, which fades in other ways.  For each joint, those
that predict its torque about as well are as likely; the farthest of their values is one
standard deviation off.
"""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.arms.friction import STRIBECK_SPEED
from blf_dsc_controller.identification.prior import Prior
from blf_dsc_controller.identification.problem import Problem
from blf_dsc_controller.identification.regression import Regression, regression
from blf_dsc_controller.identification.selection import cross_validated
from blf_dsc_controller.identification.values import COULOMB, STRIBECK, VISCOUS, indices
from blf_dsc_controller.run import Floats

# rad/s or m/s, and exponent: scales and shapes that are published for gears and
# bearings
_LAWS = ((0.05, 2.0), (0.2, 2.0), (0.1, 1.0), (0.4, 1.0))
_AS_WELL = 1.2  # times the least rms error in cross-validation


def friction_doubt(problem: Problem, prior: Prior, near: Regression) -> Floats:
    """Return a covariance (17 n + 14, 17 n + 14) to be added to that of the fit with `prior`.

    Solutions are looked for from that of a problem `near` them.
    """
    at = indices(prior.joints)
    D = prior.D.copy()
    fading = at.terms[STRIBECK]
    D[:, fading] = problem.prior.D[:, fading]
    other = prior._replace(D=D)
    values, least = _solution(problem, prior, near)
    found = []
    errors = []
    for speed, exponent in _LAWS:
        problem.rows.set_stribeck(speed, exponent)
        others, error = _solution(problem, other, near)
        found.append(others - values)
        errors.append(error)
        least = np.minimum(least, error)
    problem.rows.set_stribeck(STRIBECK_SPEED, 2.0)
    as_well = np.array(errors) <= _AS_WELL**2 * least
    variance = np.zeros_like(values)
    for term in (VISCOUS, COULOMB):
        entries = at.terms[term]
        off = np.array(found)[:, entries] * as_well
        variance[entries] = np.max(off**2, axis=0)
    return np.diag(variance)


def _solution(
    problem: Problem, prior: Prior, near: Regression
) -> tuple[Floats, Floats]:
    """Return the values (17 n + 14,) without bounds, and the joints' squared errors (n,)."""
    found = regression(problem.rows, problem.windows.moving, problem.G, prior, near)
    information = found.A.T @ found.A + np.eye(found.A.shape[1])
    z = np.linalg.solve(information, found.A.T @ found.b)
    used = prior.D.any(axis=0).astype(float)
    of_joints = cross_validated(found, used).sum(axis=0)
    return prior.mean + prior.D @ z, of_joints * found.deviation**2
