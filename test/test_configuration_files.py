# SPDX-License-Identifier: Apache-2.0
"""Parameter files: read as ROS reads them, written back, documented.

Which section applies.
"""

from __future__ import annotations

import copy
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from blf_dsc_controller import (
    ConfigurationError,
    ControllerConfig,
    PlantConfig,
    change,
    load_loop,
    share_folder,
)
from blf_dsc_controller.configuration.nodes import (
    dump,
    known_names,
    load,
    locate,
    read,
)
from blf_dsc_controller.configuration.schema import flatten

USUAL = load_loop('recommended')
CHANGED = USUAL._replace(
    plant=change(
        USUAL.plant,
        {
            'sensor.position_noise': 1e-5,
            'arm.l1': 1 / 3,
            'seed': 2**62,
            'mode': 'lockstep',
        },
    ),
    controller=change(
        USUAL.controller,
        {
            'two_link.surface_gain': [1e300, 12345.678901234567],
            'two_link.bias': False,
        },
    ),
    recorder=change(
        USUAL.recorder, {'output': "it's a 'bag': #1", 'topics': ['/clock', '~/größe']}
    ),
)
COMMITTED = Path(__file__).parents[1] / 'doc' / 'parameters.md'


@pytest.fixture
def file(tmp_path):
    path = tmp_path / 'arm.yaml'

    def write(text):
        path.write_text(text, encoding='utf-8')
        return path

    return write


@pytest.fixture
def with_ros(bare_node):
    """Return a function to the parameters that rcl reads for a node.

    None: it rejects the file.
    """

    def values(path, name):
        try:
            found = bare_node(name, path)._parameter_overrides
        except RuntimeError:
            return None
        return {key: parameter.value for key, parameter in found.items()}

    return values


def without_ros(path, name):
    matching = [section for section in read(path) if section.matches(name)]
    return {
        key: entry.value
        for section in matching
        for key, entry in section.entries.items()
    }


def section(pattern, content):
    return f'{pattern}:\n  ros__parameters: {{{content}}}\n'


def load_plant(path, node='sim_plant', overrides=None):
    return load(path, node, PlantConfig, overrides)


def problems_of(path, load=load_plant, *arguments):
    with pytest.raises(ConfigurationError) as caught:
        load(path, *arguments)
    assert str(path) in str(caught.value)
    return caught.value.problems


# As ROS.

PATTERNS = (
    '/**',
    '/*',
    'n',
    '/s/n',
    '/s/*',
    '/s/**',
    '/**/n',
    '/*/n',
    '/*/*',
    's/t/n',
    '/**/t/*',
)


@pytest.mark.parametrize('name', ['/n', '/s/n', '/s/t/n', '/m', '/left/n'])
def test_sections_apply_as_in_ros_and_the_last_one_wins(with_ros, file, name):
    contents = (f'own{k}: {k}, last: {k}' for k in range(len(PATTERNS)))
    nested = 'left:\n  n:\n    ros__parameters: {arm: {l1: 2.0}, arm.l2: 3.0}\n'
    path = file(''.join(map(section, PATTERNS, contents)) + nested)
    values = without_ros(path, name)
    assert values
    assert values == with_ros(path, name)


WORDS = """
1e-5 1E3 .5 5. +5 0x1F -0x10 017 08 1e400 1e-400 1e-310 0e5 1.2.3 1e 0x 1d3 12abc 0b11 0o17
9223372036854775807 9223372036854775808 yes No y N on OFF true TRUE tRue 1_000 1:30 2020-01-01 null
.inf -.inf +.Inf inf -inf INF infinity nan .NaN -nan NAN 5. 1_000.5 e5 . -7 12 "1.0" 'yes' ~ '' ""
"""


def test_scalars_have_the_values_and_types_of_ros(with_ros, file):
    words = [*WORDS.split(), '!!str 1', '1 2', '>-\n      yes', '|\n      12']
    lines = [f'    a{index}: {word}\n' for index, word in enumerate(words)]
    path = file('n:\n  ros__parameters:\n' + ''.join(lines))
    ours = without_ros(path, '/n')
    expected = with_ros(path, '/n')
    assert len(expected) == len(words)
    assert {key: repr(value) for key, value in ours.items()} == {
        key: repr(value) for key, value in expected.items()
    }


@pytest.mark.parametrize('node', ['sim_plant', 'blf_dsc_controller', 'bag_recorder'])
@pytest.mark.parametrize('preset', ['panda', 'noisy', None])
def test_presets_and_written_files_have_the_values_of_ros(
    with_ros, tmp_path, preset, node
):
    path = tmp_path / 'run.yaml' if preset is None else locate(preset)
    if preset is None:
        dump(path, CHANGED.by_node)
    ours = without_ros(path, f'/{node}')
    expected = with_ros(path, f'/{node}')
    # rclpy has no type for an empty list and leaves it unset.
    assert {
        key: value or None if value == [] else value for key, value in ours.items()
    } == expected


