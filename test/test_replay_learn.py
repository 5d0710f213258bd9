# SPDX-License-Identifier: Apache-2.0
"""The arm of a bag is identified without its controller, and with honest confidence."""

from __future__ import annotations

import numpy as np
import pytest
import recorded_run

from blf_dsc_controller.cli.main import main
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import PLANT
from blf_dsc_controller.configuration.params_file import load_loop
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.topics import JOINT_STATES
from blf_dsc_controller.replay.learn import learn
from blf_dsc_controller.simulation.bag import write_bag
from blf_dsc_controller.simulation.loop import simulate

TRUE = np.array([1.0, 0.32, 0.4])  # of the recommended plant: (m1+m2) l1^2, m2 l2^2, m2 l1 l2


def record(path, preset='recommended', **plant):
    config = load_loop(preset, {PLANT: {'duration': 8.0, **plant}})
    run = simulate(config.controller, config.plant)
    write_bag(path, run, config.controller, 'none', config.plant)
    return path


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    return record(tmp_path_factory.mktemp('learn') / 'bag')


def test_the_parameters_are_found(bag):
    found = learn(bag, ControllerConfig())
    assert found.names[:3] == ('(m1+m2)*l1^2', 'm2*l2^2', 'm2*l1*l2')
    # What the law itself finds in its first window is as good: its rows are these.
    assert found.estimate[:3] == pytest.approx(TRUE, rel=2e-3)
    assert found.is_excited
    assert found.end - found.begin == pytest.approx(2 * np.pi, abs=0.002)


def test_noise_leaves_the_truth_within_the_deviations(tmp_path):
    noise = {'sensor.position_noise': 1e-5, 'sensor.velocity_noise': 1e-3}
    noise['disturbance.amplitude'] = [0.0, 0.0]  # which would be left over, and widen all
    runs = [record(tmp_path / f'{seed}', **noise, seed=seed) for seed in range(4)]
    found = [learn(run, ControllerConfig()) for run in runs]
    estimates = np.array([one.estimate[:3] for one in found])
    deviation = np.array([one.deviation[:3] for one in found])
    # Four deviations: of twelve draws none should be further off; 2e-3 is what sampling leaves.
    assert (np.abs(estimates - TRUE) < 4.0 * deviation + 2e-3 * TRUE).all()
    # The deviations cover the spread of the draws, which four of them show to a factor of three. It
    # may be wider: of the residuals only their own correlation is known, not that with X.
    spread = np.sqrt(np.mean(estimates.var(axis=0, ddof=1) / deviation.mean(axis=0) ** 2))
    assert 0.05 < spread < 3


def test_joint_states_with_their_effort_are_enough(bag, tmp_path):
    entries = [one for one in recorded_run.messages(bag) if one[0] == JOINT_STATES.resolved]
    path = recorded_run.write(tmp_path / 'bag', entries)
    alone = learn(path, ControllerConfig())
    assert alone.source == 'effort of /joint_states'
    assert alone.estimate == pytest.approx(learn(bag, ControllerConfig()).estimate, rel=1e-6)


def test_a_bag_too_short_is_rejected(tmp_path):
    path = recorded_run.record(tmp_path / 'bag', 0.3)
    with pytest.raises(BlfDscError, match=r'holds 0\.3 s, .* window of 6\.28 s'):
        learn(path, ControllerConfig())


def test_the_command_prints_estimates_and_excitation(bag, capsys):
    assert main(['replay', str(bag), '--learn']) == 0
    said = capsys.readouterr().out
    assert '(m1+m2)*l1^2' in said
    assert ' +- ' in said
    assert ': enough; residual' in said
