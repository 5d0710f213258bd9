# SPDX-License-Identifier: Apache-2.0
"""Dataclasses as parameters, and the nodes' configurations: what is accepted, and rejected how."""

from __future__ import annotations

import array
import math
from dataclasses import dataclass
from typing import Annotated

import pytest

from blf_dsc_controller.arms.model import arm_model
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import NODES, RecorderConfig, load_loop
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import build, change, flatten, parameter, parameters
from blf_dsc_controller.errors import ConfigurationError
from blf_dsc_controller.law import factory, settings


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
    notes: tuple[str, ...] = parameter((), 'notes', omittable=True)
    motor: Motor = Motor()

    def problems(self) -> list[str]:
        """Return the only problem that two parameters can have together."""
        return ['mode: fast needs armed'] if self.mode == 'fast' and not self.armed else []


def refused(given: dict[str, object]) -> list[str]:
    with pytest.raises(ConfigurationError) as caught:
        build(Machine, given, 'machine.yaml')
    assert 'machine.yaml' in str(caught.value)
    return caught.value.problems


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
    assert refused({'motor.gian': [1.0, 1.0]}) == [
        'motor.gian: unknown parameter, did you mean motor.gain?'
    ]
    assert refused({'drive.belt.table': 1}) == [
        'drive.belt.table: unknown parameter, did you mean motor.table?'
    ]
    assert refused({'zzz': 1}) == ['zzz: unknown parameter']


@pytest.mark.parametrize(
    ('given', 'message'),
    [
        # ROS does not accept an integer for a double, nor does a run without ROS.
        ({'speed': 1}, 'got 1, but a double is expected: write 1.0 instead of 1'),
        ({'motor.gain': [1, 2]}, 'got [1, 2], but a double array is expected: write 1.0 instead'),
        ({'speed': '1.0'}, "got '1.0', but a double is expected: write a number, without quotes"),
        ({'speed': True}, 'got true, but a double is expected'),
        ({'steps': True}, 'got true, but an integer is expected'),
        ({'steps': 2.0}, 'got 2.0, but an integer is expected'),
        ({'armed': 1}, 'got 1, but a bool is expected'),
        ({'mode': 3}, "got 3, but a string is expected: write '3' in quotes"),
        ({'speed': None}, 'got nothing, but a double is expected'),
        ({'motor.gain': 1.0}, 'got 1.0, but a double array is expected: write a list, like [1.0'),
        ({'axes': 'xy'}, "got 'xy', but a string array is expected: write a list, like"),
        ({'axes': ['x', 1]}, "got ['x', 1], but a string array is expected: write '1' in"),
        ({'speed': 0.0}, 'got 0.0, but it must be above 0 and below 10 m/s'),
        ({'speed': 10.0}, 'got 10.0, but it must be above 0 and below 10 m/s'),
        ({'steps': 0}, 'got 0, but it must be at least 1 and at most 5'),
        ({'steps': 6}, 'got 6, but it must be at least 1 and at most 5'),
        ({'mode': 'medium'}, "got 'medium', but it must be one of slow, fast"),
        ({'motor.gain': [1.0, -0.5]}, 'got -0.5 at entry 2 of [1.0, -0.5], but it must be at le'),
        ({'speed': float('nan')}, 'got nan, but a finite number is needed'),
        ({'speed': float('inf')}, 'got inf, but a finite number is needed'),
        ({'motor.gain': [-math.inf, 1.0]}, 'got -inf at entry 1 of [-inf, 1.0], but a finite'),
        ({'axes': []}, 'got an empty list, but at least one entry is needed'),
    ],
)
def test_wrong_type_or_value_error_gives_the_value_and_the_remedy(given, message):
    (name,) = given
    (problem,) = refused(given)
    assert problem.startswith(f'{name}: {message}')


def test_lengths_depend_on_other_parameters():
    assert refused({'motor.gain': [1.0]}) == [
        'motor.gain: got 1 entry, but 2 are needed (2 of axes)',
        'motor.table: got 4 entries, but 2 are needed (2 of axes times 1 of motor.gain)',
    ]
    triple = {'axes': ['x', 'y', 'z'], 'motor.gain': [0.0] * 3, 'motor.table': [1.0] * 9}
    limits = {'steps': 1, 'notes': []}  # inclusive
    assert build(Machine, triple | limits).motor == Motor((0.0,) * 3, (1.0,) * 9)


def test_all_problems_are_reported_at_once():
    found = refused({'bogus': 1, 'speed': -1.0, 'steps': 'a', 'motor.table': [1.0, 'b', 2.0]})
    assert [problem.split(':')[0] for problem in found] == [
        'bogus',
        'speed',
        'steps',
        'motor.table',
    ]
    assert refused({'mode': 'fast', 'bogus': 1}) == [
        'bogus: unknown parameter',
        'mode: fast needs armed',
    ]


def test_change_keeps_other_values_and_validates_the_result():
    machine = build(Machine, {'speed': 2.0, 'armed': True, 'mode': 'fast'})
    assert flatten(change(machine, {'steps': 5})) == {**flatten(machine), 'steps': 5}
    with pytest.raises(ConfigurationError, match='fast needs armed'):
        change(machine, {'armed': False})


