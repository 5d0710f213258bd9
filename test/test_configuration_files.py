# SPDX-License-Identifier: Apache-2.0
"""Files of parameters: as ROS reads them, written back, and the page that documents them."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.files import parse, parse_scalar
from blf_dsc_controller.configuration.nodes import (
    LoopConfig,
    RecorderConfig,
    dump,
    format_value,
    known_names,
    load,
    load_loop,
    parameter_page,
)
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.errors import ConfigurationError
from blf_dsc_controller.messages import topics


def test_scalar_has_the_value_ros_gives_it():
    """test_configuration_against_ros.py compares many more with ROS itself."""
    words = {'1e-5': 1e-5, '017': 15, '08': 8.0, '0x1p3': 8.0, '1e400': '1e400', 'yes': True}
    words |= {'tRue': 'tRue', '1_000': '1_000', '.inf': math.inf, '9223372036854775808': 2.0**63}
    for word, value in words.items():
        assert parse_scalar(word) == value
        assert type(parse_scalar(word)) is type(value)


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


COMMITTED = Path(__file__).parents[1] / 'doc' / 'parameters.md'


def test_parameter_page_is_what_its_command_writes(tmp_path):
    page, module = tmp_path / 'parameters.md', 'blf_dsc_controller.configuration.nodes'
    subprocess.run([sys.executable, '-m', module, str(page)], check=True, cwd=COMMITTED.parents[1])
    assert COMMITTED.read_text(encoding='utf-8') == page.read_text(encoding='utf-8'), (
        'run: python -m blf_dsc_controller.configuration.nodes doc/parameters.md'
    )


def test_every_parameter_has_a_row_of_eight_cells():
    rows = [row for row in parameter_page().splitlines() if row.startswith('| `')]
    assert {row.split('`')[1] for row in rows} == known_names()
    assert {row.replace('\\|', '').count('|') for row in rows} == {9}


def test_topic_page_lists_every_topic_with_its_type():
    page = (COMMITTED.parent / 'topics.md').read_text(encoding='utf-8')
    for topic in vars(topics).values():
        if isinstance(topic, topics.Topic):
            name = topic.resolved if topic.name.startswith('/') else topic.relative
            assert f'| `{name}` | {topic.type.replace("/msg/", "/")} |' in page
