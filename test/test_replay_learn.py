# SPDX-License-Identifier: Apache-2.0
"""Learning from a bag without its controller: estimates and their standard deviations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import recorded_run

from blf_dsc_controller.cli.main import main
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import PLANT, load_loop
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.codecs import JointStateDecoder, JointStateEncoder
from blf_dsc_controller.messages.topics import JOINT_STATE, JOINT_STATES
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


def test_parameters_are_identified(bag):
    found = learn(bag, ControllerConfig())
    assert found.names[:3] == ('(m1+m2)*l1^2', 'm2*l2^2', 'm2*l1*l2')
    # The law's own first window is as accurate: it has the same rows.
    assert found.estimate[:3] == pytest.approx(TRUE, rel=2e-3)
    assert found.is_excited
    assert found.end - found.begin == pytest.approx(2 * np.pi, abs=0.002)


def test_truth_is_within_the_deviations_despite_noise(tmp_path):
    noise = {'sensor.position_noise': 1e-5, 'sensor.velocity_noise': 1e-3}
    noise['disturbance.amplitude'] = [0.0, 0.0]  # its residual would widen every deviation
    runs = [record(tmp_path / f'{seed}', **noise, seed=seed) for seed in range(4)]
    results = [learn(run, ControllerConfig()) for run in runs]
    estimates = np.array([result.estimate[:3] for result in results])
    deviation = np.array([result.deviation[:3] for result in results])
    # None of the twelve draws should be off by four deviations; 2e-3 is the effect of sampling.
    assert (np.abs(estimates - TRUE) < 4.0 * deviation + 2e-3 * TRUE).all()
    # The deviations are the spread of the draws, which four draws show to a factor of three.
    spread = np.sqrt(np.mean(estimates.var(axis=0, ddof=1) / deviation.mean(axis=0) ** 2))
    assert 0.1 < spread < 3


def test_unmodelled_sinusoid_widens_the_affected_deviations_and_is_noted(bag):
    """Of 0.1 + 0.1 sin t N m only the bias is a column; the sine shifts m2 l2^2 with its phase."""
    found = learn(bag, ControllerConfig())
    assert (np.abs(found.estimate[:3] - TRUE) < 2.0 * found.deviation[:3] + 1e-4).all()
    assert found.deviation[0] < 0.003  # not affected; 0.024 by the size of the residual alone
    assert found.deviation[1] > 0.03  # at another phase of the sine the estimate is off by 0.17
    assert 'a torque that lasts' in ''.join(found.notes)
    assert list(found.doubts) == []


def rewritten(bag, path, change):
    """Write only the bag's joint states; `change` edits each [q, dq, effort] or drops the state."""
    decoder, encoder = (
        codec(('joint1', 'joint2')) for codec in (JointStateDecoder, JointStateEncoder)
    )
    entries = []
    for k, entry in enumerate(recorded_run.of(recorded_run.messages(bag), JOINT_STATES)):
        stamp, values = decoder.decode(entry[3]), decoder.values.reshape(3, 2).copy()
        if change(k, values):
            entries.append([*entry[:3], encoder.encode(stamp, *values)])
    return recorded_run.write(path, entries)


def spoil(k, values):
    if k == 3000:
        values[0, 1] = np.nan
    if k < 40:
        values[2] = np.nan  # no torque yet
    return True


def test_non_finite_states_are_left_out(bag, tmp_path, capsys):
    path = rewritten(bag, tmp_path / 'bag', spoil)
    found = learn(path, ControllerConfig())
    assert found.estimate[:3] == pytest.approx(TRUE, rel=2e-3)
    assert found.left_out == 41
    assert main(['replay', str(path), '--config', 'recommended']) == 0
    output = capsys.readouterr().out
    assert 'note: 41 states left out: not finite' in output
    assert 'nan' not in output


def test_window_has_the_same_duration_at_any_rate(bag, tmp_path):
    found = learn(rewritten(bag, tmp_path / 'bag', lambda k, _: k % 2 == 0), ControllerConfig())
    assert found.end - found.begin == pytest.approx(2 * np.pi, abs=0.004)
    # The effort of a state is the torque of the second half of its interval.
    assert found.estimate[:3] == pytest.approx(TRUE, rel=0.02)


def test_rows_are_not_weighted_by_the_speed_of_an_unknown_reference(bag):
    config = ControllerConfig()
    scaled = replace(config, learning=replace(config.learning, motion_scale=0.05))
    assert learn(bag, scaled).estimate == pytest.approx(learn(bag, config).estimate)


def swap_torques(_, values):
    values[2] = values[2, ::-1].copy()
    return True


def modulate_torques(k, values):
    values[2] *= np.sin(0.01 * k)
    return True


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        (swap_torques, 'UNPHYSICAL: the smallest eigenvalue of the inertia matrix is -0.5'),
        (modulate_torques, 'RESIDUAL TOO LARGE'),
    ],
)
def test_implausible_estimates_are_flagged(bag, tmp_path, capsys, change, message):
    path = rewritten(bag, tmp_path / 'bag', change)
    assert main(['replay', str(path), '--learn', '--config', 'recommended']) == 0
    assert message in capsys.readouterr().out


def test_joint_states_with_effort_are_sufficient(bag, tmp_path):
    entries = [entry for entry in recorded_run.messages(bag) if entry[0] == JOINT_STATES.resolved]
    path = recorded_run.write(tmp_path / 'bag', entries)
    alone = learn(path, ControllerConfig())
    assert alone.source == 'effort of /joint_states'
    assert alone.estimate == pytest.approx(learn(bag, ControllerConfig()).estimate, rel=1e-6)


def test_bag_shorter_than_the_window_is_rejected(tmp_path):
    path = recorded_run.record(tmp_path / 'bag', 0.3)
    with pytest.raises(BlfDscError, match=r'holds 0\.3 s, .* window of 6\.28 s'):
        learn(path, ControllerConfig())


def test_states_a_nanosecond_apart_are_too_few(tmp_path):
    """Their sample time would make the window of the learning larger than any memory."""
    encoder = JointStateEncoder(('joint1', 'joint2'))
    states = [
        ['/joint_states', JOINT_STATE, at, encoder.encode(at, [1, 1], [0, 0], [2, 2])]
        for at in (5, 6, 7)
    ]
    with pytest.raises(BlfDscError, match='too short for a window'):
        learn(recorded_run.write(tmp_path / 'bag', states), ControllerConfig())


def test_command_prints_estimates_and_excitation(bag, capsys):
    assert main(['replay', str(bag), '--learn']) == 0
    output = capsys.readouterr().out
    assert '(m1+m2)*l1^2' in output
    assert ' +- ' in output
    assert ': enough; residual' in output
