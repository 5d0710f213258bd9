# SPDX-License-Identifier: Apache-2.0
"""Configurations of the nodes: which values are accepted, and how others are rejected."""

from __future__ import annotations

import array
from contextlib import suppress

import numpy as np
import pytest

from blf_dsc_controller.configuration import schema
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import NODES, load_loop
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import build, change, flatten, parameters
from blf_dsc_controller.configuration.side_nodes import RecorderConfig
from blf_dsc_controller.errors import ConfigurationError

NAN = float('nan')
TRUE_MODEL = {'law': 'model_based', 'truth.parameters': [1.0, 0.32, 0.4]}
PLANT = (PlantConfig,)
CONTROLLER = (ControllerConfig,)
BOTH = (PlantConfig, ControllerConfig)


def problems_of(cls, given):
    with pytest.raises(ConfigurationError, match=r'arm\.yaml') as caught:
        build(cls, given, 'arm.yaml')
    return caught.value.problems


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
    defaults = (
        build(cls, {}) for cls in (PlantConfig, ControllerConfig, RecorderConfig)
    )
    assert load_loop('recommended') == tuple(defaults)


@pytest.mark.parametrize('cls', NODES.values(), ids=NODES)
def test_defaults_are_valid_and_every_parameter_is_described(cls):
    assert flatten(build(cls, {})).items() >= flatten(cls()).items()
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
