# SPDX-License-Identifier: Apache-2.0
"""Studies: what is drawn, saved and measured, and pairs with and without learning."""

from __future__ import annotations

import os

import numpy as np
import pytest
from nights import at_night
from scipy import stats

from benchmark.studies import path_of
from blf_dsc_controller import ConfigurationError, load_study, run_chunk, simulate
from blf_dsc_controller.law.samples import sample_columns
from blf_dsc_controller.studies.monte_carlo import (
    another_motion,
    draw,
    plant_with,
    torque_rows,
)
from blf_dsc_controller.studies.summary import compare_pairs

RUNS = 24

# A window of 0.1 s is hardly excited, but it latches: learning within 0.3 s.
LOOP = """\
sim_plant:
  ros__parameters:
    duration: 0.75
    events: {begin: [0.0, 0.7], duration: [0.1, 0.0]}
blf_dsc_controller:
  ros__parameters:
    learning: {window: 0.1}
    two_link.excitation_threshold: 1.0e-12
"""

STUDY = """\
monte_carlo:
  ros__parameters:
    runs: 24
    seed: 7
    settled_after: 0.2
    vary:
      arm.m2: uniform(0.3, 0.7)
      disturbance.constant: uniform(-0.2, 0.2)
      sensor.position_noise: loguniform(1.0e-6, 2.0e-5)
      sensor.velocity: choice(measured, differenced)
      actuator.delay: integers(0, 3)
      initial.error: uniform(-0.9, 0.9)
      initial.velocity_error: uniform(-0.02, 0.02)
      events.begin: ["uniform(0.05, 0.1)", "choice(0.2)"]
      events.payload: uniform(0.0, 0.2)
      events.torque: ["uniform(-0.5, 0.5)", "choice(0.0)", "uniform(-0.5, 0.5)", "choice(0.0)"]
"""


def write(folder, text=LOOP + STUDY):
    """Write the file of a study and return its path."""
    path = folder / 'study.yaml'
    path.write_text(text)
    return path


def study(folder, text=LOOP + STUDY, **overrides):
    """Return the study of a file with this text."""
    return load_study(write(folder, text), overrides)


def whole(a_study):
    """Return the results of all runs, computed at once in this process."""
    return run_chunk(a_study, 0, a_study.settings.runs)


def test_values_are_as_frequent_as_stated(tmp_path):
    text = STUDY.replace('payload: uniform(0.0, 0.2)', 'payload: maybe(0.3, 0.1, 0.2)')
    a_study = study(tmp_path, LOOP + text)
    drawn = [draw(a_study, run) for run in range(1000)]
    mass, noise, delay, sensor, payload = (
        np.array([values[f'plant.{name}'] for values in drawn])
        for name in (
            'arm.m2',
            'sensor.position_noise',
            'actuator.delay',
            'sensor.velocity',
            'events.payload.1',
        )
    )
    assert stats.kstest(mass, stats.uniform(0.3, 0.4).cdf).pvalue > 0.01
    assert stats.kstest(noise, stats.loguniform(1e-6, 2e-5).cdf).pvalue > 0.01
    for values, choices in ((delay, range(4)), (sensor, ('measured', 'differenced'))):
        counts = [np.count_nonzero(values == each) for each in choices]
        assert stats.chisquare(counts).pvalue > 0.01
    loads = payload[payload > 0.0]
    assert loads.size == pytest.approx(300, abs=45)
    assert stats.kstest(loads, stats.uniform(0.1, 0.1).cdf).pvalue > 0.01


def test_all_problems_are_named_at_once(tmp_path):
    text = (LOOP + STUDY).replace('seed: 7', 'seed: -7').replace('arm.m2', 'arm.m3')
    with pytest.raises(ConfigurationError) as error:
        study(tmp_path, text.replace('window: 0.1', 'window: -0.1'))
    assert len(error.value.problems) == 3


def test_run_depends_on_seed_and_index_alone(tmp_path):
    drawn = draw(study(tmp_path), 5)
    assert drawn == draw(study(tmp_path, runs=100), 5)
    others = draw(study(tmp_path), 6), draw(study(tmp_path, seed=8), 5)
    for name in ('seed', 'plant.arm.m2'):
        assert len({drawn[name], *(other[name] for other in others)}) == 3
    # Nor does a draw depend on the other variations, or the number of events.
    more = STUDY.replace('arm.m2', 'arm.l2: uniform(0.5, 1.0)\n      arm.m2')
    after = draw(study(tmp_path, LOOP + more), 5)
    assert after.pop('plant.arm.l2') > 0.0
    assert drawn == after
    without = '\n'.join(
        line for line in (LOOP + STUDY).splitlines() if 'events' not in line
    )
    fewer = draw(study(tmp_path, without), 5)
    assert len(fewer) == 12
    assert fewer.items() <= drawn.items()


