# SPDX-License-Identifier: Apache-2.0
"""Bags of other software: other topics, joints and orders, shared topics, earlier releases."""

from __future__ import annotations

import csv

import numpy as np
import pytest
import recorded_run
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from blf_dsc_controller.bags.content import NameMap, read_content
from blf_dsc_controller.bags.reader import read_run
from blf_dsc_controller.bags.sources import BagError
from blf_dsc_controller.bags.topic_messages import UnreadableMessageError
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.codecs import (
    Float64MultiArrayEncoder,
    JointStateEncoder,
)
from blf_dsc_controller.messages.topics import (
    COMMANDS,
    FLOAT64_MULTI_ARRAY,
    JOINT_STATE,
    JOINT_STATES,
)
from blf_dsc_controller.messages.types import typestore
from blf_dsc_controller.replay.what_if import what_if

pytestmark = pytest.mark.usefixtures('blank_pictures')

pytest.importorskip('plotly', reason='needs plotly: pip install blf_dsc_controller[report]')

SHUFFLED = ('gripper', 'elbow_pitch', 'base', 'shoulder_pitch')
MAP = [
    'joint_states=/arm/states',
    'commands=/arm/torque',
    'joint1=shoulder_pitch',
    'joint2=elbow_pitch',
]
CONFIG = recorded_run.loop_config().controller
FINGERS = JointStateEncoder(('left_finger',))


@pytest.fixture(scope='module')
def ours(tmp_path_factory):
    return recorded_run.record(tmp_path_factory.mktemp('ours') / 'bag', 0.5)


@pytest.fixture(scope='module')
def run(ours):
    """Stamps, [q, dq, effort] and what-if replay of a run of our own."""
    states = read_content(ours).topics[JOINT_STATES].joint_states(CONFIG.joints)
    values = np.stack([states.field(k) for k in range(3)], axis=1)
    return states.stamp, values, what_if(ours, CONFIG)


def spread(values):
    """Place two values among those of the four joints of SHUFFLED."""
    return [77.0, values[1], -5.0, values[0]]


def foreign(run, torque='array'):
    """Topic, type, time and bytes of each message as another robot's software writes it."""
    stamps, values, replayed = run
    states = JointStateEncoder(SHUFFLED, frame_id='base_link')
    arrays = {4: Float64MultiArrayEncoder(4), 2: Float64MultiArrayEncoder(2)}
    for k, stamp in enumerate(stamps.tolist()):
        q, dq, effort = (spread(field) for field in values[k])
        measured = effort if torque == 'effort' else [0.0] * 4
        yield '/arm/states', JOINT_STATE, stamp, states.encode(stamp, q, dq, measured)
        command = replayed.applied[k]
        if torque == 'array':
            yield '/arm/torque', FLOAT64_MULTI_ARRAY, stamp + 9, arrays[4].encode(spread(command))
        if torque == 'pair':
            yield '/arm/torque', FLOAT64_MULTI_ARRAY, stamp + 9, arrays[2].encode(command)
        if torque == 'state':
            raw = states.encode(stamp, [0] * 4, [0] * 4, spread(command))
            yield '/arm/torque', JOINT_STATE, stamp + 9, raw


def write(path, messages, storage=StoragePlugin.MCAP, version=9):
    with Writer(path, version=version, storage_plugin=storage) as writer:
        connections = {}
        for topic, type_name, at, raw in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, type_name, typestore=typestore())
            writer.write(connections[topic], at, raw)
    return path


def write_ros1(path, messages):
    store = get_typestore(Stores.ROS1_NOETIC)
    with Writer1(path) as writer:
        connections = {}
        for k, (topic, type_name, at, raw) in enumerate(messages):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, type_name, typestore=store)
            message = typestore().deserialize_cdr(raw, type_name)
            if type_name == JOINT_STATE:
                types = store.types
                stamp = message.header.stamp
                header = types['std_msgs/msg/Header'](
                    seq=k,
                    stamp=types['builtin_interfaces/msg/Time'](stamp.sec, stamp.nanosec),
                    frame_id=message.header.frame_id,
                )
                arrays = (message.name, message.position, message.velocity, message.effort)
                message = types[JOINT_STATE](header, *arrays)
            writer.write(connections[topic], at, store.serialize_ros1(message, type_name))
    return path


