# SPDX-License-Identifier: Apache-2.0
"""The arm of a bag is identified without its controller, and with honest confidence."""

from __future__ import annotations

import numpy as np
import pytest
import recorded_run

from blf_dsc_controller.bags.offline import write_bag
from blf_dsc_controller.bags.topics import JOINT_STATES
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import PLANT
from blf_dsc_controller.configuration.params_file import load_loop, locate
from blf_dsc_controller.replay.errors import ShortBagError
from blf_dsc_controller.replay.identify import identify
from blf_dsc_controller.simulation import simulate
from blf_dsc_controller.tools.bag_replay import main

TRUE = np.array([1.0, 0.32, 0.4])  # of the recommended plant: (m1+m2) l1^2, m2 l2^2, m2 l1 l2


def record(path, preset='recommended', **plant):
    config = load_loop(locate(preset), {PLANT: {'duration': 8.0, **plant}})
    run = simulate(config.controller, config.plant)
    write_bag(path, run, config.controller, 'none', config.plant)
    return path


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    return record(tmp_path_factory.mktemp('learn') / 'bag')


def test_the_parameters_are_found(bag):
    found = identify(bag, ControllerConfig())
    assert found.names[:3] == ('(m1+m2)*l1^2', 'm2*l2^2', 'm2*l1*l2')
    # What the law itself finds in its first window is as good: its rows are these.
    assert found.estimate[:3] == pytest.approx(TRUE, rel=2e-3)
    assert found.is_excited
    assert found.end - found.begin == pytest.approx(2 * np.pi, abs=0.002)


@pytest.mark.parametrize('seed', [1, 2, 3])
def test_noise_leaves_the_truth_within_the_confidence_told(tmp_path, seed):
    noise = {'sensor.position_noise': 1e-5, 'sensor.velocity_noise': 1e-3, 'seed': seed}
    noise['disturbance.amplitude'] = [0.0, 0.0]  # which would be left over, and widen all
    found = identify(record(tmp_path / 'bag', **noise), ControllerConfig())
    # Four deviations: of nine draws none should be further off.
    assert (np.abs(found.estimate[:3] - TRUE) < 4.0 * found.deviation[:3] + 2e-3 * TRUE).all()
    assert (found.deviation[:3] < 0.1 * TRUE).all()


def test_joint_states_with_their_effort_are_enough(bag, tmp_path):
    entries = [one for one in recorded_run.messages(bag) if one[0] == JOINT_STATES.resolved]
    path = recorded_run.write(tmp_path / 'bag', entries)
    alone = identify(path, ControllerConfig())
    assert alone.source == 'effort of /joint_states'
    assert alone.estimate == pytest.approx(identify(bag, ControllerConfig()).estimate, rel=1e-6)


def test_a_bag_too_short_is_told(tmp_path):
    path = recorded_run.record(tmp_path / 'bag', 0.3)
    with pytest.raises(ShortBagError, match=r'holds 0\.3 s, .* window of 6\.28 s'):
        identify(path, ControllerConfig())


def test_the_command_tells_figures_and_excitation(bag, capsys):
    assert main([str(bag), '--learn']) == 0
    said = capsys.readouterr().out
    assert '(m1+m2)*l1^2' in said
    assert ' +- ' in said
    assert ': enough; left over' in said
