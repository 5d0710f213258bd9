# SPDX-License-Identifier: Apache-2.0
"""Parameter files: as ROS reads them, written back, documented; which section applies; mistakes."""

from __future__ import annotations

import math
import re
import subprocess
import sys
import sysconfig
from importlib.util import find_spec
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from blf_dsc_controller.configuration import files
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
    locate,
    parameter_page,
    read,
)
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.errors import BlfDscError, ConfigurationError
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


@pytest.fixture
def file(tmp_path):
    path = tmp_path / 'arm.yaml'

    def write(text):
        path.write_text(text, encoding='utf-8')
        return path

    return write


def section(pattern, content):
    return f'{pattern}:\n  ros__parameters: {{{content}}}\n'


def seed_of(path, node='sim_plant'):
    return load(path, node, PlantConfig).seed


def problems_of(path, node='sim_plant', cls=PlantConfig):
    with pytest.raises(ConfigurationError) as caught:
        load(path, node, cls)
    assert str(path) in str(caught.value)
    return caught.value.problems


def test_sections_match_as_in_ros(file):
    """test_configuration_against_ros.py compares more of them with ROS itself."""
    for pattern, node in (
        ('/sim_plant', 'sim_plant'),
        ('/**', '/left/sim_plant'),
        ('/**/sim_plant', '/lab/left/sim_plant'),
        ('left/sim_plant', '/left/sim_plant'),
    ):
        assert seed_of(file(section(pattern, 'seed: 7')), node) == 7
    nested = 'left:\n  sim_plant:\n    ros__parameters: {arm: {l1: 2.0}, arm.l2: 3.0}\n'
    arm = load(file(nested), '/left/sim_plant', PlantConfig).arm
    assert (arm.l1, arm.l2) == (2.0, 3.0)


@pytest.mark.parametrize(
    ('pattern', 'node'),
    [
        ('sim_plant', '/left/sim_plant'),
        ('/*', '/left/sim_plant'),
        ('/*/sim_plant', '/sim_plant'),
        ('/left/*', '/left/arm/sim_plant'),
        ('/left/**', '/right/sim_plant'),
        ('other', '/sim_plant'),
    ],
)
def test_section_that_does_not_match_is_ignored_or_rejected(file, pattern, node):
    path, own = file(section(pattern, 'seed: 7')), pattern.endswith('sim_plant')
    if own:  # meant for the node, but would silently be ignored
        remedy = f'does not match {node}: write /**/sim_plant for the node in any namespace'
        assert problems_of(path, node) == [f'line 2: /{pattern.removeprefix("/")} {remedy}']
        path = file(section(pattern, 'seed: 7') + section(f'{node}', 'duration: 2.0'))
    assert seed_of(path, node) == 0


def test_later_section_wins_regardless_of_specificity(file):
    wild, own = section('/**', 'seed: 1, duration: 2.0'), section('sim_plant', 'seed: 3')
    assert seed_of(file(wild + own)) == 3
    assert seed_of(file(own + wild)) == 1
    assert load(file(wild + own), 'sim_plant', PlantConfig).duration == 2.0


def test_overrides_take_precedence_over_the_file(file):
    path = file(section('sim_plant', 'seed: 3, duration: -1.0'))
    plant = load(path, 'sim_plant', PlantConfig, {'duration': 5.0})
    assert (plant.seed, plant.duration) == (3, 5.0)
    with pytest.raises(ConfigurationError) as caught:
        load(path, 'sim_plant', PlantConfig, {'duration': -2.0})
    assert caught.value.problems == [
        'duration: got -2.0, but it must be at least 0 s (given as an override)'
    ]


def test_unknown_name_in_the_section_of_a_node_is_rejected(file):
    path = file(section('sim_plant', 'barrier.bound: [1.0, 1.0], sed: 1'))
    assert problems_of(path) == [
        'line 2: barrier.bound: unknown parameter',
        'line 2: sed: unknown parameter, did you mean seed?',
    ]


def test_shared_section_may_have_parameters_of_other_nodes(file):
    path = file(section('/**', 'barrier.bound: [1.0, 1.0], seed: 4'))
    assert seed_of(path) == 4
    assert load(path, 'blf_dsc_controller', ControllerConfig).barrier.bound == (1.0, 1.0)
    path = file(section('/**', 'barrier.bond: [1.0, 1.0], seed: 4'))
    assert problems_of(path) == [
        'line 2: barrier.bond: unknown parameter, did you mean barrier.bound?'
    ]


