# SPDX-License-Identifier: Apache-2.0
"""Dataclasses as parameters: what is found, accepted and rejected, and the error messages."""

from __future__ import annotations

import array
from dataclasses import dataclass
from typing import Annotated

import pytest

from blf_dsc_controller.configuration.schema import (
    Kind,
    build,
    change,
    flatten,
    parameter,
    parameters,
)
from blf_dsc_controller.errors import ConfigurationError


@dataclass(frozen=True)
class Motor:
    """A group with two arrays whose lengths follow from other parameters."""

    gain: Annotated[tuple[float, ...], 'axes'] = parameter(
        (1.0, 2.0), 'gain', unit='N m', at_least=0.0
    )
    table: Annotated[tuple[float, ...], 'axes', 'motor.gain'] = parameter(
        (1.0, 2.0, 3.0, 4.0), 'table'
    )


@dataclass(frozen=True)
class Machine:
    """A parameter of each kind, and a rule between two of them."""

    axes: tuple[str, ...] = parameter(('x', 'y'), 'axes', read_only='they are wired')
    speed: float = parameter(1.0, 'speed', unit='m/s', above=0.0, below=10.0)
    steps: int = parameter(3, 'steps', at_least=1, at_most=5)
    armed: bool = parameter(False, 'armed')  # noqa: FBT003
    mode: str = parameter('slow', 'mode', choices=('slow', 'fast'))
    notes: tuple[str, ...] = parameter((), 'notes', may_be_empty=True)
    motor: Motor = Motor()

    def problems(self) -> list[str]:
        """Return the only problem that two parameters can have together."""
        return ['mode: fast needs armed'] if self.mode == 'fast' and not self.armed else []


def problems_of(given: dict[str, object]) -> list[str]:
    with pytest.raises(ConfigurationError) as caught:
        build(Machine, given, 'machine.yaml')
    assert 'machine.yaml' in str(caught.value)
    return caught.value.problems


def test_parameters_have_dotted_names_in_order():
    assert [(entry.name, entry.kind) for entry in parameters(Machine)] == [
        ('axes', Kind.STRING_ARRAY),
        ('speed', Kind.DOUBLE),
        ('steps', Kind.INTEGER),
        ('armed', Kind.BOOL),
        ('mode', Kind.STRING),
        ('notes', Kind.STRING_ARRAY),
        ('motor.gain', Kind.DOUBLE_ARRAY),
        ('motor.table', Kind.DOUBLE_ARRAY),
    ]
    assert parameters(Machine)[0].read_only == 'they are wired'


def test_build_without_values_gives_defaults_and_flatten_inverts_build():
    assert build(Machine, {}) == Machine()
    given = {'speed': 2.5, 'motor.gain': (3.0, 0.0), 'armed': True, 'mode': 'fast'}
    built = build(Machine, given)
    assert built.motor.gain == (3.0, 0.0)
    assert flatten(built).items() >= given.items()
    assert build(Machine, flatten(built)) == built
    for entries in ([3.0, 4.0], array.array('d', [3.0, 4.0])):  # as ROS gives them
        assert build(Machine, {'motor.gain': entries}).motor.gain == (3.0, 4.0)


def test_unknown_name_suggests_the_closest():
    assert problems_of({'motor.gian': [1.0, 1.0]}) == [
        'motor.gian: unknown parameter, did you mean motor.gain?'
    ]
    assert problems_of({'drive.belt.table': 1}) == [
        'drive.belt.table: unknown parameter, did you mean motor.table?'
    ]
    assert problems_of({'zzz': 1}) == ['zzz: unknown parameter']


