# SPDX-License-Identifier: Apache-2.0
"""What varies from run to run: parameters of the plant, each with its distribution.

The start is told relative to the reference: `initial.error` is the tracking error xi1(0) as a
share of the bound, `initial.velocity_error` is dq(0) - dqr(0).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from dataclasses import dataclass

from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import Kind, Parameter, parameter, parameters, unknown
from blf_dsc_controller.monte_carlo.distribution import FORMS, Distribution, parse

_GROUPS = ('arm.', 'disturbance.', 'sensor.', 'actuator.')
_REALTIME = ('actuator.command_timeout', 'actuator.without_command')


@dataclass(frozen=True)
class Start:
    """Where a run starts, relative to the reference; not a part of the plant's configuration."""

    error: tuple[float, ...] = parameter(
        (), 'share of the bound', above=-1.0, below=1.0, length=('joints',)
    )
    velocity_error: tuple[float, ...] = parameter(
        (), 'velocity error', unit='rad/s', length=('joints',)
    )


@dataclass(frozen=True)
class Spread:
    """One number that is drawn for each run.

    Attributes:
        name: of the parameter.
        entry: index of the joint, -1 where the parameter is no list.
        column: name in the results.
        slot: which of the random numbers of a run it is made of.
        distribution: what it is drawn from.
    """

    name: str
    entry: int
    column: str
    slot: int
    distribution: Distribution


@functools.cache
def variable() -> Mapping[str, Parameter]:
    """Every parameter that may vary, by name."""
    start = [dataclasses.replace(one, name=f'initial.{one.name}') for one in parameters(Start)]
    plant = [one for one in parameters(PlantConfig) if one.name.startswith(_GROUPS)]
    plant = [one for one in plant if one.name not in _REALTIME]
    return {one.name: one for one in (*plant, *start) if one.kind.element in FORMS}


@functools.cache
def slots(joints: int) -> int:
    """Random numbers that a run is given: one for each that may vary, whether it does or not."""
    return sum(_entries(one, joints) for one in variable().values())


def spreads(
    told: Mapping[str, object], joints: tuple[str, ...]
) -> tuple[tuple[Spread, ...], list[str]]:
    """Read what varies, in the order of the plant's parameters, and say what is wrong with it.

    Args:
        told: a distribution for each name; for a parameter of each joint also a list of them.
        joints: names of the joints.

    Returns:
        What could be read, and the problems.
    """
    known = variable()
    problems = [unknown(name, known) for name in told if name not in known]
    found: list[Spread] = []
    slot = 0
    for name, one in known.items():
        if name in told:
            try:
                found += _spreads_of(one, told[name], joints, slot)
            except ValueError as error:
                problems.append(f'{name}: {error}')
        slot += _entries(one, len(joints))
    return tuple(found), problems


def _entries(one: Parameter, joints: int) -> int:
    return joints if one.kind.is_array else 1


def _spreads_of(one: Parameter, told: object, joints: tuple[str, ...], slot: int) -> list[Spread]:
    if not one.kind.is_array:
        return [Spread(one.name, -1, f'plant.{one.name}', slot, _distribution(one, told))]
    each = list(told) if isinstance(told, (list, tuple)) else [told] * len(joints)
    if len(each) != len(joints):
        raise ValueError(
            f'got {len(each)} distributions, but there are {len(joints)} joints: '
            'give one for each joint, or a single one for all'
        )
    return [
        Spread(one.name, i, f'plant.{one.name}.{joint}', slot + i, _distribution(one, text))
        for i, (joint, text) in enumerate(zip(joints, each, strict=True))
    ]


def _distribution(one: Parameter, text: object) -> Distribution:
    """Read a distribution all of whose values the parameter allows."""
    distribution = parse(text, one.kind.element)
    scalar: Kind = one.kind.element
    for value in distribution.extremes:
        for problem in dataclasses.replace(one, kind=scalar).problems(value):
            complaint = problem.removeprefix(f'{one.name}: ')
            raise ValueError(f'{distribution} can give what is not allowed: {complaint}')
    return distribution