@pytest.mark.parametrize('encoding', ['utf-16', 'latin-1'])
def test_file_that_is_not_utf_8_is_to_be_saved_so(tmp_path, encoding):
    text = section('sim_plant', 'seed: 1 # groß')
    (tmp_path / 'a.yaml').write_bytes(text.encode(encoding))
    (problem,) = problems_of(tmp_path / 'a.yaml')
    assert problem.endswith(': save it as UTF-8')
    (tmp_path / 'a.urdf').write_bytes('<robot name="groß" />'.encode(encoding))
    arm = f'robot: {{urdf: "{tmp_path}/a.urdf", tip: tool0}}'
    (tmp_path / 'a.yaml').write_text(section('sim_plant', arm))
    (problem,) = problems_of(tmp_path / 'a.yaml')
    assert 'a.urdf is no text in UTF-8' in problem


def test_file_that_ros_rejects_is_refused_as_well(with_ros, file):
    """`test_refusals.py` tests what is said of each."""
    table = Path(__file__).with_name('refusals') / 'parameter_files.yaml'
    cases = yaml.safe_load(table.read_text(encoding='utf-8'))['cases']
    rejected = [case['files']['my.yaml'] for case in cases if 'ros' in case]
    assert len(rejected) > 10
    for text in rejected:
        assert with_ros(file(text), '/n') is None


# Written and documented.


def test_configuration_of_a_run_round_trips(tmp_path):
    path = tmp_path / 'run.yaml'
    dump(path, CHANGED.by_node)
    assert load_loop(path) == CHANGED
    dump(path, {'/left/sim_plant': CHANGED.plant})
    assert load(path, '/left/sim_plant', PlantConfig) == CHANGED.plant
    with pytest.raises(
        ConfigurationError, match='/left/sim_plant does not match /right/sim'
    ):
        load(path, '/right/sim_plant', PlantConfig)


def test_parameter_page_is_what_its_command_writes(tmp_path):
    page = tmp_path / 'parameters.md'
    script = Path(__file__).with_name('parameter_tables.py')
    committed = COMMITTED.read_text(encoding='utf-8')
    page.write_text(committed.partition('\n## ')[0], encoding='utf-8')
    subprocess.run(
        [sys.executable, str(script), str(page)], check=True, cwd=COMMITTED.parents[1]
    )
    assert committed == page.read_text(encoding='utf-8'), (
        'run: python test/parameter_tables.py doc/parameters.md'
    )
    rows = [row for row in committed.splitlines() if row.startswith('| `')]
    assert {row.split('`')[1] for row in rows} >= known_names()
    assert {row.replace('\\|', '').count('|') for row in rows} == {7}


# Which section applies.


@pytest.mark.parametrize(
    ('pattern', 'node'),
    [('sim_plant', '/left/sim_plant'), ('/*/sim_plant', '/sim_plant')],
)
def test_section_meant_for_the_node_that_ros_would_ignore_is_rejected(
    file, pattern, node
):
    """Unless the file has another one for it."""
    text = section(pattern, 'seed: 7')
    remedy = f'does not match {node}: write /**/sim_plant for the node in any namespace'
    found = problems_of(file(text), load_plant, node)
    assert found == [f'line 2: /{pattern.removeprefix("/")} {remedy}']
    assert load_plant(file(text + section(node, 'duration: 2.0')), node).seed == 0


def test_overrides_take_precedence_over_the_file(file):
    path = file(section('sim_plant', 'seed: 3, duration: -1.0'))
    plant = load_plant(path, overrides={'duration': 5.0})
    assert (plant.seed, plant.duration) == (3, 5.0)
    assert problems_of(path, load_plant, 'sim_plant', {'duration': -2.0}) == [
        (
            'duration: got -2.0, but it must be at least 0 and at most 1e+08 s '
            '(given as an override)'
        )
    ]


def test_unknown_names_are_rejected_and_those_of_other_nodes_only_in_their_own_section(
    file,
):
    assert problems_of(
        file(section('sim_plant', 'barrier.bound: [1.0, 1.0], sed: 1'))
    ) == [
        'line 2: barrier.bound: unknown parameter',
        'line 2: sed: unknown parameter, did you mean seed?',
    ]
    path = file(section('/**', 'barrier.bound: [1.0, 1.0], seed: 4'))
    assert load_plant(path).seed == 4
    assert load(path, 'blf_dsc_controller', ControllerConfig).barrier.bound == (
        1.0,
        1.0,
    )
    assert problems_of(file(section('/**', 'barrier.bond: [1.0, 1.0], seed: 4'))) == [
        'line 2: barrier.bond: unknown parameter, did you mean barrier.bound?'
    ]
    of_ros = 'use_sim_time: true, qos_overrides: {/clock: {subscription: {depth: 1}}}, seed: 2'
    for pattern in ('sim_plant', '/**'):
        assert load_plant(file(section(pattern, of_ros))).seed == 2


