# SPDX-License-Identifier: Apache-2.0
"""Encoders: noise, resolution and the two kinds of velocity, all repeatable."""

import numpy as np
import pytest
from plants import PERIOD, commands, plant, run

from sim_plant.sensors import DIFFERENCED, MEASURED, draw, generator


def true_states(samples, **changes):
    """Noise-free states (samples, 4) under the usual torques."""
    arm = plant(**changes)
    rows = np.empty((samples, 4))
    for row, torque in zip(rows, commands(samples), strict=True):
        row[:] = arm.truth()[5:]
        arm.step(torque)
    return rows


def test_ideal_sensor_measures_the_true_state_without_random_numbers():
    arm = plant()
    before = arm.rng.bit_generator.state
    assert (run(arm, commands(50))[:, :4] == true_states(50)).all()
    assert arm.rng.bit_generator.state == before


def test_noise_has_the_configured_standard_deviation():
    samples = 2000
    read = run(plant(position_noise=1e-5, velocity_noise=1e-3), commands(samples))
    noise = read[:, :4] - true_states(samples)
    error = 1 / np.sqrt(2 * samples)  # standard error of a sample deviation, relative
    assert noise.std(axis=0) == pytest.approx([1e-5, 1e-5, 1e-3, 1e-3], rel=4 * error)
    assert np.abs(noise.mean(axis=0) / noise.std(axis=0)).max() < 4 / np.sqrt(samples)
    off_diagonal = np.corrcoef(noise.T) - np.eye(4)
    assert np.abs(off_diagonal).max() < 4 / np.sqrt(samples)


def test_noise_does_not_move_the_arm():
    noisy, ideal = plant(position_noise=1e-3), plant()
    run(noisy, commands(50))
    run(ideal, commands(50))
    assert (noisy.truth() == ideal.truth()).all()


def test_seed_determines_the_noise():
    def read(seed):
        return run(plant(seed=seed, position_noise=1e-5), commands(50))

    assert (read(3) == read(3)).all()
    assert (read(3) != read(4))[:, :2].all()


def test_compiled_draws_match_numpy():
    numbers = np.empty(1000)
    draw(generator(8), numbers)
    assert (numbers == generator(8).standard_normal(1000)).all()


def test_quantised_position_is_the_nearest_multiple_of_the_resolution():
    resolution = 2 * np.pi / 2**14
    read = run(plant(resolution=resolution), commands(200))[:, :2]
    counts = read / resolution
    assert counts == pytest.approx(np.rint(counts), abs=1e-9)
    # half a count, and the rounding of the division
    error = np.abs(read - true_states(200)[:, :2])
    assert error.max() <= resolution / 2 * (1 + 1e-9)
    assert error.max() > resolution / 4


def test_differenced_velocity_is_that_of_the_measured_positions():
    arm = plant(
        position_noise=1e-5, resolution=1e-5, velocity_source=DIFFERENCED, velocity=(0.4, -0.3)
    )
    read = run(arm, commands(50))
    assert read[0, 2:4].tolist() == [0.4, -0.3]
    assert read[1:, 2:4] == pytest.approx(np.diff(read[:, :2], axis=0) / PERIOD, rel=1e-13)


@pytest.mark.parametrize('source', [MEASURED, DIFFERENCED])
def test_velocity_is_low_pass_filtered_with_its_pole(source):
    options = {'velocity_source': source, 'position_noise': 1e-5, 'velocity_noise': 1e-3}
    raw = run(plant(**options), commands(30))[:, 2:4]
    read = run(plant(velocity_pole=400.0, **options), commands(30))[:, 2:4]
    expected = raw.copy()
    for k in range(1, 30):
        expected[k] = raw[k] + np.exp(-0.4) * (expected[k - 1] - raw[k])
    np.testing.assert_allclose(read, expected, rtol=1e-13)


def test_differenced_velocity_spans_skipped_samples():
    arm = plant(velocity_source=DIFFERENCED)
    first = arm.measure().copy()
    for torque in commands(7):
        arm.step(torque)
    second = arm.measure()
    assert second[2:4] == pytest.approx((second[:2] - first[:2]) / (7 * PERIOD), rel=1e-13)


@pytest.mark.parametrize('source', [0, DIFFERENCED])
def test_reading_a_sample_twice_gives_the_same_values(source):
    once = plant(position_noise=1e-5, velocity_source=source)
    twice = plant(position_noise=1e-5, velocity_source=source)
    for torque in commands(20):
        twice.measure()
        assert (once.measure() == twice.measure()).all()
        once.step(torque)
        twice.step(torque)
