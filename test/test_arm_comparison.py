# SPDX-License-Identifier: Apache-2.0
"""The comparison of laws on arms from URDFs: identities of the baselines, and the command."""

from __future__ import annotations

import json
import re
from typing import NamedTuple

import numpy as np
import pytest
from scipy.linalg import expm

from blf_dsc_controller.cli.main import main
from blf_dsc_controller.configuration.nodes import load_loop
from blf_dsc_controller.configuration.robot import parameters_of
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.law.factory import settings_of_config
from blf_dsc_controller.reference import terms
from blf_dsc_controller.reference.approach import reference_of
from blf_dsc_controller.studies import laws
from blf_dsc_controller.studies.laws import (
    CONTENDERS,
    INTERVALS,
    ROUGHEST,
    Figures,
    Result,
    cost_of,
    format_results,
    known_of,
    law_changes,
    run,
    simulate_with,
    trial,
)
from blf_dsc_controller.studies.monte_carlo import torque_rows

IDEAL = {
    'truth.mass_deviation': 0.0,
    'truth.centre_deviation': 0.0,
    'truth.rotor_factor': 1.0,
    'disturbance.viscous': [0.0] * 6,
    'disturbance.coulomb': [0.0] * 6,
    'sensor.resolution': 0.0,
    'sensor.velocity': 'measured',
    'sensor.velocity_pole': 0.0,
    'actuator.delay': 0,
    'actuator.time_constant': 0.0,
    'actuator.torque_noise': 0.0,
    'actuator.ripple': 0.0,
    'events.payload': [0.0],
}
IMPORT = 'from blf_dsc_controller.studies.laws import Contender\n'
E0 = 0.004 * np.array([1.0, -0.5, 0.2, 0.8, -1.0, 0.6])  # rad, inside the bound


GAINS = {'position': 900.0, 'velocity': 50.0}


class ComputedTorque(NamedTuple):
    """M (qr'' - k_p e - k_d e') + C q' + G."""

    position: float
    velocity: float
    a: np.ndarray
    H: np.ndarray

    def fill_torque(self, arm, now, torque):
        for i in range(now.q.size):
            self.a[i] = now.ddqr[i] - self.velocity * (now.dq[i] - now.dqr[i])
            self.a[i] -= self.position * (now.q[i] - now.qr[i])
        arm.model.regressor(now.q, now.dq, now.dq, self.a, self.H)
        for i in range(now.q.size):
            torque[i] = 0.0
            for j in range(arm.P.size):
                torque[i] += self.H[i, j] * arm.P[j]


def computed_torque(gains, arm):
    n = arm.bound.size
    return ComputedTorque(**gains, a=np.zeros(n), H=np.zeros((n, arm.P.size)))


def ideal(period):
    """A UR5e true to its URDF, with ideal sensors and drives, in motion E0 off its reference."""
    loop, step = load_loop('ur5e'), {'sample_time': period}
    config = loop.controller
    chain = config.robot.chain(config.joints)
    P = parameters_of(config.robot, chain).of(chain.inertias, config.robot.rotors(chain))
    config = change(config, step | {'learning.initial_estimate': P.tolist()})
    ((q, dq, _),) = terms.sampled(reference_of(config), np.zeros(1))
    start = {'initial.position': (q + E0).tolist(), 'initial.velocity': dq.tolist()}
    plant = change(loop.plant, IDEAL | step | start | {'duration': 0.1})
    return loop._replace(plant=plant, controller=config)


def deviation(period):
    """Largest difference to the errors of e'' + k_d e' + k_p e = 0."""
    errors, torques = simulate_with(ideal(period), computed_torque, GAINS)
    A = np.array([[0.0, 1.0], [-900.0, -50.0]])
    decay = [expm(A * period * k)[0, 0] for k in range(len(errors))]
    np.testing.assert_allclose(errors[0], E0, atol=1e-15)
    assert np.ptp(torques, axis=0).max() > 5.0
    return np.abs(errors - np.outer(decay, E0)).max()


def test_law_of_a_file_acts_at_the_right_time():
    """Computed torque with the true model; the deviation is of first order in the sample time."""
    coarse, fine = deviation(1e-3), deviation(1e-4)
    assert coarse < 0.02 * np.abs(E0).max()
    assert coarse / fine == pytest.approx(10.0, rel=0.1)


def test_torque_is_cut_at_its_limit():
    gains, loop = {'position': 1e9, 'velocity': 0.0}, ideal(1e-3)
    _, torques = simulate_with(loop, computed_torque, gains)
    np.testing.assert_array_equal(np.abs(torques).max(axis=0), loop.controller.torque.limit)


def test_law_is_told_of_the_friction_that_the_controller_knows():
    config = load_loop('ur5e').controller
    known = known_of(config)
    np.testing.assert_array_equal(known.viscous, config.robot.viscous)
    np.testing.assert_array_equal(known.coulomb, config.robot.coulomb)
    assert known.coulomb.min() > 0.0


def test_integral_gain_of_slotine_li_is_the_gain_of_its_disturbance_estimate():
    config = load_loop('ur5e').controller
    chosen = {'law': 'slotine_li', 'comparison.integral_gain': [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]}
    settings = settings_of_config(change(config, chosen))
    assert settings.gamma.tolist() == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    assert not settings_of_config(change(config, {'law': 'slotine_li'})).gamma.any()


@pytest.mark.parametrize('name', [k for k, c in CONTENDERS.items() if isinstance(c.law, str)])
def test_limits_of_the_gain_search_are_valid_configurations(name):
    config, contender = load_loop('panda').controller, CONTENDERS[name]
    for side in ('least', 'most'):
        values = {gain.name: getattr(gain, side) for gain in contender.gains}
        change(config, law_changes(contender, config, values))


