# SPDX-License-Identifier: Apache-2.0
"""Configurations of the nodes: which values are accepted, and how others are rejected."""

from __future__ import annotations

import array
from contextlib import suppress

import numpy as np
import pytest

from blf_dsc_controller.configuration import schema
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.law_gains import Paper
from blf_dsc_controller.configuration.nodes import NODES, load_loop
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import build, change, flatten, parameters
from blf_dsc_controller.configuration.side_nodes import RecorderConfig
from blf_dsc_controller.errors import ConfigurationError
from blf_dsc_controller.factory.settings import settings_of_config
from blf_dsc_controller.law import state
from blf_dsc_controller.law.adaptation import GRADIENT, NEWTON
from blf_dsc_controller.law.prediction import FILTERED, LAMBDA

NAN = float('nan')
TRUE_MODEL = {'law': 'model_based', 'truth.parameters': [1.0, 0.32, 0.4]}
PLANT = (PlantConfig,)
CONTROLLER = (ControllerConfig,)
BOTH = (PlantConfig, ControllerConfig)


def problems_of(cls, given):
    with pytest.raises(ConfigurationError, match=r'arm\.yaml') as caught:
        build(cls, given, 'arm.yaml')
    return caught.value.problems


def of_one_joint(cls):
    arrays = (
        each for each in parameters(cls) if {'joints'} & {each.name, *each.length}
    )
    return {each.name: each.default[:1] for each in arrays}


def test_values_are_kept_and_flattened_and_a_change_keeps_the_others():
    given = {
        'duration': 2.5,
        'disturbance.viscous': (3.0, 0.0),
        'mode': 'lockstep',
        'seed': 5,
    }
    built = build(PlantConfig, given)
    assert built.disturbance.viscous == (3.0, 0.0)
    assert dict(flatten(PlantConfig()), **given) == flatten(built)
    assert build(PlantConfig, flatten(built)) == built
    entries = array.array('d', [3.0, 4.0])  # as ROS gives them
    changed = change(built, {'disturbance.viscous': entries})
    assert flatten(changed) == {**flatten(built), 'disturbance.viscous': (3.0, 4.0)}
    computed = {'seed': np.int64(6), 'disturbance.viscous': 2.0 * np.array([3.0, 4.0])}
    of_script = change(built, computed)
    assert of_script.seed == 6
    assert of_script.disturbance.viscous == (6.0, 8.0)
    assert type(of_script.disturbance.viscous[0]) is float
    with pytest.raises(ConfigurationError, match='shorter than one sample'):
        change(changed, {'sample_time': 1.0, 'duration': 0.5})


def test_what_may_be_left_out_of_an_arm_from_a_urdf_is_left_out():
    """Not zero for each joint, which would be known to have no rotors."""
    given = {'robot.urdf': 'ur5e.urdf', 'robot.tip': 'tool0'}
    values = flatten(build(PlantConfig, given))
    found = {True: set(), False: set()}
    for param in parameters(PlantConfig):
        if param.length == ('joints',):
            found[param.omittable].add(len(values[param.name]))
    assert found == {True: {0}, False: {6}}


def test_limits_are_inclusive_and_arrays_as_long_as_others_say():
    limits = {'sample_time': 1.0, 'actuator.delay': 1000, 'learning.interval': 1}
    for cls, given in (
        (PlantConfig, {'sensor.published_joints': [], 'load.force': [0.0] * 3}),
        (PlantConfig, {'events.begin': [1.0, 2.0], 'events.force': [0.0] * 6}),
        (ControllerConfig, {'learning.window': 10.0}),
    ):
        known = flatten(cls())
        valid = given | {name: value for name, value in limits.items() if name in known}
        assert (
            flatten(build(cls, valid)).items()
            >= {
                name: tuple(value) if isinstance(value, list) else value
                for name, value in valid.items()
            }.items()
        )
    assert build(ControllerConfig, {'learning.window': 0.01}).learning.window == 0.01


