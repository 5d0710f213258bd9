# SPDX-License-Identifier: Apache-2.0
"""Search of a law's gains, the same for every law: optimiser, seed and budget."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import Value, flatten, suggestion
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.run import Floats

SEED = 1
HOPELESS = 30.0


class Gain(NamedTuple):
    """One tuned number: the parameter or gain it sets, and its range."""

    name: str
    least: float
    most: float
    # multiplies the inertia m of each joint of an arm from a URDF
    inertial: bool = False
    joint: int = -1  # that of a per-joint parameter; -1: all


def value_at(exponent: float) -> float:
    """Return a gain from its decimal logarithm, to three digits."""
    return float(f'{10.0**exponent:.3g}')


def bounded(cost: float) -> float:
    """Return a cost that the search can compare, also of a run that diverged."""
    return min(float(cost), HOPELESS) if np.isfinite(cost) else HOPELESS


def parameters_at(
    config: ControllerConfig,
    gains: Sequence[Gain],
    values: Iterable[float],
    inertia: Floats | float = 1.0,
) -> dict[str, Value]:
    """Return the parameters for these gains; `inertia` (n,) is m of the arm.

    Raises BlfDscError if the law has none of such a name.
    """
    present = flatten(config)
    chosen = dict[str, Floats]()
    for gain, value in zip(gains, values, strict=True):
        if gain.inertial:
            chosen[gain.name] = np.asarray(value * inertia)
        elif gain.name not in present:
            raise BlfDscError(
                f'Gain({gain.name!r}, ...): there is no such parameter'
                f'{suggestion(gain.name, present)}'
            )
        else:
            of = chosen.setdefault(gain.name, np.array(present[gain.name], dtype=float))
            of[gain.joint if gain.joint >= 0 else ...] = value
    return {
        name: tuple(v.tolist()) if v.ndim else v.item() for name, v in chosen.items()
    }


def search(
    cost: Callable[[Floats], float],
    gains: Sequence[Gain],
    population: int,
    generations: int,
    **options: Any,
) -> Any:
    """Search the logarithms (base 10) of the gains; return scipy's OptimizeResult.

    Differential evolution with a fixed seed from a Latin hypercube, of the same size
    for every law; `options` are passed to scipy.
    """
    from scipy.optimize import (
        differential_evolution,
    )  # slow: half a second with the next
    from scipy.stats import qmc

    ranges = np.log10([(gain.least, gain.most) for gain in gains])
    points = qmc.LatinHypercube(len(ranges), seed=np.random.default_rng(SEED)).random(
        population
    )
    return differential_evolution(
        cost,
        ranges,
        init=points * np.diff(ranges).T + ranges[:, 0],
        maxiter=generations,
        tol=0.0,
        polish=False,
        seed=np.random.default_rng(SEED),
        **options,
    )
