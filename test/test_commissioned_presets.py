# SPDX-License-Identifier: Apache-2.0
"""Presets that `blf_dsc commission` wrote: they are what they were, with gains that hold."""

from __future__ import annotations

import numpy as np
import pytest

import blf_dsc_controller as blf
from blf_dsc_controller import load_loop, share_folder
from blf_dsc_controller.commissioning import files
from blf_dsc_controller.configuration.nodes import PLANT, read

PRESETS = {'fr3_direct': '', 'panda': '', 'ur5e': ' --ripple'}
"""The option with which the file of a preset was written."""
FOLDER = share_folder() / 'config'


def path_of(preset):
    return FOLDER / f'{preset}_commissioned.yaml'


class Chosen:
    """The parameters that a commissioned file has and its preset has otherwise."""

    def __init__(self, preset):
        config = load_loop(path_of(preset)).controller
        feedback, commissioning = config.feedback, config.commissioning
        self.values = {
            'robot.lag': config.robot.lag,
            'feedback.inertia': 'none',
            'feedback.joint_stiffness': feedback.joint_stiffness,
            'feedback.joint_damping': feedback.joint_damping,
            'feedback.stiffness': 1.0,
            'commissioning.friction': commissioning.friction,
            'commissioning.unseen_inertia': commissioning.unseen_inertia,
            'barrier.bound': config.barrier.bound,
        }
        if feedback.joint_damping_lag:  # where it pays
            self.values['feedback.joint_damping_lag'] = feedback.joint_damping_lag
        if config.disturbance.observer_bandwidth:  # joint torque sensors are used
            bandwidth = config.disturbance.observer_bandwidth
            self.values['disturbance.observer_bandwidth'] = bandwidth
        if config.learning.ripple_cycles:  # a slow motion shows torque ripple
            self.values['learning.ripple_cycles'] = config.learning.ripple_cycles
        if config.robot.rotor_inertia:  # no drive hides the motors
            self.values['robot.rotor_inertia'] = config.robot.rotor_inertia
            self.values['safety.damping'] = config.safety.damping

    def parameters(self):
        return self.values


@pytest.mark.parametrize('preset', PRESETS)
def test_it_is_its_preset_with_what_was_chosen(preset):
    """If it fails, the preset has changed: run the command in the first line of the file again."""
    path = path_of(preset)
    (command, *_) = path.read_text(encoding='utf-8').splitlines()
    assert command == (
        f'# blf_dsc commission --config {preset}{PRESETS[preset]} '
        f'--out config/{path.name}'
    )
    written = files.of_commissioned(read(FOLDER / f'{preset}.yaml'), Chosen(preset))
    sections = {each.pattern: each.entries for each in read(path)}
    for pattern, values in written.items():
        entries = sections[pattern]
        assert {name: entry.value for name, entry in entries.items()} == {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in values.items()
        }
    assert load_loop(path).controller.commissioning.friction


@pytest.mark.parametrize('preset', PRESETS)
def test_simulated_arm_keeps_its_bound_when_it_picks_up_its_payload(preset):
    """At 3 s in motion, where 30 s of the command have it at 20 s."""
    early = {'duration': 6.0, 'events.begin': [3.0], 'events.duration': [0.0]}
    loop = load_loop(path_of(preset), {PLANT: early})
    run = blf.simulate(loop.controller, loop.plant).run()
    assert run.stops == ()
    assert run.oscillations == ()
    ratio = (np.abs(run.error) / loop.controller.barrier.bound).max(axis=1)
    before = ratio[(run.time > 2.0) & (run.time < 3.0)].max()
    assert 1.5 * before < ratio[run.time >= 3.0].max()  # it was picked up
    assert ratio.max() < 1.0