@pytest.mark.parametrize(
    ('classes', 'given', 'message'),
    [
        # Names.
        (
            PLANT,
            {'sensr.offset': [1.0, 1.0]},
            'unknown parameter, did you mean sensor.offset?',
        ),
        (
            PLANT,
            {'sim_plant.duration': 1.0},
            'unknown parameter, did you mean duration?',
        ),
        (
            PLANT,
            {'load': {'torque': [1.0, 2.0]}},
            'a group, no parameter: give those in it by name, such as load.',
        ),
        # Types. ROS does not accept an integer for a double, nor does a run without
        # ROS.
        (
            PLANT,
            {'duration': 1},
            'got 1, but a double is expected, with a decimal point',
        ),
        (
            PLANT,
            {'load.torque': [1, 2]},
            'got [1, 2], but a double array is expected, with a dec',
        ),
        (
            CONTROLLER,
            {'reference.waypoints': np.zeros((1, 2))},
            'got [[0.0, 0.0]], but a double array is expected: write all entries as one',
        ),
        (PLANT, {'duration': '1'}, 'got "1", but a double is expected'),
        (
            PLANT,
            {'duration': '0,5'},
            'got "0,5", but a double is expected: write a decimal point, 0.5',
        ),
        (
            PLANT,
            {'duration': '1.0'},
            'got "1.0", but a double is expected: write it without quotes',
        ),
        (
            PLANT,
            {'load.torque': ['1.0', '2.0']},
            'got ["1.0", "2.0"], but a double array is expected: write it without quotes',
        ),
        (
            PLANT,
            {'publish_clock': 'no'},
            'got "no", but a bool is expected: write it without quotes',
        ),
        (PLANT, {'duration': True}, 'got true, but a double is expected'),
        (PLANT, {'seed': True}, 'got true, but an integer is expected'),
        (PLANT, {'seed': 2.0}, 'got 2.0, but an integer is expected'),
        (PLANT, {'publish_clock': 1}, 'got 1, but a bool is expected'),
        (PLANT, {'mode': 3}, 'got 3, but a string is expected'),
        (PLANT, {'duration': None}, 'got null, but a double is expected'),
        (
            PLANT,
            {'load.torque': 1.0},
            'got 1.0, but a double array is expected: write a list, lik',
        ),
        (
            PLANT,
            {'joints': 'xy'},
            'got "xy", but a string array is expected: write a list, like',
        ),
        (PLANT, {'joints': ['x', 1]}, 'got ["x", 1], but a string array is expected'),
        # Ranges.
        (PLANT, {'arm.l1': 0.0}, 'got 0.0, but it must be above 0 m'),
        (
            PLANT,
            {'truth.mass_deviation': 1.0},
            'got 1.0, but it must be at least 0 and below 1',
        ),
        (
            PLANT,
            {'actuator.delay': -1},
            'got -1, but it must be at least 0 and at most 1000 sam',
        ),
        (
            PLANT,
            {'actuator.delay': 1001},
            'got 1001, but it must be at least 0 and at most 1000',
        ),
        (
            PLANT,
            {'mode': 'slow'},
            'got "slow", but it must be one of realtime, lockstep',
        ),
        (
            PLANT,
            {'disturbance.coulomb': [1.0, -0.5]},
            'got -0.5 at entry 2 of [1.0, -0.5], but it',
        ),
        (
            PLANT,
            {'disturbance.coulomb': [-1.0, -0.5]},
            'got -1.0 at entry 1 of [-1.0, -0.5], but it must be at least 0 N m; likewise entry 2',
        ),
        (PLANT, {'duration': float('nan')}, 'got .nan, but a finite number is needed'),
        (
            PLANT,
            {'load.torque': [-float('inf'), 1.0]},
            'got -.inf at entry 1 of [-.inf, 1.0], but a',
        ),
        # Lengths.
        (BOTH, {'joints': []}, 'got an empty list, but at least one entry is needed'),
        (
            PLANT,
            {'load.torque': [1.0]},
            'got 1, but 2 entries are needed (2 of joints)',
        ),
        (
            PLANT,
            {'events.force': [1.0], 'events.begin': [1.0]},
            'got 1, but 3 entries are needed (1 of',
        ),
        (
            CONTROLLER,
            {'reference.phase': [0.0, 1.0]},
            'got 2, but 1 entry is needed (1 of refe',
        ),
        # What parameters have to do with each other.
        (BOTH, {'joints': ['elbow', 'elbow']}, "the name 'elbow' is repeated"),
        (PLANT, of_one_joint(PlantConfig), 'got 1, but'),
        (CONTROLLER, of_one_joint(ControllerConfig), 'got 1, but'),
        (
            BOTH,
            {'sample_time': 1 / 3000},
            f'got {1 / 3000} s, not a whole number of nanoseconds: write 0.000333333',
        ),
        (
            PLANT,
            {'duration': 0.0005},
            'got 0.0005 s, shorter than one sample of 0.001 s',
        ),
        (
            CONTROLLER,
            {
                'learning.initial_estimate': [1.0, 1.0],
                'learning.adaptation_gain': [1.0, 1.0],
            },
            'got 2, but model two_link has 3 parameters',
        ),
        # |P^(0)| = |(3, 0, 4)| = 5 by Pythagoras: on the ball is not inside it.
        (
            CONTROLLER,
            {'learning.radius': 5.0, 'learning.initial_estimate': [3.0, 0.0, 4.0]},
            'got 5 kg m^2, but learning.initial_estimate has a norm of 5 kg m^2',
        ),
        (
            CONTROLLER,
            {'learning.radius': 1.1, **TRUE_MODEL},
            'got 1.1 kg m^2, but truth.paramet',
        ),
        (
            CONTROLLER,
            {'learning.window': 0.009},
            'got 0.009 s, which is 9 samples of 0.001',
        ),
        (
            CONTROLLER,
            {'learning.window': 5.0, 'sample_time': 1.0},
            (
                'got 5 s, which is 5 samples of 1 s: between 10 and 1000000 are allowed; '
                'if sample_time is in ms, give 0.001'
            ),
        ),
        (
            CONTROLLER,
            {'learning.window': 1000.001},
            'got 1000 s, which is 1000001 samples',
        ),
        (
            CONTROLLER,
            {'truth.parameters': [1.0, 0.3]},
            'got 2, but model two_link has 3',
        ),
        (
            CONTROLLER,
            {'barrier.slope_limit': [2e4, 2e4], 'barrier.weight': [1e3, 2e4]},
            'got 20000 N m/rad for joint2, but it must be above barrier.weight',
        ),
        (
            CONTROLLER,
            {'barrier.initial_bound': [0.003, 0.001], 'barrier.funnel_rate': 1.0},
            'got 0.001 rad for joint2, but it must be 0 (no funnel) or at',
        ),
        (
            CONTROLLER,
            {'barrier.funnel_rate': 0.0, 'barrier.initial_bound': [0.003, 0.003]},
            'got 0 1/s, but',
        ),
        (
            CONTROLLER,
            {'truth.parameters': [], 'law': 'model_based'},
            'got none, but the law model_based needs them',
        ),
        (
            CONTROLLER,
            {'reference.times': [], 'reference.type': 'waypoints'},
            'got none',
        ),
        (
            CONTROLLER,
            {'reference.times': [2.0, 2.0], 'reference.waypoints': [0.0] * 4},
            'got 2 s after 2 s, but they must increase',
        ),
        (
            CONTROLLER,
            {'limits.position_upper': [1.0, 1.0], 'limits.position_lower': [-1.0, 1.0]},
            'got 1 rad for joint2, but it must be above',
        ),
        (CONTROLLER, {'limits.jerk': [0.0, 1.0]}, 'got 0.0 at entry 1 of'),
        (CONTROLLER, {'limits.jerk': [1.0, -1.0]}, 'got -1.0 at entry 2 of'),
        (CONTROLLER, {'limits.jerk': [1.0, NAN]}, 'got .nan at entry 2 of'),
        (CONTROLLER, {'limits.jerk': [1.0]}, 'got 1, but 2 entries are needed'),
        (CONTROLLER, {'limits.jerk': 1.0}, 'got 1.0, but a double array is expected'),
        # Of an arm that cannot be read, no lengths are known.
        (
            BOTH,
            {'robot.urdf': 'no.urdf', 'joints': ['a'] * 7},
            "'no.urdf' cannot be read",
        ),
    ],
)
def test_invalid_value_is_rejected_with_what_it_is_and_what_is_expected(
    classes, given, message
):
    name = next(iter(given))
    for cls in classes:
        (problem,) = problems_of(cls, given)
        assert problem.startswith(f'{name}: {message}')


