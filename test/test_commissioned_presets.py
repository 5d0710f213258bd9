# SPDX-License-Identifier: Apache-2.0
"""Presets that `blf_dsc commission` wrote: they are what they were, with gains that hold."""

from __future__ import annotations

import pytest
from scenario import Scenario

import blf_dsc_controller as blf
from blf_dsc_controller.configuration.schema import flatten

PRESETS = ('fr3_direct', 'panda', 'ur5e')
CHOSEN = ('feedback.', 'commissioning.', 'barrier.', 'surface.', 'disturbance.')
CHOSEN += ('robot.lag', 'robot.rotor_inertia', 'safety.damping')
CHOSEN += ('learning.initial_estimate', 'learning.adaptation_gain', 'learning.radius')
"""What a commissioning chooses, and gains and limits that follow from it."""


def path_of(preset):
    return blf.share_folder() / 'config' / f'{preset}_commissioned.yaml'


@pytest.mark.parametrize('preset', PRESETS)
def test_it_is_its_preset_with_what_was_chosen(preset):
    """If it fails, the preset has changed: run the command in the first line of the file again."""
    path = path_of(preset)
    (command, *_) = path.read_text(encoding='utf-8').splitlines()
    assert command == f'# blf_dsc commission --config {preset} --out config/{path.name}'
    before, after = (
        {**flatten(loop.plant), **flatten(loop.controller)}
        for loop in (blf.load_loop(preset), blf.load_loop(path))
    )
    changed = {name for name, value in after.items() if value != before[name]}
    assert {'feedback.joint_stiffness', 'barrier.bound'} <= changed
    assert [name for name in changed if not name.startswith(CHOSEN)] == []
    assert after['commissioning.friction']


@pytest.mark.parametrize('preset', PRESETS)
def test_simulated_arm_keeps_bound_and_observer_until_it_picks_up_its_payload(preset):
    """At 10 s in motion; noise of r was once taken for an oscillation at 8 s."""
    early = {'events.begin': [10.0], 'events.duration': [0.0]}
    arm = Scenario(path_of(preset), plant=early)
    before = arm.run(10.0).since(2000)
    after = arm.run(3.0)
    assert arm.is_running, arm.text
    found = {event.type for event in arm.events}
    assert not found & {'torque sensors', 'oscillation', 'stop'}
    assert 1.5 * before.ratio < after.ratio < 1.0  # it was picked up