def test_parameters_of_ros_itself_are_accepted(file):
    content = 'use_sim_time: true, qos_overrides: {/clock: {subscription: {depth: 1}}}, seed: 2'
    assert seed_of(file(section('sim_plant', content))) == 2
    assert seed_of(file(section('/**', content))) == 2


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('', 'line 1: the file is empty'),
        ('# a comment\n', 'line 1: the file is empty'),
        ('- 1\n', 'line 1: expected node names or ros__parameters at the top'),
        ('a: [1\n', 'line 2: not valid YAML'),
        ('a:\n\tb: 1\n', 'line 2: not valid YAML'),
        ('sim_plant:\n  seed: 1\n', 'line 2: seed has a value, but is outside of ros__para'),
        ('sim_plant:\n', 'line 1: sim_plant has a value, but is outside of ros__parameters'),
        ('sim_plant:\n  ros_parameters: {seed: 1}\n', 'line 2: ros_parameters should be ros__par'),
        ('sim_plant:\n  ros__parameters:\n', 'line 2: ros__parameters of /sim_plant has no'),
        ('sim_plant:\n  ros__parameters:\n    seed:\n', 'line 3: seed has no value'),
        (
            'n:\n  ros__parameters:\n    a: 1\n    a: 2\n',
            'line 4: a is repeated, first given on line 3',
        ),
        ('n:\n  ros__parameters:\n    a.b: 1\n    a:\n      b: 2\n', 'line 5: a.b is repeated, f'),
        ('n:\n  ros__parameters: {a: 1}\nn:\n  ros__parameters: {b: 1}\n', 'line 3: n is repeated'),
        ('n:\n  ros__parameters: {a: [1, 2.0]}\n', 'line 2: a mixes types'),
        ('n:\n  ros__parameters: {a: [[1]]}\n', 'line 2: a has a list in a list'),
        ('n:\n  ros__parameters: {a: &x 1, b: *x}\n', 'line 2: ROS does not support the alias'),
        ('n-1:\n  ros__parameters: {a: 1}\n', 'line 2: /n-1 is not a valid node name'),
        ('n:\n  ros__parameters: {a: 1}\n  m: {}\n', 'line 3: m cannot be next to ros__para'),
        ('n:\n  ros__parameters: {a: {}}\n', 'line 2: a has no parameters'),
        ('n:\n  ros__parameters: {a: 1}\n---\nm: {}\n', 'line 3: not valid YAML'),
    ],
)
def test_malformed_file_is_rejected_with_its_line(file, text, message):
    (problem,) = problems_of(file(text))
    assert problem.startswith(message)


def test_missing_file_error_lists_the_presets(tmp_path):
    assert locate('recommended') == locate('recommended.yaml')
    assert locate('recommended').is_file()
    for name in ('recomended', tmp_path / 'absent.yaml', tmp_path):
        with pytest.raises(ConfigurationError) as caught:
            locate(name)
        assert str(name) in str(caught.value)
        assert re.search('a preset: .*noisy.* recommended', str(caught.value))
    with pytest.raises(ConfigurationError, match=r'did you mean recommended\? give a parameter'):
        load_loop('recomended')
    (tmp_path / 'binary.yaml').write_bytes(b'\xff\xfe\x00')
    for file in ('absent.yaml', 'binary.yaml'):
        with pytest.raises(ConfigurationError, match=file):
            read(tmp_path / file)


def test_preset_name_takes_precedence_over_files_in_the_folder(tmp_path, monkeypatch):
    preset = locate('recommended')
    monkeypatch.chdir(tmp_path)
    for name in ('recommended', 'recommended.yaml'):
        (tmp_path / name).write_text('', encoding='utf-8')
    assert locate('recommended') == preset
    for path in ('./recommended', 'recommended.yaml', tmp_path / 'recommended'):
        assert locate(path).samefile(tmp_path / path)


def test_load_loop_collects_problems_of_all_nodes(file):
    path = file(
        section('/**', 'sample_time: 1')
        + section('sim_plant', 'seed: -1')
        + section('bag_recorder', 'compression: zip')
    )
    with pytest.raises(ConfigurationError) as caught:
        load_loop(path)
    assert [problem.split(', but')[0] for problem in caught.value.problems] == [
        'sim_plant, blf_dsc_controller: line 2: sample_time: got 1',
        'sim_plant: line 4: seed: got -1',
        "bag_recorder: line 6: compression: got 'zip'",
    ]