def test_long_value_of_another_type_is_shortened():
    (problem,) = problems_of(ControllerConfig, {'law': list(range(1000))})
    assert problem.startswith('law: got [0, 1, 2, ')
    assert problem.endswith(' ..., but a string is expected: write it in quotes')
    assert len(problem) < 300


@pytest.mark.parametrize(
    ('given', 'remedy'),
    [
        ([0, 29, 0, 29], ', with a decimal point: a comma separates entries; if 0,035'),
        ([0, 29, 0, 5], ', with a decimal point: a comma separates entries; if 0,035'),
        ([1, 5, 1, 5], ', with a decimal point: a comma separates entries; if 0,035'),
        (['0,5', '1,5'], ': write a decimal point, 0.5, 1.5'),
        ([0, 5], ', with a decimal point'),
        ([0, 1, 0], ', with a decimal point'),
        ([0, 0, 0, 0], ', with a decimal point'),
        ([2, 2, 2, 2], ', with a decimal point'),
        ([1, 5, 2, 5], ', with a decimal point'),
        (['0,5,1', '1'], ''),
    ],
)
def test_decimal_comma_is_noticed(given, remedy):
    with pytest.raises(ConfigurationError) as raised:
        build(PlantConfig, {'load.torque': given})
    (problem,) = raised.value.problems
    end = problem.partition('a double array is expected')[2]
    assert end.startswith(remedy)
    assert ('0,035' in end) == ('0,035' in remedy)
    assert bool(end) == bool(remedy)


