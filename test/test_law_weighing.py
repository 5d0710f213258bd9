# SPDX-License-Identifier: Apache-2.0
"""What the tip holds, weighed in the loop: values, intervals, and no torque depends on it."""

from __future__ import annotations

import numpy as np
import pytest
from paper_case import configured, several

from blf_dsc_controller.analysis.metrics import measure
from blf_dsc_controller.analysis.metrics_table import format_table
from blf_dsc_controller.bags.reader import read_run
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.errors import ConfigurationError
from blf_dsc_controller.law.factory import controller_of
from blf_dsc_controller.law.telemetry import learned_arm, load_text, sample_columns
from blf_dsc_controller.law.weighing import BEFORE, NEWER, describe, solve
from blf_dsc_controller.law.window import add_products
from blf_dsc_controller.replay.verify import verify
from blf_dsc_controller.simulation.loop import simulate, write_bag

# s
PICKED_UP = 8.0
PUT_DOWN = 12.0
END = 15.0
LOAD = 2.0  # kg


def record_of(name, plant=None, **controller):
    """A run of an arm up to 30 % off its URDF that picks up a load and puts it down."""
    event = {'begin': PICKED_UP, 'duration': PUT_DOWN - PICKED_UP, 'payload': LOAD}
    values = several(event) | {
        'truth.mass_deviation': 0.3,
        'sensor.incomplete_states': 0,
    }
    config = configured(name, END, controller, values | (plant or {}))
    return simulate(config.controller, config.plant)


def weighed(record):
    """Loads (N, 8) and the times of all samples [s]."""
    samples = sample_columns(record.samples, record.controller.settings)
    return samples.load, record.stamps * 1e-9


@pytest.fixture(scope='module')
def panda():
    return record_of('panda')


def is_as_told(load, mass, within):
    assert load[0] == pytest.approx(mass, abs=within)
    assert abs(load[0] - mass) < load[4]
    assert load[4] < 4.0 * within  # with the strong friction of a UR5e
    if mass:
        assert (np.abs(load[1:4]) < load[5:]).all()  # held in the tip
        assert (load[5:] < 0.05).all()


@pytest.mark.parametrize('name', ['panda', 'ur5e', 'fr3'])
def test_load_is_weighed_within_three_seconds_with_wrong_links(name, panda):
    """To 5 % of 2 kg, and 50 g if nothing is held; an FR3's drives compensate gravity, wrongly."""
    load, t = weighed(panda if name == 'panda' else record_of(name))
    is_as_told(load[t == PICKED_UP][0], 0.0, 0.05)
    is_as_told(load[t == PUT_DOWN - 1.0][0], LOAD, 0.05 * LOAD)
    is_as_told(load[-1], 0.0, 0.05)
    assert not np.isfinite(load[t < 5.0]).any()  # the first window is not full


def test_change_makes_the_load_unknown_until_the_filters_have_settled(panda):
    load, t = weighed(panda)
    after = (t > PICKED_UP) & (t < PICKED_UP + 1.0)
    unknown = t[after][~np.isfinite(load[after, 0])]
    assert PICKED_UP < unknown[0] < PICKED_UP + 0.2
    assert 0.3 < unknown[-1] - unknown[0] < 0.5
    half = load[(t > unknown[-1]) & (t < PICKED_UP + 1.0), 4]
    assert half[0] > 3.0 * half[-1]


def test_no_torque_depends_on_it(panda):
    without = record_of('panda', **{'learning.weighing': False})
    torque, other = (
        sample_columns(record.samples, record.controller.settings).torque
        for record in (panda, without)
    )
    np.testing.assert_array_equal(torque, other)
    assert not np.isfinite(weighed(without)[0]).any()


