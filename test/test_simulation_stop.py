# SPDX-License-Identifier: Apache-2.0
"""An offline run stops like the node, and replays with its stop."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
import recorded_run
from paper_case import configured, several

from blf_dsc_controller import (
    ControllerConfig,
    PlantConfig,
    StartError,
    measure,
    read_run,
    simulate,
    verify,
)
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.messages.journal import decode_change
from blf_dsc_controller.messages.topics import CHANGES
from blf_dsc_controller.simulation.loop import simulate_into_bag, write_bag

HELD = {'safety.torque': 'hold_gravity'}
NOISY = {'sensor.position_noise': 1e-6, 'sensor.velocity': 'differenced', 'seed': 3}
WEAK = {'torque.limit': [9.0, 3.2]}  # gravity alone takes 9.7 N m
CASES = {
    'error past the bound': WEAK | HELD,
    'velocity not plausible': {'safety.velocity_limit': [0.25, 0.25]},
}
SATURATED = {'torque.limit': [10.5, 20.0]}  # for some samples, but tracking continues


def run(given, *, supervised=True):
    plant = build(PlantConfig, {'duration': 2.5} | NOISY)
    return simulate(build(ControllerConfig, given), plant, supervised=supervised)


@pytest.mark.parametrize('reason', CASES)
def test_bag_of_a_stopped_run_replays_with_its_stop(tmp_path, reason):
    given = CASES[reason]
    record = run(given)
    write_bag(tmp_path / 'bag', record)
    result = verify(tmp_path / 'bag')
    assert (result.difference, result.remarks) == (None, ())
    assert result.transitions == ['activate', f'safe stop ({reason})']
    recorded = read_run(tmp_path / 'bag')
    (stop,) = recorded.stops
    assert stop.reason == reason
    simulated = record.run()
    assert simulated.timed_stops[0][0] == recorded.timed_stops[0][0]
    for field in ('position', 'torque', 'reference', 'error', 'bound'):
        np.testing.assert_array_equal(
            getattr(simulated, field), getattr(recorded, field)
        )
    for field in ('max_error', 'rms_error', 'bound', 'peak_torque', 'held', 'stops'):
        assert getattr(measure(simulated), field) == getattr(measure(recorded), field)


@pytest.mark.parametrize('given', [{}, *CASES.values()], ids=['no stop', *CASES])
def test_bag_written_while_simulating_has_the_same_messages(tmp_path, given):
    config = build(ControllerConfig, given)
    plant = build(PlantConfig, {'duration': 2.5} | NOISY)
    write_bag(tmp_path / 'after', simulate(config, plant), plant)
    simulate_into_bag(tmp_path / 'while', config, plant)
    assert recorded_run.read(tmp_path / 'while') == recorded_run.read(
        tmp_path / 'after'
    )


def test_run_that_ends_in_command_leaves_a_torque_behind_as_its_replay_does(tmp_path):
    """As a node does for a drive that holds the last torque."""
    config = build(ControllerConfig, {})
    record = simulate(config, build(PlantConfig, {'duration': 0.05}))
    assert np.isfinite(record.left).all()
    write_bag(tmp_path / 'bag', record)
    result = verify(tmp_path / 'bag')
    assert (result.difference, result.incomplete) == (None, ())


def test_bag_of_a_run_begins_with_the_configuration_of_its_plant(tmp_path):
    """As that of a node, by which reports and the view know the true arm."""
    plant = build(PlantConfig, {'duration': 0.01, 'seed': 3})
    record = simulate(build(ControllerConfig, {}), plant)
    write_bag(tmp_path / 'bag', record, plant)
    topic, _, _, raw = recorded_run.messages(tmp_path / 'bag')[0]
    found = decode_change(raw)
    assert (topic, found.configured) == (CHANGES.resolved, True)
    assert build(PlantConfig, dict(found.parameters)) == plant


def test_memory_of_a_run_into_a_bag_does_not_grow_with_its_length(tmp_path):
    """All samples of the longer run would be 4 MB."""
    config = build(ControllerConfig, {})
    peaks = []
    for duration in (2.0, 2.0, 5.0):  # the first imports
        plant = build(PlantConfig, {'duration': duration} | NOISY)
        tracemalloc.start()
        simulate_into_bag(tmp_path / f'{len(peaks)}', config, plant)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[2] < peaks[1] + 1_000_000


def test_run_that_cannot_start_leaves_no_bag(tmp_path):
    config = build(ControllerConfig, {'reference.type': 'hold'})
    plant = build(PlantConfig, {'duration': 1.0, 'initial.position': [9.0, 0.3]})
    with pytest.raises(StartError):
        simulate_into_bag(tmp_path / 'bag', config, plant)
    assert not (tmp_path / 'bag').exists()


def test_unguarded_law_continues_past_every_limit():
    stopped = run(CASES['error past the bound'])
    alone = run(WEAK, supervised=False)
    (row,) = np.flatnonzero(stopped.stamps == stopped.run().stops[0].stamp)
    assert 0 < row < 100
    np.testing.assert_array_equal(stopped.samples[:row], alone.samples[:row])
    assert np.isfinite(alone.samples[row:, :10]).all()
    assert np.isnan(stopped.samples[row:, :6]).all()


def test_panda_rests_with_a_load_that_it_was_stopped_by():
    """The model lacks 3 kg: held by it alone, the arm sinks by 0.70 rad in 1 s, 1.88 in 4 s."""
    law = {'reference.type': 'hold', 'safety.error_ratio': 0.5}
    pick_up = several({'begin': 0.5, 'duration': 0.0, 'payload': 3.0})
    config = configured('panda_rigid', 4.5, law, pick_up)
    assert config.controller.safety.torque == 'hold_gravity'
    record = simulate(config.controller, config.plant)
    (stop,) = record.run().stops
    assert stop.reason == 'error past the bound'
    row = int(np.flatnonzero(np.isnan(record.samples[:, 0]))[0])
    q, dq, _ = record.measurements[row:].reshape(-1, 3, 7).swapaxes(0, 1)
    assert np.abs(q - q[0]).max() < 0.15
    assert np.abs(dq[2000:]).max() < 0.02


def test_a_run_may_end_early_after_a_stop():
    """It ends with the chunk of 1000 samples in which 0.2 s have passed; its rows are the same."""
    given = CASES['error past the bound']
    whole = run(given)
    early = simulate(
        whole.config, build(PlantConfig, {'duration': 2.5} | NOISY), after_stop=0.2
    )
    assert (
        early.stopped
        == whole.stopped
        == pytest.approx(1e-9 * whole.run().stops[0].stamp)
    )
    size = early.stamps.size
    assert early.stopped + 0.2 <= 1e-9 * early.stamps[-1] < early.stopped + 1.3
    assert size < whole.stamps.size
    np.testing.assert_array_equal(early.truths, whole.truths[:size])
    assert run(SATURATED).stopped == np.inf