def test_a_law_of_the_package_has_its_gains_and_others_have_not(file):
    gains = 'gains: {surface_gain: 9.0}'
    path = file(section('/**', f'law: backstepping, {gains}'))
    config = load(path, 'blf_dsc_controller', ControllerConfig)
    assert flatten(config)['gains.surface_gain'] == 9.0
    assert flatten(config)['gains.leakage'] == 0.001
    assert not hasattr(ControllerConfig(), 'gains')
    assert copy.deepcopy(config) == config  # through `__reduce__`, as pickle does
    with pytest.raises(ConfigurationError, match=r'gains\.surface_gain: unknown'):
        load(file(section('/**', gains)), 'blf_dsc_controller', ControllerConfig)


def test_preset_name_takes_precedence_over_files_in_the_folder(tmp_path, monkeypatch):
    preset = locate('recommended')
    monkeypatch.chdir(tmp_path)
    for name in ('recommended', 'recommended.yaml'):
        (tmp_path / name).write_text('', encoding='utf-8')
    assert locate('recommended') == preset
    for path in ('./recommended', 'recommended.yaml', tmp_path / 'recommended'):
        assert locate(path).samefile(tmp_path / path)


def test_load_loop_collects_the_problems_of_all_nodes_each_once(file):
    path = file(
        section('/**', 'sample_time: 1')
        + section('sim_plant', 'seed: -1')
        + section('bag_recorder', 'compression: zip')
    )
    assert [problem.split(', but')[0] for problem in problems_of(path, load_loop)] == [
        'sim_plant, blf_dsc_controller: line 2: sample_time: got 1',
        'sim_plant: line 4: seed: got -1',
        'bag_recorder: line 6: compression: got "zip"',
    ]
    path = file(section('/**', 'robot: {urdf: panda.urdf, tip: tol}'))
    (problem,) = problems_of(path, load_loop)
    assert problem.startswith('sim_plant, blf_dsc_controller: line 2: robot.urdf: no ')


def test_nodes_of_a_loop_agree_on_sample_time_and_joints(file):
    path = file(section('sim_plant', 'sample_time: 0.002'))
    (problem,) = problems_of(path, load_loop)
    assert problem.startswith('sample_time: sim_plant has 0.002 s, but')
    given = {
        'blf_dsc_controller': {'sample_time': 0.002},
        'sim_plant': {'mode': 'lockstep'},
    }
    loop = load_loop(path, given)
    assert (loop.controller.sample_time, loop.plant.mode) == (0.002, 'lockstep')
    (problem,) = problems_of(
        file(section('sim_plant', 'joints: [joint1, elbow]')), load_loop
    )
    assert problem.startswith(
        'joints: sim_plant has joint1, elbow, but blf_dsc_controller has'
    )
    swapped = load_loop(file(section('sim_plant', 'joints: [joint2, joint1]')))
    assert swapped.plant.joints != swapped.controller.joints


def test_arm_may_be_named_by_the_url_of_a_file(file, tmp_path):
    (tmp_path / 'mine.urdf').write_text(
        (share_folder() / 'config/ur5e.urdf').read_text(encoding='utf-8')
    )
    arm = f'robot: {{urdf: "file://{tmp_path}/mine.urdf", tip: tool0}}'
    assert len(load_plant(file(section('sim_plant', arm))).joints) == 6


def test_file_may_be_based_on_a_preset(tmp_path):
    """Its values take precedence, those of the base are found in its file."""
    path = tmp_path / 'mine.yaml'
    head = '/**:\n  ros__parameters:\n    base: panda\n'
    bound = [0.03] * 7
    path.write_text(
        f'{head}/**/blf_dsc_controller:\n  ros__parameters:\n    barrier.bound: {bound}\n'
    )
    preset, mine = load_loop('panda'), load_loop(path)
    assert mine.controller == change(preset.controller, {'barrier.bound': bound})
    assert mine.plant == preset.plant
    path.write_text(f'{head}    robot.tip: panda_link4\n')
    with pytest.raises(
        ConfigurationError,
        match=r'line \d+ of panda.yaml: robot.coulomb: got 7, but 4 entries are needed',
    ):
        load_loop(path)
