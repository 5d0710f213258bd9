# SPDX-License-Identifier: Apache-2.0
"""How the update grows: with joints and parameters, the window, and the disturbance columns."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from timing import Ratio, interleaved, ratio

from blf_dsc_controller.assembly import controller_of
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import build, flatten, parameters
from blf_dsc_controller.core.controller import Controller

_ROUNDS = 9
_UPDATES = 2000
BASE = 'two links, 3 + 2 unknowns'


def chain(n: int, **changes: Any) -> ControllerConfig:
    """Recommended settings spread over a planar arm of n links."""
    default: Mapping[str, Any] = flatten(ControllerConfig())
    values: dict[str, Any] = {'model': 'planar_chain', 'joints': [f'joint{i}' for i in range(n)]}
    for one in parameters(ControllerConfig):
        if one.rule.length == ('joints',):
            values[one.name] = [default[one.name][0]] * n
    p = n * (n + 1) // 2
    values |= {
        'reference.amplitude': [0.3] * n,
        'learning.initial_estimate': [0.5] * p,
        'learning.adaptation_gain': [0.5] * p,
        'learning.radius': float(p),
        'learning.window': 1.0,
        'torque.limit': [1e3] * n,
    }
    return build(ControllerConfig, values | {k.replace('__', '.'): v for k, v in changes.items()})


def updates(config: ControllerConfig) -> Callable[[], int]:
    """Work of some thousand updates with a moving state, learning latched after the window."""
    controller: Controller = controller_of(config)
    n = controller.settings.n
    random = np.random.default_rng(0)
    states = 0.01 * random.standard_normal((64, 3 * n))
    states[:, :n] += np.array(config.reference.offset) + np.array(config.reference.amplitude)
    clock = {'k': 0}

    def work() -> int:
        for _ in range(_UPDATES):
            k = clock['k'] = clock['k'] + 1
            controller.update(k * 1e-3, 1e-3, states[k % 64])
        return _UPDATES

    return work


def measure() -> Iterator[Ratio]:
    """Time per update relative to the two-link arm's."""
    base = ControllerConfig()
    wide = {'learning__viscous': True, 'learning__coulomb': True}
    cases = {
        'joints': {f'{n} links, {n * (n + 1) // 2} + {n} unknowns': chain(n) for n in range(2, 8)},
        'columns': {
            '7 links, 28 + 14 unknowns': chain(7, learning__viscous=True),
            '7 links, 28 + 42 unknowns': chain(7, **wide, learning__frequencies=[1.0, 2.0][:1]),
            '7 links, 28 + 49 unknowns': chain(7, **wide, learning__frequencies=[1.0, 2.0]),
        },
        'window': {
            f'window of {samples} samples': build(
                ControllerConfig,
                {'learning.window': samples * 1e-3},
            )
            for samples in (100, 1000, 10_000, 100_000)
        },
    }
    for group, configs in cases.items():
        contestants = {BASE: updates(base)}
        contestants |= {name: updates(config) for name, config in configs.items()}
        times = interleaved(contestants, _ROUNDS)
        for name, config in configs.items():
            memory = controller_of(config).state_vector.nbytes / 1e6
            yield ratio(
                f'growth with {group}',
                name,
                BASE,
                times[name],
                times[BASE],
                f'{1e6 * np.median(times[name]):.1f} us an update here, {memory:.1f} MB of state',
            )
