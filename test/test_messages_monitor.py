# SPDX-License-Identifier: Apache-2.0
"""The monitor topic: distance to the bound, (29) term by term; its bound (32)."""

from __future__ import annotations

import numpy as np
import pytest
from paper_case import EXACT, configured, instead

from blf_dsc_controller.analysis.metrics import measure
from blf_dsc_controller.analysis.metrics_table import format_table
from blf_dsc_controller.analysis.panels import panels
from blf_dsc_controller.bags.reader import read_run
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import load_loop
from blf_dsc_controller.control.guarded_loop import GuardedLoop
from blf_dsc_controller.control.rejected_columns import rejected_columns
from blf_dsc_controller.control.telemetry import ControllerTelemetry
from blf_dsc_controller.factory.controller import controller_of
from blf_dsc_controller.factory.estimate import estimate_names
from blf_dsc_controller.factory.settings import settings_of_config
from blf_dsc_controller.law import barrier
from blf_dsc_controller.law.lyapunov import (
    decay_rate,
    exponential_bound,
    largest_inertia,
)
from blf_dsc_controller.law.surface import virtual_control
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import JointStateDecoder
from blf_dsc_controller.simulation.loop import simulate, write_bag

LARGEST = np.linalg.eigvalsh([[2.12, 0.72], [0.72, 0.32]])[-1]  # kg m^2, of M stretched
# (32) is for this form
PAPER = instead(compensation='state', bumpless=False)
LEAKY = EXACT | PAPER | {'two_link.leakage': 0.02, 'disturbance.gain': [50.0, 80.0]}


def settings(law):
    return settings_of_config(configured('recommended', 1.0, law).controller)


@pytest.mark.parametrize('wanted', [False, True])
def test_tracking_errors_come_if_they_are_wanted_with_each_torque(wanted):
    """Of the law and of a safe torque; where nobody listens they cost time for nothing."""
    loop = GuardedLoop(ControllerConfig())
    loop.guard.starting.activate()
    errors = []
    for k in range(3):
        if k == 2:
            loop.guard.deactivate()
        torque = loop.guard.update(10**9 + k * 10**6, np.zeros(6))
        sent = loop.messages(torque, errors_wanted=wanted)
        errors.append(topics.TRACKING_ERROR in [topic for topic, _ in sent])
    assert not loop.guard.has_sample
    assert errors == [wanted] * 3


def test_largest_inertia_is_that_of_the_stretched_arm():
    assert largest_inertia(settings(EXACT)) == pytest.approx(LARGEST)


@pytest.mark.parametrize(
    ('law', 'rate'),
    [
        ({'two_link.leakage': 0.0}, 0.0),
        ({'disturbance.gain': [0.0, 1.0]}, 0.0),
        ({'two_link.learning_weight': 0.0}, 0.0),
        ({'law': 'backstepping'}, 0.0),
        ({'truth.parameters': []}, 0.0),
        ({'gains.compensation': 'reference'}, 0.0),
        ({'gains.bumpless': True}, 0.0),
        ({}, 0.02 * 50.0),
        ({'two_link.surface_gain': [0.3, 9.0]}, 0.3),
        ({'two_link.learning_weight': 0.1}, 2.0 * 0.1 * 0.5 * 0.003 / (0.003 + 1e-5)),
        (
            {'gains.update': 'gradient', 'two_link.learning_weight': 9.0},
            2.0 * 9.0 * 0.5 * 0.003,
        ),
        ({'two_link.feedback_gain': [9.0, 0.4]}, 2.0 * 0.4 / LARGEST),
    ],
)
def test_decay_rate_is_the_smallest_of_the_four_in_equation_32(law, rate):
    leaky = {
        name: value
        for name, value in LEAKY.items()
        if 'law' not in law or not name.startswith('gains.')
    }
    assert decay_rate(settings(leaky | law)) == pytest.approx(rate)


def test_bound_starts_at_the_latch_and_decays_to_theta_over_kappa_e():
    """Theta = eta |d3|^2 / 2, where |d3| is at most 0.1 + 0.1 N m on each joint."""
    law = settings(LEAKY)
    rate = decay_rate(law)
    floor = 0.5 * 0.02 * 2.0 * 0.2**2 / rate
    t = np.array([1.0, 2.0, 3.5, 1e3, 1001.0, 1002.0])
    V = np.array([3.0, 0.7, 0.1, 0.0, 9.0, 0.5])
    holds = np.array([0, 1, 1, 1, 0, 1]) > 0  # and begins anew
    expected = [
        np.nan,
        0.7,
        floor + (0.7 - floor) * np.exp(-rate * 1.5),
        floor,
        np.nan,
        0.5,
    ]
    assert exponential_bound(law, t, V, holds) == pytest.approx(expected, nan_ok=True)
    assert np.isnan(exponential_bound(settings({}), t, V, holds)).all()


def test_virtual_control_loses_its_gain_past_the_knee():
    """K counts for 7 of its 150 1/s at 0.99 of the bound; the knee is at 0.78."""
    law = settings(LEAKY)
    bound = law.barrier.bound[0]
    ratios = np.array([0.5, law.barrier.knee[0] / bound, 0.99])
    shares = [gain_on_potential(law, ratio * bound) for ratio in ratios]
    assert shares == pytest.approx([150.0, 150.0, 7.1], rel=0.01)


