# SPDX-License-Identifier: Apache-2.0
"""What varies from run to run: parameters of the plant, each with its distribution.

The start is relative to the reference: `initial.error` is the tracking error xi1(0) as a fraction
of the bound, `initial.velocity_error` is dq(0) - dqr(0).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from dataclasses import dataclass

from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import Parameter, parameter, parameters, unknown
from blf_dsc_controller.monte_carlo.distribution import FORMS, Distribution, parse

_GROUPS = ('arm.', 'disturbance.', 'sensor.', 'actuator.')
_REALTIME = ('actuator.command_timeout', 'actuator.without_command')


@dataclass(frozen=True)
class RelativeStart:
    """Start of a run relative to the reference."""

    error: tuple[float, ...] = parameter(
        (), 'fraction of the bound', above=-1.0, below=1.0, length=('joints',)
    )
    velocity_error: tuple[float, ...] = parameter(
        (), 'velocity error', unit='rad/s', length=('joints',)
    )


@dataclass(frozen=True)
class Variation:
    """One number that is drawn for each run."""

    name: str  # of the parameter
    entry: int  # index of the joint; -1: the parameter is no list
    column: str  # name in the results
    slot: int  # index of its random number among those of a run
    distribution: Distribution


@functools.cache
def variable_parameters() -> Mapping[str, Parameter]:
    """Every parameter that may vary, by name."""
    start = parameters(RelativeStart)
    found = [one for one in parameters(PlantConfig) if one.name.startswith(_GROUPS)]
    found += [dataclasses.replace(one, name=f'initial.{one.name}') for one in start]
    return {
        one.name: one for one in found if one.name not in _REALTIME and one.kind.element in FORMS
    }


@functools.cache
def slots(joints: int) -> int:
    """Random numbers that a run draws: one for each that may vary, whether it does or not."""
    return sum(_entries(one, joints) for one in variable_parameters().values())


def read_variations(
    given: Mapping[str, object], joints: tuple[str, ...]
) -> tuple[tuple[Variation, ...], list[str]]:
    """Variations in the order of the plant's parameters, and the problems with them.

    Each name has a distribution; a parameter of each joint takes a list of them as well.
    """
    known = variable_parameters()
    problems = [unknown(name, known) for name in given if name not in known]
    found: list[Variation] = []
    slot = 0
    for name, one in known.items():
        if name in given:
            try:
                found += _variations_of(one, given[name], joints, slot)
            except ValueError as error:
                problems.append(f'{name}: {error}')
        slot += _entries(one, len(joints))
    return tuple(found), problems


def _entries(one: Parameter, joints: int) -> int:
    return joints if one.kind.is_array else 1


def _variations_of(
    one: Parameter, given: object, joints: tuple[str, ...], slot: int
) -> list[Variation]:
    if not one.kind.is_array:
        return [Variation(one.name, -1, f'plant.{one.name}', slot, _distribution(one, given))]
    each = list(given) if isinstance(given, (list, tuple)) else [given] * len(joints)
    if len(each) != len(joints):
        raise ValueError(
            f'got {len(each)} distributions, but there are {len(joints)} joints: '
            'give one for each joint, or a single one for all'
        )
    return [
        Variation(one.name, i, f'plant.{one.name}.{joint}', slot + i, _distribution(one, text))
        for i, (joint, text) in enumerate(zip(joints, each, strict=True))
    ]


def _distribution(one: Parameter, text: object) -> Distribution:
    """Read a distribution all of whose values the parameter allows."""
    scalar = dataclasses.replace(one, kind=one.kind.element)
    distribution = parse(text, scalar.kind)
    for value in distribution.extremes:
        for problem in scalar.problems(value):
            reason = problem.removeprefix(f'{one.name}: ')
            raise ValueError(f'{distribution} can give what is not allowed: {reason}')
    return distribution