def test_drawn_values_are_used_in_the_plant_of_the_run(tmp_path):
    a_study = study(tmp_path)
    values = draw(a_study, 2)
    plant = plant_with(a_study, values)
    assert plant.seed == values['seed']
    assert (plant.arm.m1, plant.arm.m2) == (
        a_study.plant.arm.m1,
        values['plant.arm.m2'],
    )
    assert plant.disturbance.constant[1] == values['plant.disturbance.constant.joint2']
    assert plant.disturbance.constant[0] != plant.disturbance.constant[1]
    assert plant.actuator.delay == values['plant.actuator.delay']
    # The reference begins at offset + 0.3 cos 0, at rest; the bound is 2 mrad.
    fraction = np.array([values[f'plant.initial.error.joint{i}'] for i in (1, 2)])
    start = np.array([1.9935, 1.3961]) + 0.3 + 0.002 * fraction
    np.testing.assert_allclose(plant.initial.position, start, rtol=1e-12)
    velocity = [values[f'plant.initial.velocity_error.joint{i}'] for i in (1, 2)]
    np.testing.assert_allclose(plant.initial.velocity, velocity, atol=1e-15)
    events = plant.events  # drawn entry by entry
    assert events.begin == (values['plant.events.begin.1'], 0.2)
    assert events.duration == (0.1, 0.0)
    assert events.payload == (
        values['plant.events.payload.1'],
        values['plant.events.payload.2'],
    )
    assert events.torque[0] == values['plant.events.torque.1.joint1'] != 0.0
    assert (
        events.torque[2] == values['plant.events.torque.2.joint1'] != events.torque[0]
    )
    assert (events.torque[1], events.torque[3]) == (0.0, 0.0)


def test_study_may_be_based_on_a_preset(tmp_path):
    """Each file takes precedence over its base, value by value."""
    write(tmp_path)
    base = (tmp_path / 'study.yaml').rename(tmp_path / 'base.yaml')
    text = f'monte_carlo:\n  ros__parameters:\n    base: {base}\n    runs: 3\n    seed: 1\n'
    derived = study(tmp_path, text + '    vary: {arm.m2: "choice(0.5)"}\n')
    original = study(tmp_path)
    changed = {'runs': 3, 'seed': 1, 'vary.arm.m2': 'choice(0.5)'}
    assert derived.values()['monte_carlo'] == original.values()['monte_carlo'] | changed
    assert derived.plant == original.plant
    with pytest.raises(
        ConfigurationError, match=r'base: .*study.yaml. leads back to a file'
    ):
        study(tmp_path, text.replace(str(base), str(tmp_path / 'study.yaml')))
    with pytest.raises(ConfigurationError, match=r'leads back to a file'):
        study(tmp_path, text.replace(str(base), f'../{tmp_path.name}/study.yaml'))


PAIRS = 6 if os.environ.get('NIGHTLY') else 3
FIRST = {
    'monte_carlo_events': 16,
    'monte_carlo_panda': PAIRS,
    'monte_carlo_ur5e': PAIRS,
}


@pytest.mark.parametrize(
    'name',
    [
        'monte_carlo_panda',
        *at_night('monte_carlo_events', 'monte_carlo_ur5e'),
    ],
)
def test_learning_breaks_no_bound_that_is_kept_without_it(name):
    """Nor are errors larger than without learning; and the model is found."""
    study = load_study(path_of(name))
    found = compare_pairs(study, run_chunk(study, 0, FIRST[name]))
    assert found['kept']['without'] >= FIRST[name] // 3
    assert found['broken_only_with'] == []
    assert found['above'] == []
    torque = found['median']['torque_error.end']
    assert torque['with'] < torque['without']


LIMITS = 'blf_dsc_controller:\n  ros__parameters:\n'
WEAK = LOOP.replace(LIMITS, LIMITS + '    torque: {limit: [8.0, 20.0]}\n')
# Motors that are weaker than the law assumes.
MOTORS = LOOP.replace(
    '    duration: 0.75\n',
    '    duration: 0.75\n    actuator: {torque_limit: [9.0, 0.0]}\n',
)
# A gain far above what a 1 kHz loop can take, and no effective torque limit.
UNSTABLE = LOOP.replace(
    LIMITS,
    LIMITS + '    torque: {limit: [1.0e+308, 1.0e+308]}\n'
    '    two_link: {feedback_gain: [1.0e+9, 1.0e+9]}\n',
)