def test_load_loop_rejects_disagreeing_nodes_and_applies_overrides(file):
    path = file(section('sim_plant', 'sample_time: 0.002'))
    with pytest.raises(ConfigurationError, match=r'sim_plant has 0\.002 s, but'):
        load_loop(path)
    loop = load_loop(
        path, {'blf_dsc_controller': {'sample_time': 0.002}, 'sim_plant': {'mode': 'lockstep'}}
    )
    assert (loop.controller.sample_time, loop.plant.mode) == (0.002, 'lockstep')


def test_misspelt_node_name_is_reported(file):
    with pytest.raises(ConfigurationError) as caught:
        load_loop(file(section('sim_plnat', 'seed: 1')))
    assert caught.value.problems == ['line 2: unknown node sim_plnat, did you mean sim_plant?']
    loop = load_loop(file(section('sim_plant', 'seed: 1') + section('sim_plant2', 'seed: 2')))
    assert loop.plant.seed == 1
    with pytest.raises(ConfigurationError, match='/left/bag_recorder does not match /bag_rec'):
        load_loop(file(section('/left/bag_recorder', 'output: here')))
    assert load_loop(file(section('robot_state_publisher', 'a: 1'))).plant == PlantConfig()


def test_problem_shared_by_several_nodes_is_reported_once(file):
    path = file(section('/**', 'robot: {urdf: panda.urdf, tip: tol}'))
    with pytest.raises(ConfigurationError) as caught:
        load_loop(path)
    (problem,) = caught.value.problems
    assert problem.startswith('sim_plant, blf_dsc_controller: line 2: robot.urdf: no ')


def test_documented_file_for_a_real_arm_is_valid(file):
    page = (Path(__file__).parents[1] / 'doc/real_arm.md').read_text()
    blocks = re.findall(r'```yaml\n(.*?)```', page, re.DOTALL)
    (at,) = (k for k, block in enumerate(blocks) if 'effort_controller:\n' in block)
    of_ros2_control, own = blocks[at : at + 2]
    path = file(own.replace('topic://robot_description', 'ur5e.urdf'))
    config = load(path, 'blf_dsc_controller', ControllerConfig)
    effort_controller = yaml.safe_load(of_ros2_control)['effort_controller']
    assert list(config.joints) == effort_controller['ros__parameters']['joints']
    assert config.safety.torque == 'hold_gravity'


def installed(prefix):
    """Create the share folder of an installation below `prefix`."""
    folder = prefix / 'share' / 'blf_dsc_controller'
    (folder / 'config').mkdir(parents=True)
    (folder / 'config' / 'recommended.yaml').touch()
    return folder


def test_files_are_those_of_the_source_tree_then_of_ros_then_of_pip(tmp_path, monkeypatch):
    """And never those of the current folder."""
    here, workspace = tmp_path / 'here', tmp_path / 'workspace'
    installed(here)
    (here / 'config').mkdir()
    (here / 'config' / 'recommended.yaml').touch()
    workspace.mkdir()  # of ROS, without the package at first
    monkeypatch.chdir(here)
    monkeypatch.setattr(files, '_CHECKOUT', tmp_path / 'checkout')
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(workspace))
    monkeypatch.setattr(sysconfig, 'get_path', lambda _name, scheme: str(tmp_path / scheme))
    with pytest.raises(BlfDscError, match='install the package again') as error:
        files.share_folder()
    assert str(here) not in str(error.value)
    for scheme in (sysconfig.get_preferred_scheme('user'), sysconfig.get_default_scheme()):
        own = installed(tmp_path / scheme)
        assert files.share_folder() == own
    if find_spec('ament_index_python'):
        packages = workspace / 'share/ament_index/resource_index/packages'
        packages.mkdir(parents=True)
        (packages / 'blf_dsc_controller').touch()
        own = installed(workspace)
        assert files.share_folder() == own
    (tmp_path / 'checkout/config').mkdir(parents=True)
    (tmp_path / 'checkout/setup.py').touch()
    assert files.share_folder() == tmp_path / 'checkout'
