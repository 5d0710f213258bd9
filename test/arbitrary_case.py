# SPDX-License-Identifier: Apache-2.0
"""Random settings, state and signals for kernels that are independent of an arm: any n and p."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from closed_loop_case import recommended

from blf_dsc_controller.law.settings import Settings
from blf_dsc_controller.law.state import (
    Signals,
    State,
    signals_of,
    signals_size,
    state_of,
    state_size,
)


class Case(NamedTuple):
    """Arguments of a kernel."""

    settings: Settings
    state: State
    signals: Signals


def arbitrary_settings(random: np.random.Generator, n: int, p: int, **changes) -> Settings:
    """Return gains between 0.5 and 2 for n joints, p parameters and a bias column per joint."""
    settings = recommended()
    length = {settings.n: n, settings.p: p, settings.m: p + n}
    arrays = {
        name: random.uniform(0.5, 2.0, [length.get(size, size) for size in value.shape])
        for name, value in settings._asdict().items()
        if isinstance(value, np.ndarray)
    }
    case = {
        'n': n,
        'p': p,
        'm': p + n,
        'model': None,
        'window': 8,
        'interval': 1,
        'eta': 0.3,
        'kappa': 5.0,
        'sigma': 1e-9,
        'learning_start': 0.0,
        'change_detection': 0,
        'bumpless': 0,
        'information': np.eye(p + n),
        'variance': np.ones(p + n),
        'least': np.full(p + n, -np.inf),
        'most': np.full(p + n, np.inf),
        'damping_rate': 0.0,
        'row_weight': np.ones(n),
        'radius': 1e3,
    }
    return settings._replace(**arrays | case | changes)


def arbitrary(seed: int, n: int = 3, p: int = 4, **changes) -> Case:
    """Return the case of a seed, with standard normal state and signals."""
    random = np.random.default_rng(seed)
    settings = arbitrary_settings(random, n, p, **changes)
    state = state_of(random.normal(size=state_size(settings)), settings)
    signals = signals_of(random.normal(size=signals_size(settings)), settings)
    return Case(settings, state, signals)