def metrics_of_record(a_study, run):
    """Metrics of a run from its full record, straight from their definitions."""
    plant = plant_with(a_study, draw(a_study, run))
    record = simulate(a_study.controller, plant, supervised=False)
    rows = sample_columns(record.samples, record.controller.settings)
    t = record.stamps * 1e-9
    error = np.abs(rows.xi1)
    estimate = rows.estimate[-1, :3]
    P = record.truths[-1, :3]
    outside = t[(error >= 0.002).any(axis=1)]
    latched = t[rows.latched[:, 0] > 0.0]
    motors = np.array(a_study.plant.actuator.torque_limit)
    limit = np.minimum(
        a_study.controller.torque.limit, np.where(motors > 0.0, motors, np.inf)
    )
    H = torque_rows(another_motion(a_study.controller, 1000))
    metrics = {
        'first_violation_s': outside[0] if outside.size else np.nan,
        'latch_time_s': latched[0] if latched.size else np.nan,
        'saturated_fraction': (np.abs(rows.torque) >= limit).any(axis=1).mean(),
        'parameter_error.end': np.linalg.norm(estimate - P) / np.linalg.norm(P),
        'torque_error.end': np.linalg.norm(H @ (estimate - P)) / np.linalg.norm(H @ P),
    }
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
            assert results[name][run] == pytest.approx(value, rel=1e-12, nan_ok=True), (
                name
            )
    is_kept = results['outcome'] == 'kept'
    np.testing.assert_array_equal(is_kept, np.isnan(results['first_violation_s']))
    assert is_kept.sum() > 3 or loop != LOOP


def test_pairs_run_the_same_plant_with_and_without_learning(tmp_path):
    """Each run with or without learning is that of an unpaired study, bit for bit.

    The third has the same arm and motion, and other noise.
    """
    pairs = STUDY.replace('seed: 7', 'seed: 7\n    pairs: true')
    found = whole(study(tmp_path, LOOP + pairs, runs=6))
    alone = whole(study(tmp_path, LOOP + STUDY, runs=6))
    never = LOOP.replace('learning: {', 'learning: {enabled: false, ')
    without = whole(study(tmp_path, never + STUDY, runs=6))
    figures = [name for name in alone if not name.startswith('plant.')][2:]
    for name in figures:
        np.testing.assert_array_equal(found[name], alone[name], err_msg=name)
        np.testing.assert_array_equal(
            found[f'without.{name}'], without[name], err_msg=name
        )
    assert (found['parameter_error.end'] != found['without.parameter_error.end']).any()
    for joint in ('joint1', 'joint2'):
        quiet, noisy = (
            found[f'{law}.max_error_ratio.{joint}'] for law in ('without', 'noise')
        )
        assert (noisy != quiet).all()
        np.testing.assert_allclose(noisy, quiet, rtol=0.3)


def test_divergence_is_detected_and_ends_the_run(tmp_path):
    results = whole(study(tmp_path, UNSTABLE + STUDY, runs=3))
    assert results['outcome'].tolist() == ['diverged'] * 3
    assert (results['first_violation_s'] < 0.3).all()
    assert np.isnan(results['parameter_error.end']).all()


def test_start_rejected_by_the_controller_has_its_own_outcome(tmp_path):
    """An arm that is too fast to be taken over."""
    text = STUDY.replace('uniform(-0.02, 0.02)', 'choice(40.0)')
    results = whole(study(tmp_path, LOOP + text))
    rejected = results['outcome'] == 'rejected'
    assert rejected.sum() > 12
    assert (results['first_violation_s'][rejected] == 0.0).all()
    for name in ('latch_time_s', 'max_error_ratio.joint1', 'rms_error_rad.joint2'):
        assert np.isnan(results[name][rejected]).all()


APPROACHING = {'loguniform(1.0e-6, 2.0e-5)': 'choice(0.002)'}


@pytest.mark.parametrize('changes', [{}, APPROACHING])
def test_state_of_one_run_does_not_leak_into_the_next(tmp_path, changes):
    """Nor its approach, from a start that noise moved outside the bound."""
    text = LOOP + STUDY
    for before, after in changes.items():
        text = text.replace(before, after)
    a_study = study(tmp_path, text, runs=8)
    whole_study = whole(a_study)
    for run in range(8):
        for name, values in run_chunk(a_study, run, 1).items():
            np.testing.assert_array_equal(
                values, whole_study[name][run : run + 1], err_msg=name
            )