def gain_on_potential(law, xi1):
    """Rate [1/s] at which the part of beta2 with the gain K reduces V1 of joint1 at xi1 [rad]."""
    of = law.barrier
    joint = [part[0] for part in (of.bound, of.weight, of.slope_limit, of.knee)]
    part = virtual_control(xi1, of.bound[0], law.surface.gain[0], 0.0, 0.0)
    return -part * barrier.gradient(xi1, *joint) / barrier.potential(xi1, *joint)


def decoded(raw, *names):
    decoder = JointStateDecoder(names, required=('position',))
    decoder.decode(raw)
    return dict(zip(names, decoder.position, strict=True))


@pytest.mark.parametrize('known', [True, False])
def test_message_contains_the_distance_and_with_known_truth_the_terms(known):
    given = (LEAKY if known else {}) | {'telemetry.decimation': 3}
    config = configured('recommended', 1.0, given).controller
    law = controller_of(config)
    law.update(0.0, 1e-3, np.array([2.293, 1.696, 0.0, 0.0, 0.0, 0.0]))
    telemetry = ControllerTelemetry(config, estimate_names(config))
    names = [
        f'{quantity} {joint}'
        for quantity in ('max_error_ratio', 'distance_to_bound', 'disturbance')
        for joint in config.joints
    ]
    names += [*estimate_names(config), 'lambda_min', 'latched', 'model_changes']
    terms = ['V barrier', 'V velocity', 'V parameters', 'V disturbance'] * known
    sent = [
        list(
            telemetry.sample(10**9, law.sample, np.ones(2), np.array([0.3, 0.2]), time)
        )
        for time in (9e-5, 1e-5, 4e-5, 2e-5)
    ]
    error = topics.TRACKING_ERROR
    slow = [topics.REFERENCE, topics.MONITOR]
    assert [[topic for topic, _ in each] for each in sent] == [
        [topics.BOUND, error, *slow],
        [error],
        [error],
        [error, *slow],
    ]
    _, message = sent[3][-1]
    assert known or b'V barrier' not in message
    values = decoded(message, *names, *terms, 'compute_time')
    assert values['max_error_ratio joint1'] == 0.3
    bound = law.sample.bound
    error = np.abs(law.sample.xi1)
    assert values['distance_to_bound joint1'] == pytest.approx(bound[0] - error[0])
    assert values['distance_to_bound joint2'] == pytest.approx(bound[1] - error[1])
    assert values['compute_time'] == 4e-5  # the largest since the last message
    assert [values[name] for name in terms] == law.sample.lyapunov.tolist() * known


def test_bound_is_sent_at_once_when_it_widens_and_with_the_monitor_while_it_narrows():
    config = configured('recommended', 1.0, {'telemetry.decimation': 3}).controller
    law = controller_of(config)
    law.update(0.0, 1e-3, np.array([2.293, 1.696, 0.0, 0.0, 0.0, 0.0]))
    telemetry = ControllerTelemetry(config, estimate_names(config))
    sent = []
    for k, bound in enumerate((9.0, 8.0, 7.0, 7.0, 6.0, 6.5, 6.5, 7.0, 7.0)):
        sample = law.sample._replace(bound=np.array([5.0, bound]))
        limit = ratio = np.ones(2)
        for topic, raw in telemetry.sample(
            k, sample, limit, ratio, 0.0, subscribed=False
        ):
            if topic is topics.BOUND:
                sent.append((k, decoded(raw, 'joint2')['joint2']))
    assert sent == [(0, 9.0), (3, 7.0), (6, 6.5), (7, 7.0)]


def test_rejected_columns_are_in_the_summary_and_the_lyapunov_function_is_a_panel(
    tmp_path,
):
    """Run of 8 s from a bag, truth known, with a cosine column that the reference cannot excite."""
    learning = {'two_link.frequencies': [1.0], 'two_link.bias': False}
    config = configured('recommended', 8.0, LEAKY | learning)
    names = estimate_names(config.controller)
    for fresh in (config.controller, configured('model_based', 1.0).controller):
        assert rejected_columns(controller_of(fresh), estimate_names(fresh)) == {}
    record = simulate(config.controller, config.plant)
    write_bag(tmp_path / 'bag', record)
    run = read_run(tmp_path / 'bag')
    metrics = measure(run)
    (column,) = metrics.rejected_columns
    assert column.startswith('cos 1 rad/s ')
    (name,) = rejected_columns(record.controller, names)
    assert name == column.partition(':')[0]
    assert f'rejected    {column}: ' in format_table(metrics)
    assert metrics.parameter_error.end < 0.5
    (panel,) = (panel for panel in panels([run]) if panel.group == 'Monitors')
    *terms, V = panel.lines
    assert [line.name for line in terms] == [
        'barrier',
        'velocity',
        'parameters',
        'disturbance',
    ]
    assert V.values[0] == pytest.approx(sum(line.values[0] for line in terms))


def test_rejected_column_is_named_with_the_columns_that_it_resembles():
    """The last of m columns is twice the first less the third; the others are random."""
    config = load_loop('panda').controller
    law = controller_of(config)
    names = estimate_names(config)
    X = np.random.default_rng(0).normal(size=(1000, len(names)))
    X[:, -1] = 2.0 * X[:, 0] - X[:, 2]
    law.state.window.running[:-1, :-1] = np.triu(X.T @ X)
    law.state.latch.active[:] = 1.0
    law.state.latch.active[-1] = 0.0
    ((name, reason),) = rejected_columns(law, names).items()
    assert name == names[-1]
    assert f'it from {names[0]} + {names[2]} (100 % of it' in reason
