# SPDX-License-Identifier: Apache-2.0
"""Parameter files as the record of a run: a dumped configuration loads back equal."""

from __future__ import annotations

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.files import parse
from blf_dsc_controller.configuration.nodes import (
    LoopConfig,
    RecorderConfig,
    dump,
    format_value,
    load,
    load_loop,
)
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.errors import ConfigurationError

CHANGED = LoopConfig(
    build(
        PlantConfig,
        {'sensor.position_noise': 1e-5, 'arm.l1': 1 / 3, 'seed': 2**62, 'mode': 'lockstep'},
    ),
    build(
        ControllerConfig,
        {
            'barrier.slope_limit': [1e300, 12345.678901234567],
            'learning.regularization': 5e-324,
            'learning.bias': False,
        },
    ),
    build(RecorderConfig, {'output': "it's a 'bag': #1", 'topics': ['/clock', '~/größe']}),
)


def test_configuration_of_a_run_round_trips(tmp_path):
    path = tmp_path / 'run.yaml'
    loop = CHANGED._replace(controller=build(ControllerConfig, {'learning.regularization': 3e-300}))
    dump(path, loop.by_node)
    assert load_loop(path) == loop


def test_node_in_a_namespace_is_written_under_its_full_name(tmp_path):
    path = tmp_path / 'run.yaml'
    dump(path, {'/left/sim_plant': CHANGED.plant})
    assert load(path, '/left/sim_plant', PlantConfig) == CHANGED.plant
    with pytest.raises(ConfigurationError, match='/left/sim_plant does not match /right/sim'):
        load(path, '/right/sim_plant', PlantConfig)


@settings(max_examples=200)
@given(
    st.one_of(
        # ROS reads subnormal numbers as strings, and no parameter needs them.
        st.floats(allow_nan=False, allow_infinity=False, allow_subnormal=False),
        st.integers(-(2**63), 2**63 - 1),
        st.booleans(),
        st.text(st.characters(exclude_categories=['Cs', 'Cc'])),
        st.lists(st.floats(0.001, 1e9), min_size=1).map(tuple),
    )
)
def test_formatted_values_round_trip_here_and_through_pyyaml(value):
    text = f'n:\n  ros__parameters:\n    a: {format_value(value)}\n'
    ours = parse(text)[0].entries['a'].value
    theirs = yaml.safe_load(text)['n']['ros__parameters']['a']
    for found in (ours, theirs):
        restored = tuple(found) if isinstance(value, tuple) else found
        assert restored == value
        assert type(restored) is type(value)
