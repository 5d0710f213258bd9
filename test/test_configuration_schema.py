# SPDX-License-Identifier: Apache-2.0
"""Configurations of the nodes: which values are accepted, and how others are rejected."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import pytest

from blf_dsc_controller import (
    ConfigurationError,
    ControllerConfig,
    load_loop,
)
from blf_dsc_controller.configuration.schema import build, flatten


def test_recommended_preset_equals_the_defaults(tmp_path):
    nothing = tmp_path / 'nothing.yaml'
    nothing.write_text('sim_plant:\n  ros__parameters: {seed: 0}\n', encoding='utf-8')
    assert load_loop('recommended') == load_loop(nothing)


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
