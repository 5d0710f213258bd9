# SPDX-License-Identifier: Apache-2.0
"""The values that the page shows for one moment, and the confidence in each estimate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from blf_dsc_controller.compiled.layout import pack
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.law.factory import (
    column_names,
    model_of,
    prior_covariance,
    settings_of_config,
)
from blf_dsc_controller.law.prediction import rows_along
from blf_dsc_controller.run import Floats

_FEWEST = 8  # moments needed to differentiate twice
_INDEPENDENT = 100.0  # independent values of the unmodelled torque in a window


class Moment(NamedTuple):
    """Values of n joints and m estimates at one time; NaN where unknown."""

    time: float  # s
    position: Floats  # (n,) rad, q
    error: Floats  # (n,) rad, xi1
    bound: Floats  # (n,) rad, k_c
    torque: Floats  # (n,) N m
    torque_limit: Floats  # (n,) N m
    estimate: Floats  # (m,) theta^; NaN: a rejected column
    truth: Floats  # (m,)
    lambda_min: float
    load: Sequence[float] = (np.nan,) * 8  # of topics.LOAD
    loaded: bool = False  # the true parameters differ from those at the start


def estimates_of(config: ControllerConfig) -> dict[str, str]:
    """Return the units of a controller's estimates by name, in their order."""
    friction = {one: 'N m s/rad' if 'viscous' in one else 'N m' for one in column_names(config)}
    model = model_of(config)
    return dict(zip(model.parameter_names, model.parameter_units, strict=True)) | friction


def plant_events(values: Mapping[str, Any]) -> list[tuple[float, str, float]]:
    """Return time [s], text and change of payload [kg] of what a simulated arm undergoes."""
    begin = values.get('events.begin', ())
    nothing = (0.0,) * len(begin)
    duration, masses = (values.get(f'events.{k}') or nothing for k in ('duration', 'payload'))
    found = []
    for k, (at, lasts, mass) in enumerate(zip(begin, duration, masses, strict=False), 1):
        texts = (f'{mass:g} kg picked up', f'{mass:g} kg put down')
        first, last = texts if mass else (f'event {k} begins', f'event {k} ends')
        found.append((at, first, mass))
        found += [(at + lasts, last, -mass)] if lasts else []
    return sorted(found)


class Confidence:
    """How well the motion of a window determines each estimate.

    The excitation Phi of the reference over the window adds to the information R of the prior:
    covariance = (R + Phi / a)^-1, where a is the mean square of the unmodelled torque
    (`learning.residual_floor`) divided by the number of its independent values in a window, as
    in `excite`.
    """

    def __init__(self, config: ControllerConfig) -> None:
        settings = settings_of_config(config)
        least = float(np.min(config.learning.residual_floor))
        self.window = config.learning.window
        self.prior = np.sqrt(np.diag(prior_covariance(config)))  # (m,) standard deviations
        self._settings, self._vector = settings, pack(settings)
        self._noise = settings.prior_weight or least * least / _INDEPENDENT

    def deviations(self, past: Sequence[Moment]) -> Floats:
        """Return the standard deviation (m,) of each estimate after the last window of `past`."""
        settings = self._settings
        recent = [one for one in past if one.time > past[-1].time - self.window]
        recent = [one for one in recent if np.isfinite(one.error).all()]
        if len(recent) < _FEWEST:
            return self.prior
        times = np.array([one.time for one in recent])
        qr = np.array([one.position - one.error for one in recent])
        dqr = np.gradient(qr, times, axis=0)
        motion = np.stack((qr, dqr, np.gradient(dqr, times, axis=0)), axis=1)
        X = rows_along(settings, self._vector, times, motion)
        X *= settings.row_weight[:, np.newaxis]
        share = min(1.0, (times[-1] - times[0]) / self.window)
        Phi = np.einsum('kia,kib->ab', X, X) * (share / times.size)
        covariance = np.linalg.inv(settings.information + Phi / self._noise)
        return np.asarray(np.sqrt(np.diag(covariance)))