def test_solution_is_the_joint_least_squares_of_arm_and_load(panda):
    """As numpy solves the stacked rows with both priors; deviations from the inverse."""
    controller = controller_of(panda.config)
    settings = controller.settings
    state = controller.state
    signals = controller.signals
    random = np.random.default_rng(1)
    n = settings.n
    m = settings.m
    ND = settings.load_columns[:m]
    D = settings.load_scale
    lasting = 7.0
    noise = 0.04
    theta = settings.initial_estimate + 0.1 * random.normal(size=m)
    z = random.normal(size=10)
    blocks = []
    for part, rows, model in ((BEFORE, 90, theta), (NEWER, 60, theta + ND @ z)):
        X = random.normal(size=(rows, n, m))
        u = X @ model + noise * random.normal(size=(rows, n))
        for row in np.concatenate((X, u[:, :, None]), axis=2):
            add_products(row, state.weighed_sums[part])
        state.weighed_rows[part] = rows
        blocks += [X.reshape(-1, m), u.ravel()]
    state.weighed_noise[:] = noise**2, 0.5 * noise**2
    a, (X, u, Xs, us) = lasting * noise**2, blocks
    solve(settings, state, signals, lasting)
    H = np.zeros((m + 10, m + 10))
    H[:m, :m] = settings.information
    H[m:, m:] = np.eye(10)
    prior = np.append(settings.initial_estimate, np.zeros(10))
    both = np.block([[X, np.zeros((len(X), 10))], [Xs, Xs @ ND]])
    g = both.T @ np.append(u, us) + a * H @ prior
    H = both.T @ both + a * H
    expected = np.linalg.solve(H, g)
    model = expected[:m] + ND @ expected[m:]
    np.testing.assert_allclose(signals.load_solution, expected, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(state.weighed_model[:m], model, atol=1e-9)
    residual = np.mean((X @ expected[:m] - u) ** 2), np.mean((Xs @ model - us) ** 2)
    np.testing.assert_allclose(state.weighed_noise, residual, rtol=1e-6)
    describe(settings, state, signals, lasting)
    mass, *moments = D @ expected[m:]
    centre = np.array(moments) / mass
    C = lasting * max(residual) * D @ np.linalg.inv(H)[m:, m:] @ D.T
    J = np.column_stack((-centre, np.eye(3))) / mass
    np.testing.assert_allclose(state.load[:4], (mass, *centre), rtol=1e-6)
    deviation = np.sqrt(np.append(C[0, 0], np.diag(J @ C @ J.T)))
    np.testing.assert_allclose(state.load[4:], deviation, rtol=1e-5)


def test_light_load_that_the_law_does_not_notice_is_weighed():
    record = record_of('panda', {'events.payload': [0.08]})
    load, t = weighed(record)
    assert record.controller.state.changes[0] == 0.0
    is_as_told(load[t == PUT_DOWN - 0.5][0], 0.08, 0.05)
    # The weighing notices it by itself: what it knew before is discarded.
    unknown = t[(t > 6.0) & ~np.isfinite(load[:, 0])]
    assert PICKED_UP < unknown[0] < PICKED_UP + 1.0


def test_weighing_what_cannot_be_weighed_is_rejected():
    given = {'learning.prediction': 'lambda'}
    with pytest.raises(
        ConfigurationError, match=r'weighing: got true with .*, but needs'
    ):
        configured('panda', 1.0, {'learning.weighing': True, **given})
    assert not ControllerConfig().learning.weighing


def test_bag_tells_what_was_held_in_the_table_and_on_the_page(panda, tmp_path):
    write_bag(tmp_path / 'bag', panda)
    run = read_run(tmp_path / 'bag')
    assert run.arm.deviations == learned_arm(panda.config).deviations
    metrics = measure(run)
    held = np.array([(load['until'], load['load mass']) for load in metrics.loads])
    np.testing.assert_allclose(held[:, 0], (PICKED_UP, PUT_DOWN, END), atol=0.2)
    np.testing.assert_allclose(held[:, 1], (0.0, LOAD, 0.0), atol=0.05)
    lines = [
        line for line in format_table(metrics).splitlines() if line.startswith('held ')
    ]
    assert [' mm, until ' in line for line in lines] == [False, True, False]
    result = verify(tmp_path / 'bag')  # which weighs again
    assert (result.difference, result.compared) == (None, 1.0)


def test_text_of_a_load_leaves_out_what_is_unknown():
    nan = float('nan')
    assert load_text([nan] * 8) == 'unknown'
    assert (
        load_text([0.003, nan, nan, nan, 0.0124, nan, nan, nan]) == '0.003 +- 0.012 kg'
    )
    text = load_text([2.0, 0.001, 0.0, -0.02, 0.05, 0.001, 0.002, 0.0031])
    assert text == '2.000 +- 0.05 kg, its centre at 1.0 +- 1, 0.0 +- 2, -20.0 +- 3.1 mm'
