# SPDX-License-Identifier: Apache-2.0
"""Each joint alone, by all columns of its own torque and hardly any prior.

Such a fit knows nothing of masses, of the other joints or of physical bodies, and its
residual does not depend on the sign of the torque.  It shows how well the motion can be
explained at all, and which sign the friction has, which can only brake.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.identification.physical import left_of, most_likely
from blf_dsc_controller.identification.prior import Prior
from blf_dsc_controller.identification.recording import Indices
from blf_dsc_controller.identification.regression import (
    Weighted,
    correlation_lengths,
    sums_of,
)
from blf_dsc_controller.identification.windows import COLUMNS, Rows
from blf_dsc_controller.run import Floats

SIMPLE = ('viscous', 'Coulomb', 'offset')
"""Columns of friction that every joint has."""

_WEAK = 100.0  # times the deviations of the prior
_DELAY = 0.05  # s, deviation of the delay
_PASSES = 5  # of fit and residual
_FLOOR = 1e-3  # of the torque, least residual of a fit
_MODEL = 0.02  # of the torque, least residual of a whole arm: models are no better
_TINY = 1e-9  # N m or N
_CLEAR = 0.05  # of the torque, least friction that shows a sign ...
_CERTAIN = 5.0  # ... and standard deviations of its Coulomb part


class Alone(NamedTuple):
    """Fits of n joints, each to its own torque."""

    products: Floats  # (n, m + 2, m + 2) of the rows of each joint: see `Weighted`
    values: Floats  # (n, m + 1) of the unknowns of `Rows`, and delay [s]
    residual: Floats  # (n,) root mean square, N m or N
    torque: Floats  # (n,) likewise
    friction: Floats  # (n,) 1: clear friction brakes, -1: it drives, 0: it is not clear

    @property
    def delay(self) -> float:
        """Delay of the torques: the median over the joints [s]."""
        return float(np.median(self.values[:, -1]))

    @property
    def deviation(self) -> Floats:
        """What a model of the whole arm leaves of each torque (n,) at best [N m or N]."""
        return np.maximum(self.residual, _MODEL * self.torque)


def fit_alone(
    rows: Rows,
    fit: Indices,
    prior: Prior,
    columns: Collection[str] = SIMPLE,
) -> Alone:
    """Return the fits to the torques in some windows, with these columns of friction."""
    weighted = Weighted(rows, fit, 0.0)
    (products,) = weighted.products(1)
    deviations = _WEAK * np.linalg.norm(prior.G @ prior.D, axis=1)
    deviations[-1] = _DELAY
    counted = np.sum(rows.weight[fit] ** 2, axis=0)
    fits = []
    for i, of_joint in enumerate(products):
        used = [*range(rows.p), *_unknowns_of(rows, i, columns), rows.unknowns]
        own = np.zeros_like(deviations)
        own[used] = deviations[used]
        fits.append(_fitted(of_joint, own, float(counted[i])))
    values = np.array([each.scale * each.z for each in fits])
    of_residuals = np.column_stack((values, np.full(len(values), -1.0)))
    lengths = correlation_lengths(sums_of(weighted.blocks(), of_residuals))
    signs = [
        _sign(each, _unknowns_of(rows, i, SIMPLE[:2]), float(lengths[i]))
        for i, each in enumerate(fits)
    ]
    residual, torque = np.transpose([(each.residual, each.torque) for each in fits])
    return Alone(products, values, residual, torque, np.array(signs))


def errors_alone(rows: Rows, test: Indices, alone: Alone) -> Floats:
    """Return the root mean square errors (n,) of the fits in other windows."""
    u, rate = (each[test] for each in rows.u_and_rate(0.0))
    predicted = np.zeros_like(u)
    for block in rows.blocks(test):
        X = rows.matrix(test[block])
        predicted[block] = np.einsum('kia,ia->ki', X, alone.values[:, :-1])
    left = predicted - u - rate * alone.values[:, -1]
    return rows.rms(left, test)


class _Fit(NamedTuple):
    """The fit of one joint, by values that are scale times z."""

    scale: Floats  # (m + 1,)
    z: Floats  # (m + 1,)
    products: Floats  # (m + 2, m + 2) of the columns of z, and of the torque
    counted: float  # rows
    residual: float
    torque: float


def _unknowns_of(rows: Rows, joint: int, columns: Collection[str]) -> list[int]:
    """Return the unknowns of some columns of a joint."""
    n = rows.speed.size
    return [rows.p + COLUMNS.index(name) * n + joint for name in columns]


def _fitted(products: Floats, scale: Floats, counted: float) -> _Fit:
    """Return the fit from the products of a joint's rows, of which so many count."""
    both = np.append(scale, 1.0)
    products = both[:, None] * products * both
    counted = max(counted - np.count_nonzero(scale), 1.0)
    torque = float(np.sqrt(products[-1, -1] / counted))
    least = _FLOOR * torque + _TINY
    residual = least
    z = np.zeros(scale.size)
    for _ in range(_PASSES):
        z = most_likely(products / residual**2)
        residual = max(float(np.sqrt(left_of(products, z) / counted)), least)
    return _Fit(scale, z, products, counted, residual, torque)


def _sign(fit: _Fit, friction: list[int], length: float) -> float:
    """Return the sign of clear friction, with residuals of a correlation length."""
    viscous, coulomb = friction
    of_torque = fit.products[:, friction] @ fit.z[friction]
    if fit.z[friction] @ of_torque[friction] < _CLEAR**2 * fit.torque**2 * fit.counted:
        return 0.0
    work = float(of_torque[viscous])
    information = fit.products[:-1, :-1] / fit.residual**2
    one = np.eye(fit.z.size)
    H = np.linalg.inv(information + one)
    variance = (H @ (one + length * information) @ H)[coulomb, coulomb]
    value = float(fit.z[coulomb])
    is_certain = abs(value) > _CERTAIN * np.sqrt(variance)
    return float(np.sign(value)) if is_certain and value * work > 0.0 else 0.0
