# SPDX-License-Identifier: Apache-2.0
"""Estimates against the truth: by name, of a URDF's arm by torque; readable figures of all."""

from __future__ import annotations

import warnings
from dataclasses import replace

import matplotlib.image
import numpy as np
import pytest
import recorded_run
import synthetic_bag
from synthetic_bag import Synthetic
from test_law_urdf import panda

from blf_dsc_controller.analysis.figures import draw
from blf_dsc_controller.analysis.metrics import (
    bodies_of,
    errors_of_bodies,
    estimates_of,
    format_table,
    measure,
)
from blf_dsc_controller.analysis.panels import panels
from blf_dsc_controller.bags.reader import read_run
from blf_dsc_controller.configuration.schema import flatten
from blf_dsc_controller.law.telemetry import learned_arm
from blf_dsc_controller.messages.journal import decode
from blf_dsc_controller.messages.topics import JOURNAL, LAMBDA_MIN, LATCHED
from blf_dsc_controller.run import LearnedArm, Run, Series

PERIOD = 10_000_000  # ns
TIME = np.arange(1001) * PERIOD * 1e-9
P = np.array([2.0, 3.0, 5.0])  # kg m^2, kg m, and one without effect on the torque


def pendulum(_q, _dq, _v, a):
    """Regressor of a pendulum whose gravity does not depend on its angle."""
    ones = np.ones_like(a)
    return np.stack((a, ones, 0.0 * ones), axis=-1)


def run_of(estimate, true=P, regressor=pendulum):
    """One joint following sin t with these estimates, (3,) or (N, 3)."""
    stamp = np.arange(TIME.size) * PERIOD
    names = ('Izz1', 'm*cx1', 'Ixx1')
    ones = np.ones((TIME.size, 1))
    learned = np.hstack((np.broadcast_to(estimate, (TIME.size, 3)), ones, ones))
    q = np.sin(TIME)[:, np.newaxis]
    return Run(
        joints=('joint1',),
        stamp=stamp,
        received=stamp,
        position=q + 0.01,
        velocity=0 * q,
        torque=0 * q,
        reference=q,
        error=0 * q,
        bound=ones,
        torque_limit=ones,
        monitor=Series((*names, LAMBDA_MIN, LATCHED), stamp, learned),
        truth=Series(names, stamp, np.broadcast_to(true, (TIME.size, 3))),
        arm=LearnedArm(
            dict.fromkeys(names, 'kg'), dict(zip(names, (0.5, 1.0, 2.0), strict=True)), regressor
        ),
    )


def test_parameter_error_is_the_torque_error_along_the_reference():
    assert measure(run_of(1.1 * P)).final_parameter_error == pytest.approx(0.1)
    assert measure(run_of(P * (1.0, 1.0, 7.0))).final_parameter_error == pytest.approx(0.0)
    off = measure(run_of(P * (1.25, 1.0, 1.0))).final_parameter_error
    expected = np.linalg.norm(0.5 * np.sin(TIME)) / np.linalg.norm(3.0 - 2.0 * np.sin(TIME))
    assert off == pytest.approx(expected, rel=0.01)


def test_regressor_is_evaluated_along_the_reference():
    calls = []

    def record(q, dq, v, a):
        calls.append((q[:, 0], dq[:, 0], v[:, 0], a[:, 0]))
        return pendulum(q, dq, v, a)

    estimates_of(run_of(P, regressor=record))
    ((q, dq, v, a),) = calls
    t = np.arcsin(q)
    np.testing.assert_allclose(a, -q, atol=1e-4)
    np.testing.assert_array_equal(dq, v)
    np.testing.assert_allclose(np.abs(dq), np.cos(t), atol=1e-4)


def test_table_and_summary_name_the_torque_error():
    run = run_of(1.1 * P)
    assert measure(run).of_torques
    line = 'torque error of the learned model 5 s 10 %, 10 s 10 %, end 10 %; not below 1 %'
    assert f'model       {line}' in format_table(measure(run)).splitlines()
    still = replace(run, reference=np.full_like(run.reference, np.nan))
    assert np.isnan(measure(still).final_parameter_error)
    assert 'torque error' not in format_table(measure(still))


@pytest.mark.parametrize(('known', 'share'), [(True, 1.0), (False, 0.5)])
def test_estimate_errors_are_shown_in_deviations_of_the_prior(known, share):
    run = run_of(P + np.linspace(0.5, 1.0, TIME.size)[:, np.newaxis])
    run = run if known else replace(run, truth=None)
    title = f'{"errors" if known else "changes"} of the estimates, by link'
    (panel,) = (panel for panel in panels([run]) if panel.title == title)
    off = {line.name: line.values[-1] / share for line in panel.lines}
    assert off == pytest.approx({'Izz1': 200.0, 'm*cx1': 100.0, 'Ixx1': 50.0})  # %


