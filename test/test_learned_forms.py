# SPDX-License-Identifier: Apache-2.0
"""The parameter `robot.learn` from file to figures: an arm of which only the load is unknown."""

from __future__ import annotations

import json

import numpy as np
import pytest
import yaml
from test_law_urdf import panda

from blf_dsc_controller.analysis.metrics import estimates_of
from blf_dsc_controller.analysis.panels import panels
from blf_dsc_controller.arms.prior import LINKS
from blf_dsc_controller.bags.reader import read_run
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.configuration.nodes import load_loop
from blf_dsc_controller.errors import ConfigurationError
from blf_dsc_controller.law.factory import estimate_names, model_of, prior_covariance
from blf_dsc_controller.replay.verify import verify
from sim_plant.plant import parameters_of

DURATION = 3.0  # s, 0.7 s after the first window
MOVED = (1, 3)  # joints, by 0.1 rad
OFFSET = [0.0, 0.0, 0.0, -1.571, 0.0, 1.867, 0.0]  # rad
LEARN_PAYLOAD = {
    '/**': {'robot': {'urdf': 'panda.urdf', 'tip': 'panda_hand_tcp', 'learn': 'payload'}},
    '/**/sim_plant': {'load': {'payload': 2.0}, 'initial': {'position': list(OFFSET)}},
    '/**/blf_dsc_controller': {
        'barrier': {'bound': [0.03] * 7},
        'reference': {
            'type': 'sinusoids',
            'offset': OFFSET,
            'amplitude': [0.1 if joint in MOVED else 0.0 for joint in range(7)],
            'frequency': [2.5],
        },
    },
}


def write_config(path, **robot):
    """Write the parameter file of that arm, with changes to its group `robot`."""
    sections = {name: {'ros__parameters': dict(values)} for name, values in LEARN_PAYLOAD.items()}
    common = sections['/**']['ros__parameters']
    common['robot'] = common['robot'] | robot
    path.write_text(yaml.safe_dump(sections), encoding='utf-8')
    return path


@pytest.fixture(scope='module')
def out(tmp_path_factory):
    """Folder of a run."""
    folder = tmp_path_factory.mktemp('run')
    arguments = ['--config', write_config(folder / 'my.yaml'), '--duration', DURATION]
    assert main(['run', '--offline', *map(str, [*arguments, '--out', folder / 'out'])]) == 0
    return folder / 'out'


def test_load_is_learned_within_a_window_of_poor_excitation(out):
    summary = json.loads((out / 'summary.json').read_text(encoding='utf-8'))
    learning = summary['learning']
    assert learning['latch_time_s'] < 2.5
    # The simulated arm is nearly ideal; the rest is due to the weight of the prior.
    assert learning['final_torque_error'] < 0.01
    assert learning['final_estimate']['load m'] == pytest.approx(2.0, rel=0.02)
    assert learning['final_estimate']['links'] == pytest.approx(1.0, abs=0.001)
    assert learning['true_parameters_of_other_names'] == []


def test_torque_error_is_relative_to_the_base_parameters_of_the_plant(out):
    run = read_run(out / 'bag')
    estimates, loop = estimates_of(run), load_loop(out / 'config.yaml')
    names, regressor = run.arm.base
    P = parameters_of(loop.plant)
    q = run.reference[1::7]
    states = (q, 0.0 * q, 0.0 * q, 0.0 * q)
    true = regressor(*states) @ P
    error = np.linalg.norm(run.arm.regressor(*states) @ estimates.estimate[-1] - true)
    total = np.linalg.norm(true)
    assert run.truth.names[: P.size] == names
    # The arm hardly moves: nearly all of its torque is gravity.
    assert estimates.relative_error[-1] == pytest.approx(error / total, rel=0.1)


def test_figures_show_the_load_in_its_units(out):
    assert (out / 'parameters.png').stat().st_size > 10_000
    shown = {panel.title: panel for panel in panels([read_run(out / 'bag')])}
    (mass,) = shown['load [kg]'].lines
    assert (mass.name, shown['load [kg]'].unit) == ('m', 'kg')
    assert mass.values[-1] == pytest.approx(2.0, rel=0.02)
    assert [line.name for line in shown['load [kg m]'].lines] == [f'm*c{k}' for k in 'xyz']
    assert len(shown['load [kg m^2]'].lines) == 6
    assert [line.name for line in shown['rotor [kg m^2]'].lines] == [
        f'rotor{k}' for k in range(1, 8)
    ]
    assert 'torque error' in shown


def test_replay_without_ros_is_identical_bit_for_bit(out):
    result = verify(out / 'bag')
    assert result.difference is None
    assert sum(comparison.values for comparison in result.comparisons) > 50 * DURATION * 1000


def test_defaults_depend_on_the_learned_form():
    base, payload, scale = (panda(robot__learn=form) for form in ('base', 'payload', 'scale'))
    assert estimate_names(payload)[7:9] == ('load m', 'load m*cx')
    assert payload.learning.initial_estimate[7:] == (*(0.0,) * 10, 1.0)
    assert scale.learning.initial_estimate[7:] == (1.0,) * 6
    assert payload.learning.window < base.learning.window
    for config in (payload, scale):
        p = model_of(config).p
        assert len(config.learning.initial_estimate) == p == len(config.learning.adaptation_gain)
        # The gains are derived from the same URDF.
        np.testing.assert_allclose(config.barrier.weight, base.barrier.weight, rtol=2e-3)
        assert config.learning.radius >= 10.0 * config.robot.payload
    deviation = np.sqrt(np.diag(prior_covariance(scale)))[: len(scale.learning.initial_estimate)]
    assert deviation[8] == pytest.approx(LINKS)


def test_two_controllers_do_not_share_working_memory():
    config = panda(robot__learn='payload')
    first, second = model_of(config), model_of(config)
    assert not np.shares_memory(first.combination, second.combination)
    assert not np.shares_memory(first.bodies, second.bodies)


@pytest.mark.parametrize(
    ('robot', 'message'),
    [
        ({'learn': 'everything'}, "robot.learn: got 'everything', but it must be one of base"),
        ({'payload': 0.0}, 'robot.payload: got 0 kg, but learn: payload needs the mass'),
    ],
)
def test_problems_are_reported_with_their_line(tmp_path, robot, message):
    path = write_config(tmp_path / 'my.yaml', **robot)
    (name,) = robot
    lines = path.read_text(encoding='utf-8').splitlines()
    line = next(k for k, text in enumerate(lines, 1) if text.strip().startswith(f'{name}:'))
    with pytest.raises(ConfigurationError, match=f'line {line}: {message}'):
        load_loop(path)


def test_arm_without_urdf_learns_base_parameters_only():
    message = 'robot.learn: got scale, but model two_link learns base only'
    with pytest.raises(ConfigurationError, match=message):
        panda(model='two_link', robot__urdf='', robot__tip='', robot__learn='scale')
