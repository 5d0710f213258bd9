# SPDX-License-Identifier: Apache-2.0
"""Metrics measured without recording a run match those of its full record."""

from __future__ import annotations

import numpy as np
import pytest
from monte_carlo_case import LOOP, STUDY, study, whole

from blf_dsc_controller.law.state import sample_of
from blf_dsc_controller.simulation.loop import simulate
from blf_dsc_controller.simulation.metrics import another_motion, torque_rows
from blf_dsc_controller.studies.report import plant_of_run
from blf_dsc_controller.studies.runs import run_chunk

LIMITS = 'blf_dsc_controller:\n  ros__parameters:\n'
WEAK = LOOP.replace(LIMITS, LIMITS + '    torque: {limit: [8.0, 20.0]}\n')
# Motors that are weaker than the law assumes.
MOTORS = LOOP.replace(
    '    duration: 0.3\n', '    duration: 0.3\n    actuator: {torque_limit: [9.0, 0.0]}\n'
)
# A gain far above what a 1 kHz loop can take, and no effective torque limit.
UNSTABLE = LOOP.replace(
    LIMITS,
    LIMITS + '    torque: {limit: [1.0e+308, 1.0e+308]}\n    feedback: {gain: [1.0e+9, 1.0e+9]}\n',
)


def metrics_of_record(a_study, run):
    """Metrics of a run from its full record, straight from their definitions."""
    plant = plant_of_run(a_study, run)
    record = simulate(a_study.controller, plant, supervised=False)
    names = sample_of(np.arange(record.samples.shape[1]), record.controller.settings)
    t = record.stamps * 1e-9
    error = np.abs(record.samples[:, names.xi1])
    torque = np.abs(record.samples[:, names.torque])
    estimate = record.samples[:, names.estimate][:, :3]
    P = record.truths[:, :3]
    outside = np.flatnonzero((error >= 0.002).any(axis=1))
    latched = np.flatnonzero(record.samples[:, names.latched[0]])
    limit = np.array(a_study.controller.torque.limit)
    motors = np.array(a_study.plant.actuator.torque_limit)
    limit[motors > 0.0] = np.minimum(limit, motors)[motors > 0.0]
    distance = np.linalg.norm(estimate - P, axis=1) / np.linalg.norm(P, axis=1)
    metrics = {
        'first_violation_s': t[outside[0]] if outside.size else np.nan,
        'latch_time_s': t[latched[0]] if latched.size else np.nan,
        'saturated_fraction': (torque >= limit).any(axis=1).mean(),
        'parameter_error.0.1_s': distance[100],
        'parameter_error.0.25_s': distance[250],
        'parameter_error.end': distance[300],
    }
    rows = torque_rows(another_motion(a_study.controller, 1000))
    wrong = np.linalg.norm(rows @ (estimate[300] - P[300]))
    metrics['torque_error.end'] = wrong / np.linalg.norm(rows @ P[300])
    for i, joint in enumerate(('joint1', 'joint2')):
        metrics[f'max_error_ratio.{joint}'] = error[:, i].max() / 0.002
        metrics[f'settled_error_ratio.{joint}'] = error[200:, i].max() / 0.002
        metrics[f'rms_error_rad.{joint}'] = np.sqrt(np.mean(error[200:, i] ** 2))
        metrics[f'peak_torque_nm.{joint}'] = np.abs(record.measurements[:, 4 + i]).max()
    return metrics


@pytest.mark.parametrize('loop', [LOOP, WEAK, MOTORS], ids=['strong', 'weak', 'motors'])
def test_metrics_match_the_full_record(tmp_path, loop):
    a_study = study(tmp_path, loop + STUDY, runs=6)
    results = whole(a_study)
    for run in range(6):
        for name, value in metrics_of_record(a_study, run).items():
            # Sums are taken in another order.
            assert results[name][run] == pytest.approx(value, rel=1e-12, nan_ok=True), name


def test_pairs_run_the_same_plant_with_and_without_learning(tmp_path):
    """Until learning begins both are the same, bit for bit; each is a run of an unpaired study."""
    pairs = STUDY.replace('seed: 7', 'seed: 7\n    pairs: true')
    found = whole(study(tmp_path, LOOP + pairs, runs=6))
    alone = whole(study(tmp_path, LOOP + STUDY, runs=6))
    never = LOOP.replace('learning: {', 'learning: {weight: 0.0, ')
    without = whole(study(tmp_path, never + STUDY, runs=6))
    figures = [name for name in alone if not name.startswith('plant.')][2:]
    for name in figures:
        np.testing.assert_array_equal(found[name], alone[name], err_msg=name)
        np.testing.assert_array_equal(found[f'without.{name}'], without[name], err_msg=name)
    assert (found['parameter_error.0.1_s'] == found['without.parameter_error.0.1_s']).all()
    assert (found['parameter_error.end'] != found['without.parameter_error.end']).any()


def test_studies_used_here_cover_all_kinds_of_metrics(tmp_path):
    strong = whole(study(tmp_path, LOOP + STUDY))
    weak = whole(study(tmp_path, WEAK + STUDY))
    assert (strong['outcome'] == 'kept').sum() > 12
    assert (weak['outcome'] == 'violated').sum() > 12
    # Windows of 0.1 s tell little: with change detection some solutions are physically impossible.
    any_arm = LOOP.replace('learning: {', 'learning: {change_detection: false, ')
    assert np.isfinite(whole(study(tmp_path, any_arm + STUDY))['latch_time_s']).all()
    assert (weak['saturated_fraction'] > 0.1).any()
    assert (strong['first_violation_s'] >= 0).sum() == (strong['outcome'] != 'kept').sum()


def test_divergence_is_detected_and_ends_the_run(tmp_path):
    results = whole(study(tmp_path, UNSTABLE + STUDY, runs=3))
    assert results['outcome'].tolist() == ['diverged'] * 3
    assert (results['first_violation_s'] < 0.3).all()
    assert np.isnan(results['parameter_error.end']).all()


def test_start_rejected_by_the_controller_has_its_own_outcome(tmp_path):
    """With noise of ten times the bound nearly every start is measured outside it."""
    text = STUDY.replace('loguniform(1.0e-6, 2.0e-5)', 'choice(0.02)')
    results = whole(study(tmp_path, LOOP + text))
    rejected = results['outcome'] == 'rejected'
    assert rejected.sum() > 12
    assert (results['first_violation_s'][rejected] == 0.0).all()
    worst = np.maximum(results['max_error_ratio.joint1'], results['max_error_ratio.joint2'])
    assert (worst[rejected] >= 1.0).all()
    assert np.isnan(results['latch_time_s'][rejected]).all()


def test_state_of_one_run_does_not_leak_into_the_next(tmp_path):
    a_study = study(tmp_path, runs=4)
    alone = run_chunk(a_study, 3, 1)
    for name, values in whole(a_study).items():
        np.testing.assert_array_equal(values[3:], alone[name], err_msg=name)
