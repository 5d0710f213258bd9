# SPDX-License-Identifier: Apache-2.0
"""Rejected disturbance columns (`excitation.reject_columns`), and what they resemble."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.law.controller import Controller

_NOTABLE = 0.1  # relative to the largest component


class RejectedColumn(NamedTuple):
    """A disturbance column that is not estimated."""

    column: str  # its name
    alike: tuple[str, ...]  # names of the columns whose combination resembles it, largest first
    fraction: float  # of the column that these explain, in [0, 1]

    def __str__(self) -> str:
        return (
            f'{self.column} is not estimated: this window cannot distinguish it from '
            f'{" + ".join(self.alike)} ({100 * self.fraction:.4g} % of it is explained by them). '
            'A reference with more tones can separate them; learning.excitation_threshold sets '
            'how clearly'
        )


def rejected_columns(controller: Controller, names: Sequence[str]) -> tuple[RejectedColumn, ...]:
    """Return the rejected columns of a controller that learns, explained by its current window.

    `names` are those of the m entries of theta^, as returned by `factory.estimate_names`.
    """
    state = controller.state
    rejected = np.flatnonzero(state.active == 0.0)
    if controller.settings.kappa == 0.0 or state.columns_checked[0] == 0.0:
        return ()
    upper = np.triu(state.running[:-1, :-1])
    Phi = upper + np.triu(upper, 1).T
    kept = np.flatnonzero(state.active > 0.0)
    return tuple(_explained(Phi, int(column), kept, names) for column in rejected)


def _explained(
    Phi: np.ndarray, column: int, kept: np.ndarray, names: Sequence[str]
) -> RejectedColumn:
    """Regress the column on the kept ones, from their inner products over the window."""
    products = Phi[kept, column]
    parts = np.linalg.lstsq(Phi[np.ix_(kept, kept)], products, rcond=None)[0]
    strength = np.abs(parts) * np.sqrt(np.diag(Phi)[kept])
    order = np.argsort(-strength)
    notable = [k for k in order if strength[k] >= _NOTABLE * strength[order[0]]]
    fraction = float(np.clip(parts @ products / Phi[column, column], 0.0, 1.0))
    return RejectedColumn(names[column], tuple(names[kept[k]] for k in notable), fraction)
