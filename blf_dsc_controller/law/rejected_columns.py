# SPDX-License-Identifier: Apache-2.0
"""Which disturbance columns the learning has refused, and what they could not be told from.

`core.excitation.judge` takes out the columns that make the window's excitation matrix too weak.
Here the same window says why: a refused column is, up to a small rest, a combination of others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from blf_dsc_controller.law.controller import Controller

_NOTABLE = 0.1  # of the strongest part of the combination


@dataclass(frozen=True)
class Refusal:
    """A disturbance column that is not estimated.

    Attributes:
        column: its name.
        alike: names of what, combined, looks like it on this window, the strongest first.
        share: how much of the column they explain, in [0, 1].
    """

    column: str
    alike: tuple[str, ...]
    share: float

    def __str__(self) -> str:
        return (
            f'{self.column} is not estimated: on this window it cannot be told from '
            f'{" + ".join(self.alike)} ({100 * self.share:.4g} % of it is theirs). A reference of '
            f'more tones can tell them apart; how clearly, learning.excitation_threshold says'
        )


def refusals(controller: Controller, names: Sequence[str]) -> tuple[Refusal, ...]:
    """Refused columns of a controller that learns, by its present window.

    Args:
        controller: whose excitation window is looked at.
        names: of the m entries of theta^, as `assembly.estimate_names` gives them.
    """
    state = controller.state
    refused = np.flatnonzero(state.active == 0.0)
    if controller.settings.kappa == 0.0 or state.judged[0] == 0.0 or refused.size == 0:
        return ()
    upper = np.triu(state.running[:, :-1])
    Phi = upper + np.triu(upper, 1).T
    kept = np.flatnonzero(state.active > 0.0)
    return tuple(_refusal(Phi, int(column), kept, names) for column in refused)


def _refusal(Phi: np.ndarray, column: int, kept: np.ndarray, names: Sequence[str]) -> Refusal:
    """Regress the column on those that are kept, by their inner products over the window."""
    products = Phi[kept, column]
    parts = np.linalg.lstsq(Phi[np.ix_(kept, kept)], products, rcond=None)[0]
    strength = np.abs(parts) * np.sqrt(np.diag(Phi)[kept])
    order = np.argsort(-strength)
    notable = [k for k in order if strength[k] >= _NOTABLE * strength[order[0]]]
    return Refusal(
        column=names[column],
        alike=tuple(names[kept[k]] for k in notable),
        share=float(np.clip(parts @ products / Phi[column, column], 0.0, 1.0)),
    )