def test_every_trial_has_its_own_truth_motion_and_noise():
    trials = [trial('ur5e', seed) for seed in range(4)]
    for get in (
        lambda loop: loop.controller.reference.phase,
        lambda loop: loop.controller.reference.amplitude,
        lambda loop: loop.plant.seed,
        lambda loop: loop.plant.truth.seed,
    ):
        assert len({get(each) for each in trials}) == 4
    assert trials[0].controller.reference == load_loop('ur5e').controller.reference
    assert len({each.controller.learning.initial_estimate for each in trials}) == 1


def test_cost_penalises_rough_torque_and_is_largest_for_a_diverged_run():
    figures = Figures((1e-3, 1e-2, 1e-1, 1e0), 200.0, ROUGHEST / 2.0, ())
    assert cost_of(figures) == pytest.approx(1.5)
    assert cost_of(figures._replace(roughness=10.0 * ROUGHEST)) == pytest.approx(11.5)
    assert cost_of(figures._replace(errors=(np.nan,) * 4)) == 30.0
    assert cost_of(figures._replace(errors=(1e300,) * 4)) == 30.0


def test_table_shows_the_worst_run_of_each_law():
    """Two runs with errors of 1 and 2 mrad, of which the second leaves the bound."""
    inside = Figures((1e-3,) * 4, 0.9, 0.01, (0.02, 0.01))
    outside = Figures((2e-3,) * 4, 1.0, 0.02, (0.03, 0.0))
    results = {
        'proposed': Result({}, None, [inside, outside]),
        'slotine_li_tuned': Result({'position': 3.0}, 1.0, [inside._replace(model=())]),
    }
    heads, proposed, tuned, gains = (
        re.split(r'  +', line) for line in format_results(results).splitlines()
    )
    assert len(heads) == len(proposed) == len(tuned)
    assert proposed[1:] == [*['2.00'] * 4, '3.00', '1.00', '2.0 %', '1 of 2']
    assert tuned[1:] == [*['1.00'] * 4, '-', '-', '1.0 %', '1 of 1']
    assert gains == [f'{tuned[0]}: position 3']


@pytest.fixture(scope='module')
def found(tmp_path_factory):
    """Figures of the smallest run of the command: one arm, one truth, a first population of 5."""
    out = tmp_path_factory.mktemp('arms') / 'out'
    with pytest.MonkeyPatch.context() as patch:
        for name, value in {'POPULATION': 5, 'GENERATIONS': 0, 'TRUTHS': 1}.items():
            patch.setattr(laws, name, value)
        assert main(['arms', '--config', 'ur5e', '--out', str(out)]) == 0
    return json.loads((out / 'figures.json').read_text(encoding='utf-8'))['ur5e']


@pytest.mark.nightly
def test_every_law_is_tuned_and_run_and_learning_finds_the_model(found):
    assert list(found) == list(CONTENDERS)
    for name, contender in CONTENDERS.items():
        assert list(found[name]['gains']) == [gain.name for gain in contender.gains]
        assert len(found[name]['runs']) == 1
        assert len(found[name]['runs'][0]['errors']) == len(INTERVALS)
    before, after = (
        [found[name]['runs'][0]['model'][k] for name in ('proposed', 'no_learning')] for k in (0, 1)
    )
    assert before[0] < before[1] / 2.0
    assert after[0] < after[1] / 5.0  # the URDF does not include the payload


@pytest.mark.nightly
@pytest.mark.parametrize('name', ['proposed_tuned', 'slotine_li_tuned'])
def test_figures_are_reproduced_from_the_gains(found, name):
    """The same seed gives the same figures, in this process too."""
    rows = torque_rows(trial('ur5e', 1000).controller)
    again = run(name, trial('ur5e', 1), found[name]['gains'], rows)
    assert json.loads(json.dumps(again._asdict())) == found[name]['runs'][0]


def test_file_without_a_usable_law_is_rejected(tmp_path, capsys):
    taken = f"{IMPORT}CONTENDERS = {{'slotine_li': Contender('mine')}}"
    for name, text, problem in (
        ('missing.py', None, 'expected a law of the study (proposed, '),
        ('json.py', '', 'there is another module of this name'),
        ('broken.py', '1 / 0', 'cannot be imported: ZeroDivisionError'),
        ('empty.py', '', 'CONTENDERS must be a dict of Contender by name'),
        ('taken.py', taken, 'has a law slotine_li already'),
    ):
        if text is not None:
            (tmp_path / name).write_text(text)
        out = tmp_path / 'out'
        assert main(['arms', '--laws', str(tmp_path / name), '--out', str(out)]) == 1
        assert problem in capsys.readouterr().err
        assert not out.exists()


def test_laws_of_a_file_join_those_chosen_by_name(tmp_path, monkeypatch, capsys):
    assert main(['arms', '--config', 'recommended', '--out', str(tmp_path / 'out')]) == 1
    assert 'got model two_link' in capsys.readouterr().err
    monkeypatch.setattr(laws, 'CONTENDERS', dict(CONTENDERS))
    file = tmp_path / 'law_of_mine.py'
    file.write_text(f"{IMPORT}CONTENDERS = {{'mine': Contender('mine')}}")
    assert laws.chosen_laws([]) == list(CONTENDERS)
    for _ in range(2):  # a worker that was forked has it already
        assert laws.chosen_laws(['slotine_li', str(file)]) == ['proposed', 'slotine_li', 'mine']
