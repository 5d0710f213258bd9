# SPDX-License-Identifier: Apache-2.0
"""Configurations of the nodes: presets, agreement with the law, and rejected values."""

from __future__ import annotations

import subprocess
import sys

import pytest

from blf_dsc_controller.arms.model import arm_model
from blf_dsc_controller.configuration.controller import MODELS, ControllerConfig, parameter_count
from blf_dsc_controller.configuration.nodes import (
    NODES,
    LoopConfig,
    RecorderConfig,
    load_loop,
)
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import build, change, parameters
from blf_dsc_controller.errors import ConfigurationError
from blf_dsc_controller.law import factory, settings

DEFAULTS = LoopConfig(PlantConfig(), ControllerConfig(), RecorderConfig())


def problems_of(cls, given):
    with pytest.raises(ConfigurationError) as caught:
        build(cls, given)
    return caught.value.problems


def test_recommended_preset_equals_the_defaults():
    assert load_loop('recommended') == DEFAULTS


def test_models_and_choices_match_the_law():
    assert MODELS == {'two_link': 2, 'planar_chain': None, 'urdf': None}
    for name, n in (('two_link', 2), *(('planar_chain', n) for n in (1, 2, 7))):
        model = arm_model(name, n, l1=1.0, gravity=9.8)
        assert model.n == n
        assert parameter_count(n) == len(model.parameter_names)
    choices = {entry.name: entry.choices for entry in parameters(ControllerConfig)}
    for law in choices['law']:
        given = {'law': law, 'truth.parameters': [1.0, 0.32, 0.4]}  # model_based needs them
        factory.settings_of_config(build(ControllerConfig, given))
    assert sorted(choices['learning.update']) == sorted(settings.UPDATES)
    assert sorted(choices['learning.torque_source']) == sorted(settings.TORQUE_SOURCES)


@pytest.mark.parametrize('cls', NODES.values(), ids=NODES)
def test_defaults_are_valid_and_every_parameter_is_described(cls):
    assert build(cls, {}) == cls()
    for parameter in parameters(cls):
        assert parameter.description
        if parameter.kind.value == 'integer':
            assert parameter.at_least is not None, parameter.name


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
        ({'barrier.bound': [0.002, 0.0]}, 'barrier.bound: got 0.0 at entry 2'),
        ({'barrier.bound': [0.002]}, 'barrier.bound: got 1 entry, but 2 are needed (2 of joints)'),
        ({'feedback.gain': [-60.0, 20.0]}, 'feedback.gain: got -60.0 at entry 1'),
        (
            {'feedback.boundary_layer': 0.0},
            'feedback.boundary_layer: got 0.0, but it must be above',
        ),
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
        (
            {'law': 'model_based', 'truth.parameters': [1.0, 0.32, 0.4], 'learning.radius': 1.1},
            'learning.radius: got 1.1 kg m^2, but truth.parameters have a norm of 1.12357 kg',
        ),
        (
            {'learning.window': 0.009},
            'learning.window: got 0.009 s, which is 9 samples of 0.001 s: between 10 and',
        ),
        ({'learning.window': 1000.001}, 'learning.window: got 1000 s, which is 1000001 samples'),
        (
            {'barrier.weight': [1000.0, 2e4]},
            'barrier.slope_limit: got 20000 N m/rad for joint2, but it must be above barrier.w',
        ),
        (
            {'barrier.initial_bound': [0.003, 0.001], 'barrier.funnel_rate': 1.0},
            'barrier.initial_bound: got 0.001 rad for joint2, but it must be 0 (no funnel) or at',
        ),
        (
            {'truth.parameters': [1.0, 0.32]},
            'truth.parameters: got 2 entries, but model two_link has 3 parameters',
        ),
        ({'barier.bound': [1.0, 1.0]}, 'barier.bound: unknown parameter, did you '),
    ],
)
def test_invalid_controller_configuration_is_rejected(given, message):
    (problem,) = problems_of(ControllerConfig, given)
    assert problem.startswith(message)


def test_shortest_window_and_two_tone_reference_are_accepted():
    assert build(ControllerConfig, {'learning.window': 0.01}).learning.window == 0.01
    two_tones = {
        'reference.frequency': [1.0, 2.0],
        'reference.phase': [0.0, 0.5],
        'reference.amplitude': [0.3, 0.1, 0.2, 0.4],
    }
    assert build(ControllerConfig, two_tones).reference.amplitude == (0.3, 0.1, 0.2, 0.4)


def test_run_needs_a_sample_and_a_bag_a_folder():
    (problem,) = problems_of(PlantConfig, {'duration': 0.0005})
    assert problem.startswith('duration: got 0.0005 s, shorter than one sample of 0.001 s')
    (problem,) = problems_of(RecorderConfig, {'output': ' '})
    assert problem == 'output: got no folder name to write the bag into'


def test_plant_and_controller_must_agree():
    assert DEFAULTS.problems() == []
    faster = DEFAULTS._replace(plant=change(DEFAULTS.plant, {'sample_time': 0.0005}))
    (problem,) = faster.problems()
    assert problem.startswith('sample_time: sim_plant has 0.0005 s, but blf_dsc_controller has')
    swapped = DEFAULTS._replace(plant=change(DEFAULTS.plant, {'joints': ['joint2', 'joint1']}))
    assert swapped.problems() == []
    other = DEFAULTS._replace(plant=change(DEFAULTS.plant, {'joints': ['joint1', 'elbow']}))
    (problem,) = other.problems()
    assert problem.startswith('joints: sim_plant has joint1, elbow, but blf_dsc_controller has')


def test_configurations_load_without_ros():
    program = (
        'import sys; sys.modules.update(rclpy=None, rcl_interfaces=None, ament_index_python=None)\n'
        'from blf_dsc_controller.configuration.nodes import load_loop, locate\n'
        'print(load_loop(locate("noisy")).plant.actuator.delay)'
    )
    run = subprocess.run(
        [sys.executable, '-c', program], capture_output=True, text=True, check=True
    )
    assert run.stdout == '1\n'