@pytest.mark.parametrize(
    ('given', 'message'),
    [
        # ROS does not accept an integer for a double, nor does a run without ROS.
        ({'speed': 1}, 'speed: got 1, but a double is expected: write 1.0 instead of 1'),
        (
            {'motor.gain': [1, 2]},
            'motor.gain: got [1, 2], but a double array is expected: write 1.0 instead of 1',
        ),
        (
            {'speed': '1.0'},
            "speed: got '1.0', but a double is expected: write a number, without quotes",
        ),
        ({'speed': True}, 'speed: got true, but a double is expected'),
        ({'steps': True}, 'steps: got true, but an integer is expected'),
        ({'steps': 2.0}, 'steps: got 2.0, but an integer is expected'),
        ({'armed': 1}, 'armed: got 1, but a bool is expected'),
        ({'mode': 3}, "mode: got 3, but a string is expected: write '3' in quotes"),
        ({'speed': None}, 'speed: got nothing, but a double is expected'),
        (
            {'motor.gain': 1.0},
            'motor.gain: got 1.0, but a double array is expected: write a list, like [1.0, 2.0]',
        ),
        ({'axes': 'xy'}, "axes: got 'xy', but a string array is expected: write a list, like"),
        ({'axes': ['x', 1]}, "axes: got ['x', 1], but a string array is expected: write '1' in"),
    ],
)
def test_wrong_type_error_gives_the_value_and_the_remedy(given, message):
    (problem,) = problems_of(given)
    assert problem.startswith(message)


@pytest.mark.parametrize(
    ('given', 'message'),
    [
        ({'speed': 0.0}, 'speed: got 0.0, but it must be above 0 and below 10 m/s'),
        ({'speed': 10.0}, 'speed: got 10.0, but it must be above 0 and below 10 m/s'),
        ({'steps': 0}, 'steps: got 0, but it must be at least 1 and at most 5'),
        ({'steps': 6}, 'steps: got 6, but it must be at least 1 and at most 5'),
        ({'mode': 'medium'}, "mode: got 'medium', but it must be one of slow, fast"),
        (
            {'motor.gain': [1.0, -0.5]},
            'motor.gain: got -0.5 at entry 2 of [1.0, -0.5], but it must be at least 0 N m',
        ),
        ({'speed': float('nan')}, 'speed: got nan, but a finite number is needed'),
        ({'speed': float('inf')}, 'speed: got inf, but a finite number is needed'),
        (
            {'motor.gain': [float('-inf'), 1.0]},
            'motor.gain: got -inf at entry 1 of [-inf, 1.0], but a finite number is needed',
        ),
        ({'axes': []}, 'axes: got an empty list, but at least one entry is needed'),
    ],
)
def test_out_of_range_error_gives_the_range(given, message):
    assert problems_of(given) == [message]


def test_inclusive_limits_are_accepted():
    assert build(Machine, {'steps': 1}).steps == 1
    assert build(Machine, {'steps': 5, 'motor.gain': [0.0, 0.0]}).steps == 5
    assert build(Machine, {'notes': []}).notes == ()


def test_lengths_depend_on_other_parameters():
    assert problems_of({'motor.gain': [1.0]}) == [
        'motor.gain: got 1 entry, but 2 are needed (2 of axes)',
        'motor.table: got 4 entries, but 2 are needed (2 of axes times 1 of motor.gain)',
    ]
    triple = {'axes': ['x', 'y', 'z'], 'motor.gain': [1.0] * 3, 'motor.table': [1.0] * 9}
    assert build(Machine, triple).motor.table == (1.0,) * 9


def test_all_problems_are_reported_at_once():
    found = problems_of({'bogus': 1, 'speed': -1.0, 'steps': 'a', 'motor.table': [1.0, 'b', 2.0]})
    assert [problem.split(':')[0] for problem in found] == [
        'bogus',
        'speed',
        'steps',
        'motor.table',
    ]
    assert problems_of({'mode': 'fast', 'bogus': 1}) == [
        'bogus: unknown parameter',
        'mode: fast needs armed',
    ]


def test_change_keeps_other_values_and_validates_the_result():
    machine = build(Machine, {'speed': 2.0, 'armed': True, 'mode': 'fast'})
    assert flatten(change(machine, {'steps': 5})) == {**flatten(machine), 'steps': 5}
    with pytest.raises(ConfigurationError, match='fast needs armed'):
        change(machine, {'armed': False})