@pytest.mark.parametrize(
    ('kind', 'torque'),
    [('mcap', 'array'), ('mcap', 'pair'), ('sqlite3', 'state'), ('humble', 'array'), ('1', 'pair')],
)
def test_shuffled_and_extra_joints_replay_to_the_same_torques(run, tmp_path, kind, torque):
    messages, path = foreign(run, torque), tmp_path / 'bag'
    if kind == '1':
        path = write_ros1(tmp_path / 'run.bag', messages)
    elif kind == 'mcap':
        write(path, messages)
    else:
        write(path, messages, StoragePlugin.SQLITE3, 8)
    if kind == 'humble':  # without message definitions
        text = (path / 'metadata.yaml').read_text()
        (path / 'metadata.yaml').write_text(text.replace('version: 8', 'version: 5'))
    result = what_if(path, CONFIG, names=NameMap.parse(MAP))
    np.testing.assert_array_equal(result.run.torque, run[2].run.torque)
    np.testing.assert_array_equal(result.applied, run[2].applied)
    assert result.source == '/arm/torque'


def test_effort_is_taken_as_torque_if_there_are_no_commands(run, tmp_path):
    names = NameMap.parse([entry for entry in MAP if 'commands' not in entry])
    result = what_if(write(tmp_path / 'bag', foreign(run, 'effort')), CONFIG, names=names)
    assert result.source == 'effort of /arm/states'
    # The effort of a state is the torque that led to it: the last torque is unknown.
    np.testing.assert_array_equal(result.applied[:-1], run[2].applied[:-1])
    assert np.isnan(result.applied[-1]).all()
    empty = JointStateEncoder(SHUFFLED, ('position', 'velocity'))
    bare = [
        ('/arm/states', JOINT_STATE, at, empty.encode(at, spread(q), spread(dq)))
        for at, (q, dq, _) in zip(run[0].tolist(), run[1], strict=True)
    ]
    with pytest.raises(BlfDscError, match='--map commands='):
        what_if(write(tmp_path / 'bare', bare), CONFIG, names=names)


def test_commands_at_another_rate_are_held_until_the_next_one(run, tmp_path):
    messages = list(foreign(run, 'pair'))
    kept = [entry for k, entry in enumerate(messages) if entry[0] != '/arm/torque' or k % 4 == 1]
    result = what_if(write(tmp_path / 'bag', kept), CONFIG, names=NameMap.parse(MAP))
    np.testing.assert_array_equal(result.applied[1], run[2].applied[0])  # previous command held
    np.testing.assert_array_equal(result.applied[2], run[2].applied[2])


def names_of(**changes):
    entries = dict(entry.split('=') for entry in MAP) | changes
    return NameMap.parse(f'{ours}={theirs}' for ours, theirs in entries.items())


def test_wrong_names_and_orders_are_reported_with_the_names_in_the_bag(run, tmp_path):
    path = write(tmp_path / 'bag', foreign(run))
    swapped = {'joint_states': '/arm/torque', 'commands': '/arm/states'}
    for changes, error, message in (
        ({'joint_states': '/arm/state'}, BagError, r"'/arm/state' of type sensor_msgs"),
        (swapped, BagError, r'/arm/torque \(std_msgs'),
        ({'joint1': 'shoulder'}, UnreadableMessageError, "'shoulder' is not in .* gripper, elbow"),
        ({'joint3': 'base'}, BlfDscError, 'joint3 is neither a topic nor one of the joints'),
    ):
        with pytest.raises(error, match=message):
            what_if(path, CONFIG, names=names_of(**changes))
    three = Float64MultiArrayEncoder(3)
    messages = [
        message if message[0] == '/arm/states' else (*message[:3], three.encode([1, 2, 3]))
        for message in foreign(run)
    ]
    with pytest.raises(BlfDscError, match='3 values, but there are 2 joints, and 4 in'):
        what_if(write(tmp_path / 'three', messages), CONFIG, names=NameMap.parse(MAP))
    for entries, words in (
        *((([entry],), 'one side is missing') for entry in ('joint1', '=x', 'joint1=')),
        ((['joint1=a', 'joint2=a'],), 'given twice'),
    ):
        with pytest.raises(BlfDscError, match=words):
            NameMap.parse(*entries)


