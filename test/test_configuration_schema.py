# SPDX-License-Identifier: Apache-2.0
"""Configurations of the nodes: which values are accepted, and how others are rejected."""

from __future__ import annotations

import array
from contextlib import suppress

import numpy as np
import pytest

from blf_dsc_controller import (
    ConfigurationError,
    ControllerConfig,
    PlantConfig,
    change,
    load_loop,
)
from blf_dsc_controller.configuration.schema import build, flatten
from blf_dsc_controller.configuration.side_nodes import RecorderConfig


def test_values_are_kept_and_flattened_and_a_change_keeps_the_others():
    given = {
        'duration': 2.5,
        'disturbance.viscous': (3.0, 0.0),
        'mode': 'lockstep',
        'seed': 5,
    }
    built = build(PlantConfig, given)
    assert built.disturbance.viscous == (3.0, 0.0)
    assert dict(flatten(PlantConfig()), **given) == flatten(built)
    assert build(PlantConfig, flatten(built)) == built
    entries = array.array('d', [3.0, 4.0])  # as ROS gives them
    changed = change(built, {'disturbance.viscous': entries})
    assert flatten(changed) == {**flatten(built), 'disturbance.viscous': (3.0, 4.0)}
    computed = {'seed': np.int64(6), 'disturbance.viscous': 2.0 * np.array([3.0, 4.0])}
    of_script = change(built, computed)
    assert of_script.seed == 6
    assert of_script.disturbance.viscous == (6.0, 8.0)
    assert type(of_script.disturbance.viscous[0]) is float
    with pytest.raises(ConfigurationError, match='shorter than one sample'):
        change(changed, {'sample_time': 1.0, 'duration': 0.5})


def test_recommended_preset_equals_the_defaults():
    defaults = (
        build(cls, {}) for cls in (PlantConfig, ControllerConfig, RecorderConfig)
    )
    assert load_loop('recommended') == tuple(defaults)


@pytest.mark.parametrize(('given', 'kept'), [(True, 'on'), (False, 'off')])
def test_on_and_off_may_be_written_without_quotes(given, kept):
    """YAML reads them as true and false."""
    config = build(ControllerConfig, {'safety.watchdog': given})
    assert config.safety.watchdog == kept
    with pytest.raises(ConfigurationError, match='got true, but a string is expected'):
        build(ControllerConfig, {'safety.torque': True})


ODD = [
    '',
    'x',
    0,
    -1,
    1e308,
    2**62,
    True,
    [],
    ['x'],
    [1e308] * 2,
    [1.0] * 4,
    [[]],
    None,
]


def test_any_value_of_a_parameter_is_accepted_or_refused():
    """Values of a stranger's journal too: no other error ends the nodes that read it."""
    given = flatten(load_loop('fr3').controller)
    for name in given:
        for odd in ODD:
            with suppress(ConfigurationError), np.errstate(all='ignore'):
                build(ControllerConfig, {**given, name: odd})