TRUE_MODEL = {'law': 'model_based', 'truth.parameters': [1.0, 0.32, 0.4]}


def problems_of(cls, given):
    with pytest.raises(ConfigurationError) as caught:
        build(cls, given)
    return caught.value.problems


def test_recommended_preset_equals_the_defaults():
    assert load_loop('recommended') == (PlantConfig(), ControllerConfig(), RecorderConfig())


def test_models_and_choices_match_the_law():
    model = arm_model('two_link', l1=1.0, gravity=9.8)
    assert (model.n, model.p) == (2, len(model.parameter_names))
    choices = {entry.name: entry.choices for entry in parameters(ControllerConfig)}
    for law in choices['law']:
        factory.settings_of_config(build(ControllerConfig, TRUE_MODEL | {'law': law}))
    for name in ('prediction', 'update', 'torque_source', 'compensation'):
        assert sorted(choices[f'learning.{name}']) == sorted(settings.CHOICES[name])


@pytest.mark.parametrize('cls', NODES.values(), ids=NODES)
def test_defaults_are_valid_and_every_parameter_is_described(cls):
    assert build(cls, {}) == cls()
    for entry in parameters(cls):
        assert entry.description
        if entry.type is int:
            assert entry.at_least is not None, entry.name


def test_sample_time_is_a_whole_number_of_nanoseconds():
    assert build(PlantConfig, {'sample_time': 0.0003}).sample_time_ns == 300_000
    assert build(ControllerConfig, {'sample_time': 0.01}).sample_time_ns == 10_000_000
    for cls in (PlantConfig, ControllerConfig):
        (problem,) = problems_of(cls, {'sample_time': 1 / 3000})
        assert problem.endswith('not a whole number of nanoseconds: write 0.000333333')


@pytest.mark.parametrize('cls', [PlantConfig, ControllerConfig])
def test_joint_names_are_unique_and_the_arm_has_two(cls):
    assert problems_of(cls, {'joints': ['elbow', 'elbow']}) == [
        "joints: the name 'elbow' is repeated"
    ]
    assert problems_of(cls, {'joints': ['elbow', '']}) == ['joints: a name is empty']
    one_joint = {
        entry.name: entry.default[:1]
        for entry in parameters(cls)
        if 'joints' in entry.length or entry.name == 'joints'
    }
    (problem,) = problems_of(cls, one_joint)
    assert problem.startswith('joints: got 1 name, but')


@pytest.mark.parametrize(
    ('given', 'message'),
    [
        (
            {'reference.frequency': [1.0, 2.0], 'reference.phase': [0.0, 0.0]},
            'reference.amplitude: got 2 entries, but 4 are needed (2 of joints times 2 of ref',
        ),
        ({'reference.phase': [0.0, 1.0]}, 'reference.phase: got 2 entries, but 1 are needed'),
        (
            {'learning.initial_estimate': [1.0, 1.0], 'learning.adaptation_gain': [1.0, 1.0]},
            'learning.initial_estimate: got 2 entries, but model two_link has 3 parameters',
        ),
        ({'learning.adaptation_gain': [1.0]}, 'learning.adaptation_gain: got 1 entry, but 3 are'),
        # |P^(0)| = |(3, 0, 4)| = 5 by Pythagoras: on the ball is not inside it.
        (
            {'learning.initial_estimate': [3.0, 0.0, 4.0], 'learning.radius': 5.0},
            'learning.radius: got 5 kg m^2, but learning.initial_estimate has a norm of 5 kg',
        ),
        (TRUE_MODEL | {'learning.radius': 1.1}, 'learning.radius: got 1.1 kg m^2, but truth.para'),
        ({'learning.window': 0.009}, 'learning.window: got 0.009 s, which is 9 samples of 0.001'),
        ({'learning.window': 1000.001}, 'learning.window: got 1000 s, which is 1000001 samples'),
        ({'barrier.weight': [1e3, 2e4]}, 'barrier.slope_limit: got 20000 N m/rad for joint2, but'),
        (
            {'barrier.initial_bound': [0.003, 0.001], 'barrier.funnel_rate': 1.0},
            'barrier.initial_bound: got 0.001 rad for joint2, but it must be 0 (no funnel) or at',
        ),
        ({'truth.parameters': [1.0, 0.32]}, 'truth.parameters: got 2 entries, but model two_lin'),
        # Of an arm that cannot be read, no lengths are known.
        ({'robot.urdf': 'no.urdf', 'barrier.bound': [0.1] * 7}, "robot.urdf: 'no.urdf' cannot"),
    ],
)
def test_invalid_controller_configuration_is_rejected(given, message):
    (problem,) = problems_of(ControllerConfig, given)
    assert problem.startswith(message)


def test_run_needs_a_sample_and_a_bag_a_folder_and_the_shortest_window_ten_samples():
    assert build(ControllerConfig, {'learning.window': 0.01}).learning.window == 0.01
    (problem,) = problems_of(PlantConfig, {'duration': 0.0005})
    assert problem.startswith('duration: got 0.0005 s, shorter than one sample of 0.001 s')
    (problem,) = problems_of(RecorderConfig, {'output': ' '})
    assert problem == 'output: got no folder name to write the bag into'