# A gripper that shares /joint_states with the arm.


@pytest.fixture(scope='module')
def entries(ours):
    """Messages of the arm, with one of the gripper before every third joint state."""
    both = []
    for k, entry in enumerate(recorded_run.messages(ours)):
        if entry[0] == JOINT_STATES.resolved and k % 3 == 0:
            at = entry[2] - 5
            both.append([*entry[:2], at, FINGERS.encode(at, [0.01], [0.0], [9.0])])
        both.append(entry)
    return both


@pytest.fixture(scope='module')
def shared(entries, tmp_path_factory):
    return recorded_run.write(tmp_path_factory.mktemp('shared') / 'bag', entries)


def test_run_and_what_if_replay_equal_those_of_the_arm_alone(ours, run, shared):
    found, expected = read_run(shared), read_run(ours)
    assert found.joints == expected.joints
    for name in ('stamp', 'position', 'torque', 'error'):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    np.testing.assert_array_equal(what_if(shared, CONFIG).run.torque, run[2].run.torque)


def test_commands_in_driver_joint_order_are_matched_to_the_arm(run, tmp_path):
    """Three torques per command: the driver has a third joint that is not the controller's."""
    stamps, values, same = run
    states, torques = JointStateEncoder(('x', *CONFIG.joints)), Float64MultiArrayEncoder(3)
    entries = []
    for stamp, value, torque in zip(stamps.tolist(), values, same.applied, strict=True):
        raw = states.encode(stamp, *([7.0, *field] for field in value))
        entries.append([JOINT_STATES.resolved, JOINT_STATE, stamp, raw])
        raw = torques.encode([7.0, *torque])
        entries.append([COMMANDS.resolved, FLOAT64_MULTI_ARRAY, stamp, raw])
    found = what_if(recorded_run.write(tmp_path / 'bag', entries), CONFIG)
    np.testing.assert_array_equal(found.applied, same.applied)


def test_without_controller_topics_the_device_with_most_joints_is_the_arm(entries, tmp_path):
    path = recorded_run.write(tmp_path / 'bag', recorded_run.of(entries, JOINT_STATES))
    assert read_run(path).joints == ('joint1', 'joint2')
    run = read_run(path, names=NameMap.parse(['grip=left_finger']))
    assert (run.joints, set(run.position[:, 0])) == (('grip',), {0.01})


def test_every_command_reads_a_shared_topic_under_any_name(shared, entries, tmp_path, capsys):
    names = {JOINT_STATES.resolved: '/arm/states', COMMANDS.resolved: '/arm/torque'}
    messages = [[names.get(topic, topic), *rest] for topic, *rest in entries]
    renamed = recorded_run.write(tmp_path / 'renamed', messages)
    mapped, tables = ['--map', 'joint_states=/arm/states', '--map', 'commands=/arm/torque'], []
    for bag, words in ((shared, []), (renamed, mapped)):
        out = tmp_path / f'{bag.name}.csv'
        for command in (
            ['replay', str(bag)],
            ['replay', str(bag), '--config', 'recommended'],
            ['export', str(bag), '--out', str(out)],
            ['report', str(bag), '--out', str(tmp_path / f'{bag.name}.html')],
        ):
            assert main([*command, *words]) == 0, capsys.readouterr().err
        tables.append(list(csv.reader(out.open())))
    assert tables[0] == tables[1]
    output = capsys.readouterr().out
    assert '/arm/torque: 1002 values bit-equal' in output
    assert 'recorded torque: /arm/torque' in output
    # Without the mapping, the joint states are not found.
    assert main(['plot', str(renamed), '--out', str(tmp_path / 'none')]) == 1


def test_states_without_stamps_are_rejected_with_the_reason(tmp_path):
    driver = JointStateEncoder(('joint1', 'joint2'))
    states = [
        ['/joint_states', JOINT_STATE, k, driver.encode(0, [k, 0], [0, 0], [0, 0])]
        for k in range(1, 50)
    ]
    path = recorded_run.write(tmp_path / 'bag', states)
    for read in (read_run, lambda bag: what_if(bag, CONFIG)):
        with pytest.raises(BagError, match='all 49 messages of /joint_states have the stamp 0 ns'):
            read(path)
