# SPDX-License-Identifier: Apache-2.0
"""Joints that shake by friction: which errors are limit cycles, and that the proof tells them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from blf_dsc_controller import load_loop
from blf_dsc_controller.cli import commission
from blf_dsc_controller.commissioning import simulated
from blf_dsc_controller.commissioning.limit_cycle import (
    IN_MOTION,
    STILL,
    limit_cycles,
)
from blf_dsc_controller.run import TURNING

T = np.arange(0.0, 15.0, 1e-3)  # s


def wave(amplitude, frequency):
    return amplitude * np.sin(2.0 * np.pi * frequency * T + 0.3)


def found(error, when=STILL):
    """Return the limit cycles of a run of two joints, of which the second has an error (N,)."""
    run = SimpleNamespace(
        joints=('elbow', 'wrist'),
        time=T,
        error=np.column_stack((0.0 * T, error)),
        units=lambda _: TURNING,
    )
    return limit_cycles(run, when)


@pytest.mark.parametrize('when', [STILL, IN_MOTION])
@pytest.mark.parametrize('frequency', [3.7, 6.15, 12.0])
def test_wave_that_lasts_is_found_with_its_amplitude_and_frequency(frequency, when):
    noise = np.random.default_rng(0).normal(0.0, 1e-4, T.size)
    (cycle,) = found(wave(2.6e-3, frequency) + 1e-3 * T + noise, when)
    assert cycle.joint == 'wrist'
    assert cycle.when == when
    assert cycle.amplitude == pytest.approx(2.6e-3, rel=0.05)
    assert cycle.frequency == pytest.approx(frequency, abs=0.2)  # a line of 5 s


def sticking(amplitude):
    """Return the error of a joint that sticks and slips while it moves: 3.8 to 4.4 Hz."""
    phase = 2.0 * np.pi * 4.1 * T + 0.3 / 0.2 * np.sin(2.0 * np.pi * 0.2 * T)
    return amplitude * np.sin(phase)


def test_stick_and_slip_is_found_beside_slower_errors_of_the_motion():
    """As of a seven-joint arm: no line of its peak is as high as the slower one."""
    (cycle,) = found(sticking(1.5e-3) + wave(1.1e-3, 1.2), IN_MOTION)
    assert cycle.amplitude == pytest.approx(1.5e-3, rel=0.2)
    assert cycle.frequency == pytest.approx(4.1, abs=0.7)


def test_what_is_smaller_than_slower_errors_or_rings_after_each_reversal_is_none():
    assert found(sticking(0.8e-3) + wave(1.5e-3, 1.2), IN_MOTION) == []
    since = np.mod(T, 2.5)  # s, since the joint reversed
    rings = 5.3e-3 * np.exp(-since / 0.3) * np.sin(2.0 * np.pi * 4.0 * since)
    assert found(rings + wave(0.85e-3, 1.2), IN_MOTION) == []


def test_joint_at_rest_may_shake_more_slowly():
    assert found(wave(2e-3, 2.0), IN_MOTION) == []
    (cycle,) = found(wave(2e-3, 2.0), STILL)
    assert cycle.frequency == pytest.approx(2.0, abs=0.2)


def test_simulated_arm_tells_its_limit_cycle_after_its_errors(capsys, monkeypatch):
    """The run is that of the arm; a cycle of one joint is put on it."""
    run = simulated.proof
    cycles = found(wave(2.9e-3, 6.3), IN_MOTION)
    monkeypatch.setattr(
        simulated, 'proof', lambda loop: run(loop)._replace(cycles=cycles)
    )
    short = load_loop('recommended', {'sim_plant': {'duration': 4.0}})
    monkeypatch.setattr(commission, 'load_loop', lambda _: short)
    commission._prove(None)
    first, second = capsys.readouterr().out.splitlines()
    assert 'follows its own motion for 4 s' in first
    assert second.startswith(
        'wrist oscillates by 2.9 mrad at 6.3 Hz in motion: friction'
    )
