# SPDX-License-Identifier: Apache-2.0
"""Growth of the update time with joints and unknowns p, and window.

Measurements begin when the window is full and latched.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from harness import Ratio, interleaved, ratio

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import load_loop
from blf_dsc_controller.configuration.schema import build, change, flatten, parameters
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.factory import controller_of
from blf_dsc_controller.reference.terms import sampled

_ROUNDS = 9
_UPDATES = 2000
_T = 1e-3  # s
_NOISE = (1e-4, 0.05)  # rad, rad/s, added to the reference to excite every column
_ANY_EXCITATION = 1e-12
"""A threshold that every window passes, even short ones and those with many columns."""


def two_link(**changes: Any) -> ControllerConfig:
    """Return recommended settings that learn from any window."""
    values = {
        'learning.excitation_threshold': _ANY_EXCITATION,
        'learning.change_detection': False,  # the states are noise, which no arm explains
    }
    return build(ControllerConfig, values | {k.replace('__', '.'): v for k, v in changes.items()})


def chain(n: int, **changes: Any) -> ControllerConfig:
    """Return the same settings for a planar arm of n links, with a window of 1 s."""
    default: Mapping[str, Any] = flatten(ControllerConfig())
    values: dict[str, Any] = {'model': 'planar_chain', 'joints': [f'joint{i}' for i in range(n)]}
    for param in parameters(ControllerConfig):
        if param.length == ('joints',) and default[param.name]:
            values[param.name] = [default[param.name][0]] * n
    p = n * (n + 1) // 2
    values |= {
        'reference.amplitude': [0.3] * n,
        'learning.initial_estimate': [0.5] * p,
        'learning.adaptation_gain': [0.5] * p,
        'learning.radius': float(p),
        'learning.window': 1.0,
        'torque.limit': [1e3] * n,
    }
    return two_link(**{name.replace('.', '__'): value for name, value in values.items()}, **changes)


def of_urdf(preset: str) -> ControllerConfig:
    """Return the controller of a preset with a URDF, which learns from any window."""
    config = load_loop(preset).controller
    return change(config, {'learning.change_detection': False})


def label(config: ControllerConfig) -> str:
    """Describe the size of the problem; its p counts all estimates, the m of the law."""
    law = controller_of(config).settings
    columns = f'{law.p} of the arm + {law.m - law.p} of disturbances'
    return f'n = {law.n} joints, p = {law.m} unknowns ({columns})'


BASE = 'two-link arm, p = 5'


def updates(config: ControllerConfig) -> Callable[[], int]:
    """Return a function that does some thousand updates along the reference with a full window.

    Raises RuntimeError if nothing is learned from that window.
    """
    controller: Controller = controller_of(config)
    law = controller.settings
    full = round(law.learning_start / _T) + law.window + law.interval
    ahead = full + (_ROUNDS + 1) * _UPDATES
    reference = sampled(controller.reference_vector, _T * np.arange(ahead + 1))
    noise = np.random.default_rng(0).standard_normal((2, ahead + 1, law.n))
    states = np.zeros((ahead + 1, 3 * law.n))
    states[:, : law.n] = reference[:, 0] + _NOISE[0] * noise[0]
    states[:, law.n : 2 * law.n] = reference[:, 1] + _NOISE[1] * noise[1]
    clock = itertools.count()

    def go_on(count: int) -> int:
        for k in itertools.islice(clock, count):
            controller.update(k * _T, _T, states[k])
        return count

    go_on(full)
    if not controller.sample.latched[0] or not np.isfinite(controller.state_vector).all():
        raise RuntimeError(f'{label(config)}: nothing is learned from the window')
    return lambda: go_on(_UPDATES)


def measure() -> Iterator[Ratio]:
    """Measure the time per update relative to the two-link arm's."""
    tones: dict[str, Any] = {'learning__viscous': True, 'learning__frequencies': [1.0, 2.0]}
    cases: dict[str, dict[str, ControllerConfig]] = {
        'joints and unknowns': {
            label(config): config for config in (two_link(), chain(4), chain(7), chain(7, **tones))
        },
        'arms from a URDF': {
            f'{name}: {label(of_urdf(name))}': of_urdf(name) for name in ('panda', 'ur5e')
        },
        'window': {
            f'window of {samples} samples': two_link(learning__window=samples * _T)
            for samples in (100, 100_000)
        },
    }
    for group, configs in cases.items():
        contestants = {BASE: updates(two_link())}
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