def test_estimates_are_grouped_by_link_and_friction():
    names = (*(f'{kind}{link}' for link in (1, 2) for kind in ('m*cx', 'Izz', 'rotor')),)
    names += ('viscous joint1', 'viscous joint2', 'coulomb joint1', 'coulomb joint2')
    bodies = bodies_of(names)
    sizes = {'link 1': 3, 'link 2': 3, 'viscous': 2, 'coulomb': 2}
    assert {body: len(members) for body, members in bodies.items()} == sizes
    assert bodies_of(names[:3]) == {name: [k] for k, name in enumerate(names[:3])}
    true = np.array([0.0] * 6 + [np.nan] * 4)  # the friction is unknown: how far does it move?
    estimate = np.array([[9.0] * 10, [0.0, 0.0, 0.0, 3.0, 4.0, 0.0, np.nan, 10.0, np.nan, np.nan]])
    found = errors_of_bodies(bodies, estimate, np.tile(true, (2, 1)), np.full(10, 2.0))[:, 1]
    np.testing.assert_allclose(found, (0.0, 250.0 / np.sqrt(3.0), 50.0, np.nan))  # rejected


def test_change_of_the_true_arm_is_marked():
    true = np.tile(P, (TIME.size, 1))
    true[400:500] *= np.linspace(1.01, 1.5, 100)[:, np.newaxis]
    true[500:] *= 1.5
    for panel in panels([run_of(P, true)]):
        marks = [mark.time for mark in panel.marks if mark.text == 'the arm changes']
        first = panel.title in ('error of joint1', 'torque error')
        assert marks == pytest.approx([4.0] if first else [])


@pytest.mark.parametrize('configured', [True, False])
def test_seven_joints_and_sixty_parameters_fit_into_the_figures(tmp_path, configured):
    config = panda()
    arm = learned_arm(config)
    names = tuple(arm.units)
    stamp = np.arange(50) * PERIOD
    wide = np.tile(np.linspace(0.1, 1.0, 50)[:, np.newaxis], (1, 7))
    learned = np.ones((50, len(names) + 2)) * np.arange(len(names) + 2)
    series = Series((*names, LAMBDA_MIN, LATCHED), stamp, learned)
    run = Run(
        *(config.joints, stamp, stamp, wide, wide, wide, wide + 0.001, wide / 1e3, wide, wide),
        monitor=series,
        truth=series,
        arm=arm if configured else None,
    )
    with warnings.catch_warnings():
        warnings.simplefilter('error')  # matplotlib warns when there is no room for the axes
        drawn = draw(run, tmp_path)
    assert [path.name for path in drawn] == ['tracking.png', 'parameters.png']
    for path in drawn:
        assert 1200 < matplotlib.image.imread(path).shape[1] < 2000
    shown = {panel.title: panel for panel in panels([run]) if panel.group == 'Parameters'}
    assert all(len(panel.lines) <= 8 for panel in shown.values())  # as there are colours
    assert set(shown) == (
        {
            'torque error',
            'errors of the estimates, by link',
        }
        if configured
        else {'relative parameter error'}
    )


def reconfigured(messages, values):
    """Messages of a bag whose journal has another configuration."""
    first = recorded_run.of(messages, JOURNAL)[0]
    event = decode(first[3])
    first[3] = event._replace(content={'parameters': values}).encode()
    return messages


def test_arm_of_a_bag_comes_from_its_recorded_configuration(tmp_path):
    config = panda()
    messages = recorded_run.messages(recorded_run.record(tmp_path / 'two_links', 0.1))
    bag = recorded_run.write(tmp_path / 'bag', reconfigured(messages, flatten(config)))
    run = read_run(bag)
    assert run.arm is not None
    assert run.arm.deviations == learned_arm(config).deviations
    # It learned parameters with other names: their error is a norm.
    assert not estimates_of(run).of_torques
    assert read_run(tmp_path / 'two_links').arm is None


def test_estimates_of_other_parameters_than_the_plant_has_are_not_compared(tmp_path):
    run = read_run(synthetic_bag.write(tmp_path / 'bag', Synthetic(200).messages()))
    names = ('mass 1', 'mass 2', *run.monitor.names[2:])
    metrics = measure(replace(run, monitor=replace(run.monitor, names=names)))
    assert np.isnan(metrics.final_parameter_error)
    assert metrics.true is None
    assert list(metrics.estimate) == ['mass 1', 'mass 2', 'm2*l1*l2']
    assert 'parameters' not in format_table(metrics)
