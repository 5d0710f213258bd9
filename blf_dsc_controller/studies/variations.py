# SPDX-License-Identifier: Apache-2.0
"""What varies from run to run of a study: parameters of the plant, each by a distribution."""

from __future__ import annotations

import itertools
import operator
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache

from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import Parameter, parameters, unknown
from blf_dsc_controller.studies.distributions import EXPECTED, Distribution, parse

VARY = 'vary.'
"""Prefix of the parameters that vary, in the section of a study."""


@dataclass(frozen=True)
class Variation:
    """One number drawn for each run."""

    name: str  # of the parameter
    entry: int  # index in the list; -1: not a list
    column: str  # name in the results
    distribution: Distribution


_GROUPS = (
    'arm.',
    'truth.',
    'joint.',
    'base.',
    'disturbance.',
    'sensor.',
    'actuator.',
    'load.',
    'events.',
)
_REALTIME = ('actuator.command_timeout', 'actuator.without_command')


@cache
def _variable_parameters() -> Mapping[str, Parameter]:
    """Return every parameter that may vary, by name; relative ones last."""
    relative = Parameter((), '', is_array=True, length=('joints',))
    found = [
        *(param for param in parameters(PlantConfig) if param.name.startswith(_GROUPS)),
        replace(relative, name='initial.error', above=-1.0, below=1.0),
        replace(relative, name='initial.velocity_error', unit='rad/s'),
        replace(
            relative,
            name='events.gap',
            unit='s',
            at_least=0.0,
            length=('events.begin',),
        ),
    ]
    return {p.name: p for p in found if p.type in EXPECTED and p.name not in _REALTIME}


def variations_of(
    given: Mapping[str, object], plant: PlantConfig
) -> tuple[tuple[Variation, ...], list[str]]:
    """Return the variations in the order of the plant's parameters, and what is wrong with others.

    `given` has a distribution by each name, `vary.` before it; a list parameter also takes a
    list of them.
    """
    known = {f'{VARY}{name}': param for name, param in _variable_parameters().items()}
    found: list[Variation] = []
    problems = [unknown(name, known) for name in given if name not in known]
    for name, param in known.items():
        if name in given:
            try:
                found += _of_parameter(param, given[name], plant)
            except ValueError as error:
                problems.append(f'{name}: {error}')
    return tuple(found), problems


def _of_parameter(
    param: Parameter, given: object, plant: PlantConfig
) -> list[Variation]:
    """Return the variations of a parameter: one, or one for each entry of its list.

    Raises:
        ValueError: `given` is no distribution, or none of allowed values, or there are too few.
    """
    column = f'plant.{param.name}'
    if not param.is_array:
        return [Variation(param.name, -1, column, _distribution(param, given))]
    names = _entries(param, plant)
    if not names:
        raise ValueError(
            'got a distribution, but there are no events: give events.begin'
        )
    each = list(given) if isinstance(given, (list, tuple)) else [given] * len(names)
    if len(each) == len({name.rpartition('.')[2] for name in names}):
        each *= len(names) // len(each)  # the same row for each event
    if len(each) != len(names):
        raise ValueError(
            f'got {len(each)} distributions, but there are {len(names)} entries '
            f'({", ".join(names)}): give one for each, or a single one for all'
        )
    return [
        Variation(param.name, i, f'{column}.{name}', _distribution(param, text))
        for i, (name, text) in enumerate(zip(names, each, strict=True))
    ]


def _entries(param: Parameter, plant: PlantConfig) -> tuple[str, ...]:
    """Return the names of the entries of a list parameter, by joint or number."""
    each = []
    for name in param.length or (param.name,):
        count = int(name) if name.isdigit() else len(operator.attrgetter(name)(plant))
        each.append(
            plant.joints if name == 'joints' else tuple(map(str, range(1, count + 1)))
        )
    return tuple('.'.join(names) for names in itertools.product(*each))


def _distribution(param: Parameter, text: object) -> Distribution:
    """Return the distribution of a text.

    Raises:
        ValueError: it is none, or can give values that the parameter does not allow.
    """
    scalar = replace(param, is_array=False)
    distribution = parse(text, scalar.type)
    for value in distribution.extremes:
        for problem in scalar.problems(value):
            reason = problem.removeprefix(f'{param.name}: ')
            raise ValueError(
                f'{distribution} can give values that are not allowed: {reason}'
            )
    return distribution