def test_problems_of_all_parameters_are_reported_at_once():
    found = problems_of(
        PlantConfig, {'bogus': 1, 'joints': ['a', 'b', 'c'], 'load.force': [1.0]}
    )
    assert found[0] == 'bogus: unknown parameter'
    assert 'load.force: got 1, but 3 entries are needed (3)' in found
    assert 'load.torque: got 2, but 3 entries are needed (3 of joints)' in found
    found = problems_of(ControllerConfig, {'reference.frequency': [1.0, 2.0], 'zzz': 1})
    lengths = (
        'got 2, but 4 entries are needed (2 of joints times 2 of reference.frequency)'
    )
    assert found[:2] == ['zzz: unknown parameter', f'reference.amplitude: {lengths}']
    assert found[2].startswith('reference.phase: got 1, but 2 entries are needed')
    found = problems_of(PlantConfig, {'duration': 0.0005, 'bogus': 1})
    assert [problem.split(':')[0] for problem in found] == ['bogus', 'duration']


def test_recommended_preset_equals_the_defaults():
    assert load_loop('recommended') == (
        PlantConfig(),
        ControllerConfig(),
        RecorderConfig(),
    )


def test_choices_match_the_law():
    choices = {entry.name: entry.choices for entry in parameters(ControllerConfig)}
    for law in choices['law']:
        settings_of_config(build(ControllerConfig, TRUE_MODEL | {'law': law}))
    of_paper = {entry.name: entry.choices for entry in parameters(Paper)}
    for name, numbers in (
        ('prediction', {'filtered': FILTERED, 'lambda': LAMBDA}),
        ('update', {'newton': NEWTON, 'gradient': GRADIENT}),
        ('compensation', {'reference': state.REFERENCE, 'state': state.STATE}),
    ):
        given = of_paper[name]
        assert {choice: k for k, choice in enumerate(given)} == numbers


@pytest.mark.parametrize('cls', NODES.values(), ids=NODES)
def test_defaults_are_valid_and_every_parameter_is_described(cls):
    assert build(cls, {}) == cls()
    for entry in parameters(cls):
        assert entry.description
        if entry.type is int:
            assert entry.at_least is not None, entry.name


def test_valid_values_are_not_put_into_words(monkeypatch):
    """A gain changes between two samples.

    The words of all values would take several.
    """
    config = load_loop('panda').controller
    monkeypatch.setattr(
        schema, 'format_value', lambda _: pytest.fail('a valid value was formatted')
    )
    assert change(config, {'telemetry.decimation': 3}).telemetry.decimation == 3


@pytest.mark.parametrize(('given', 'kept'), [(True, 'on'), (False, 'off')])
def test_on_and_off_may_be_written_without_quotes(given, kept):
    """YAML reads them as true and false."""
    config = build(ControllerConfig, {'safety.watchdog': given})
    assert config.safety.watchdog == kept
    with pytest.raises(ConfigurationError, match='got true, but a string is expected'):
        build(ControllerConfig, {'safety.torque': True})


ODD = [
    '',
    'x',
    0,
    -1,
    1e308,
    2**62,
    True,
    [],
    ['x'],
    [1e308] * 2,
    [1.0] * 4,
    [[]],
    None,
]


def test_any_value_of_a_parameter_is_accepted_or_refused():
    """Values of a stranger's journal too: no other error ends the nodes that read it."""
    given = flatten(load_loop('fr3').controller)
    for name in given:
        for odd in ODD:
            with suppress(ConfigurationError), np.errstate(all='ignore'):
                build(ControllerConfig, {**given, name: odd})
