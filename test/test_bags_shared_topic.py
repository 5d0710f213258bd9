# SPDX-License-Identifier: Apache-2.0
"""A gripper that shares /joint_states with the arm is ignored by every reader of bags."""

from __future__ import annotations

import csv

import numpy as np
import pytest
import recorded_run

from blf_dsc_controller.bags.content import NameMap
from blf_dsc_controller.bags.reader import read_run
from blf_dsc_controller.bags.sources import BagError
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.messages.codecs import (
    Float64MultiArrayEncoder,
    JointStateDecoder,
    JointStateEncoder,
)
from blf_dsc_controller.messages.topics import COMMANDS, JOINT_STATE, JOINT_STATES
from blf_dsc_controller.replay.learn import learn
from blf_dsc_controller.replay.what_if import what_if

pytestmark = pytest.mark.usefixtures('blank_pictures')

pytest.importorskip('plotly', reason='needs plotly: pip install blf_dsc_controller[report]')

CONFIG = recorded_run.loop_config().controller
FINGERS = JointStateEncoder(('left_finger',))


@pytest.fixture(scope='module')
def alone(tmp_path_factory):
    return recorded_run.record(tmp_path_factory.mktemp('alone') / 'bag')


@pytest.fixture(scope='module')
def entries(alone):
    """Messages of the arm, with one of the gripper before every third joint state."""
    both = []
    for k, entry in enumerate(recorded_run.messages(alone)):
        if entry[0] == JOINT_STATES.resolved and k % 3 == 0:
            at = entry[2] - 5
            both.append([*entry[:2], at, FINGERS.encode(at, [0.01], [0.0], [9.0])])
        both.append(entry)
    return both


@pytest.fixture(scope='module')
def shared(entries, tmp_path_factory):
    return recorded_run.write(tmp_path_factory.mktemp('shared') / 'bag', entries)


def test_run_equals_that_of_the_arm_alone(alone, shared):
    run, expected = read_run(shared), read_run(alone)
    assert run.joints == expected.joints
    for name in ('stamp', 'position', 'torque', 'error'):
        np.testing.assert_array_equal(getattr(run, name), getattr(expected, name))


def test_what_if_and_learn_replays_ignore_the_gripper(alone, shared):
    torque = what_if(alone, CONFIG).run.torque
    np.testing.assert_array_equal(what_if(shared, CONFIG).run.torque, torque)
    np.testing.assert_array_equal(learn(shared, CONFIG).estimate, learn(alone, CONFIG).estimate)


def test_commands_in_driver_joint_order_are_matched_to_the_arm(alone, entries, tmp_path):
    # Three torques per command: the driver has a third joint that is not the controller's.
    decoder, driver = JointStateDecoder(CONFIG.joints), JointStateEncoder(('x', *CONFIG.joints))
    kept = []
    for topic, type_name, at, raw in entries:
        if topic == JOINT_STATES.resolved and len(raw) != len(FINGERS.encode(0, [0], [0], [0])):
            stamp = decoder.decode(raw)
            fields = ([7.0, *values] for values in decoder.values.reshape(3, -1))
            kept.append([topic, type_name, at, driver.encode(stamp, *fields)])
        elif topic == JOINT_STATES.resolved:
            kept.append([topic, type_name, at, raw])
        elif topic == COMMANDS.resolved:
            command = Float64MultiArrayEncoder(3).encode([7.0, *np.frombuffer(raw[-16:])])
            kept.append([topic, type_name, at, command])
    found = what_if(recorded_run.write(tmp_path / 'bag', kept), CONFIG)
    np.testing.assert_array_equal(found.applied, what_if(alone, CONFIG).applied)


def test_without_controller_topics_the_device_with_most_joints_is_the_arm(entries, tmp_path):
    states = recorded_run.of(entries, JOINT_STATES)
    assert read_run(recorded_run.write(tmp_path / 'a', states)).joints == ('joint1', 'joint2')
    names = NameMap.parse(['grip=left_finger'])
    run = read_run(recorded_run.write(tmp_path / 'b', states), names=names)
    assert run.joints == ('grip',)
    assert set(run.position[:, 0]) == {0.01}


def test_every_command_reads_the_shared_bag(shared, tmp_path, capsys):
    for words in (
        ['replay', str(shared)],
        ['replay', str(shared), '--config', 'recommended'],
        ['report', str(shared), '--out', str(tmp_path / 'page.html')],
        ['export', str(shared), '--out', str(tmp_path / 'table.csv')],
        ['plot', str(shared), '--out', str(tmp_path / 'plots')],
    ):
        assert main(words) == 0, capsys.readouterr().err


@pytest.fixture(scope='module')
def renamed(entries, tmp_path_factory):
    """The same run under the topics of another namespace."""
    names = {JOINT_STATES.resolved: '/arm/states', COMMANDS.resolved: '/arm/torque'}
    path = tmp_path_factory.mktemp('renamed') / 'bag'
    return recorded_run.write(path, [[names.get(topic, topic), *rest] for topic, *rest in entries])


def test_every_command_maps_topic_names(shared, renamed, tmp_path, capsys):
    words = ['--map', 'joint_states=/arm/states', '--map', 'commands=/arm/torque']
    assert main(['replay', str(renamed), *words]) == 0
    assert '/arm/torque: 2002 values bit-equal' in capsys.readouterr().out
    tables = []
    for bag, names in ((shared, []), (renamed, words)):
        out = tmp_path / f'{len(tables)}.csv'
        assert main(['export', str(bag), '--out', str(out), *names]) == 0
        tables.append(list(csv.reader(out.open())))
    assert tables[0] == tables[1]
    for command in ('report', 'plot'):
        assert main([command, str(renamed), '--out', str(tmp_path / command), *words]) == 0
    # Without the mapping, the joint states are not found.
    assert main(['plot', str(renamed), '--out', str(tmp_path / 'none')]) == 1


def test_mappings_without_effect_are_rejected(shared, capsys):
    assert main(['replay', str(shared), '--map', 'joint7=x']) == 1
    assert 'joint7 is neither a topic nor one of the joints' in capsys.readouterr().err
    assert main(['replay', str(shared), '--play', '--map', 'joint1=x']) == 1
    assert '--map has no effect on --play' in capsys.readouterr().err


def test_states_without_stamps_are_rejected_with_the_reason(tmp_path):
    driver = JointStateEncoder(('joint1', 'joint2'))
    states = [
        ['/joint_states', JOINT_STATE, k, driver.encode(0, [k, 0], [0, 0], [0, 0])]
        for k in range(1, 50)
    ]
    path = recorded_run.write(tmp_path / 'bag', states)
    message = 'all 49 messages of /joint_states have the stamp 0 ns'
    for read in (read_run, lambda bag: what_if(bag, CONFIG), lambda bag: learn(bag, CONFIG)):
        with pytest.raises(BagError, match=message):
            read(path)
