# SPDX-License-Identifier: Apache-2.0
"""Torque ripple that `identify` finds, and that which is not there."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from nights import at_night
from random_arm import measured, recording_of, reference_of, shake, truth_of

from blf_dsc_controller import load_loop
from blf_dsc_controller.identification.identify import identify_arm

SECONDS = 20.0
EVERY = 4  # samples of 1 ms
SHARE = 0.008  # of the rated torque


@cache
def moved(preset):
    """Return configuration and states (k, 3, n) of an arm without ripple."""
    config = load_loop(preset).controller
    chain = config.robot.chain(config.joints)
    reference = reference_of(chain, 0)
    return config, shake(chain, truth_of(chain, 1), reference, SECONDS)


def found_in(preset, cycles):
    """Return what is found with ripples of N `cycles` in every joint, and their amplitudes."""
    config, states = moved(preset)
    amplitudes = SHARE * np.array(config.torque.limit)
    states = states.copy()
    for N in cycles:
        states[:, 2] += amplitudes * np.sin(N * states[:, 0] + 0.3)
    seen = measured(states, 3)[::EVERY]
    recording = recording_of(seen, config.joints, EVERY * config.sample_time)
    return identify_arm(recording, config.robot).ripples, amplitudes


@pytest.mark.parametrize(
    ('preset', 'cycles'),
    [('ur5e', [20.0, 50.0]), ('panda', [30.0]), *at_night(('ur5e', [12.5]))],
)
def test_ripples_are_found(preset, cycles):
    found, amplitudes = found_in(preset, cycles)
    for own, amplitude in zip(found, amplitudes, strict=True):
        assert sorted(each.cycles for each in own.found) == pytest.approx(
            cycles, rel=0.02
        )
        for each in own.found:
            assert each.amplitude == pytest.approx(amplitude, rel=0.4)


@pytest.mark.parametrize('preset', ['ur5e', 'panda'])
def test_no_ripple_is_claimed_where_there_is_none(preset):
    found, amplitudes = found_in(preset, [])
    assert not any(own.found for own in found)
    assert all(own.is_known for own in found)
    assert (np.array([own.least for own in found]) < 2.0 * amplitudes).all()
