# SPDX-License-Identifier: Apache-2.0
"""Why a law does not estimate a disturbance column."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from blf_dsc_controller.law.controller import Controller

_NOTABLE = 0.1  # relative to the largest component


def rejected_columns(controller: Controller, names: Sequence[str]) -> dict[str, str]:
    """Return why a controller that learns does not estimate columns, by their names.

    Each resembles a combination of others in the current window; these are named,
    largest first.  `names` are those of the m entries of theta^, as returned by
    `factory.estimate.estimate_names`.
    """
    state, reasons = controller.state, {}
    upper = np.triu(state.window.running[:-1, :-1])
    Phi = upper + np.triu(upper, 1).T
    kept = np.flatnonzero(state.latch.active > 0.0)
    for column in np.flatnonzero(state.latch.active == 0.0).tolist():
        products = Phi[kept, column]
        parts = np.linalg.lstsq(Phi[np.ix_(kept, kept)], products, rcond=None)[0]
        strength = np.abs(parts) * np.sqrt(np.diag(Phi)[kept])
        order = kept[np.argsort(-strength)].tolist()
        alike = [
            names[k] for k in order[: np.sum(strength >= _NOTABLE * strength.max())]
        ]
        explained = float(np.clip(parts @ products / Phi[column, column], 0.0, 1.0))
        reasons[names[column]] = (
            f'{names[column]} is not estimated: this window cannot distinguish it from '
            f'{" + ".join(alike)} ({100 * explained:.4g} % of it is explained by them). '
            'A reference with more tones can separate them; learning.excitation_threshold sets '
            'how clearly'
        )
    return reasons
