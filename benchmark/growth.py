# SPDX-License-Identifier: Apache-2.0
"""Growth of the update time with joints and unknowns p, and window.

Measurements begin when the window is full and latched.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from harness import Ratio, interleaved, ratio

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import load_loop
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.factory import controller_of
from blf_dsc_controller.reference.terms import sampled

_ROUNDS = 9
_UPDATES = 2000
_T = 1e-3  # s
_NOISE = (1e-4, 0.05)  # rad, rad/s, added to the reference to excite every column
_ANY_EXCITATION = 1e-12
"""A threshold that every window passes, even short ones and those with many columns."""


def learning(name: str, **changes: Any) -> ControllerConfig:
    """Return the controller of a preset, which learns from any window."""
    values = {
        'learning.excitation_threshold': _ANY_EXCITATION,
        'learning.change_detection': False,  # the states are noise, which no arm explains
    }
    return change(load_loop(name).controller, values | changes)


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
    tones = learning(
        'recommended', **{'learning.viscous': True, 'learning.frequencies': [1.0, 2.0]}
    )
    arms = {name: learning(name) for name in ('panda', 'ur5e')}
    cases: dict[str, dict[str, ControllerConfig]] = {
        'joints and unknowns': {
            f'{name}: {label(config)}': config
            for name, config in {'two links': tones, **arms}.items()
        },
        'window': {
            f'window of {samples} samples': learning(
                'recommended', **{'learning.window': samples * _T}
            )
            for samples in (100, 100_000)
        },
    }
    for group, configs in cases.items():
        contestants = {BASE: updates(learning('recommended'))}
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
