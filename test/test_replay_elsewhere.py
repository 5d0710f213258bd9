# SPDX-License-Identifier: Apache-2.0
"""Bags written by other software: other topics, other joint names and orders, extra joints."""

from __future__ import annotations

import numpy as np
import pytest
import recorded_run
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from blf_dsc_controller.bags.content import NameMap, read_content
from blf_dsc_controller.bags.sources import BagError
from blf_dsc_controller.bags.topic_messages import UnreadableMessageError
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.codecs import Float64MultiArrayEncoder, JointStateEncoder
from blf_dsc_controller.messages.topics import FLOAT64_MULTI_ARRAY, JOINT_STATE, JOINT_STATES
from blf_dsc_controller.messages.types import typestore
from blf_dsc_controller.replay.what_if import what_if

SHUFFLED = ('gripper', 'elbow_pitch', 'base', 'shoulder_pitch')
MAP = [
    'joint_states=/arm/states',
    'commands=/arm/torque',
    'joint1=shoulder_pitch',
    'joint2=elbow_pitch',
]
CONFIG = recorded_run.loop_config().controller


@pytest.fixture(scope='module')
def run(tmp_path_factory):
    """Stamps, [q, dq, effort] and what-if replay of a run of our own."""
    path = recorded_run.record(tmp_path_factory.mktemp('ours') / 'bag', 0.5)
    content = read_content(path)
    states = content.topics[JOINT_STATES].joint_states(CONFIG.joints)
    return states.stamp, states.values, what_if(path, CONFIG)


def spread(values):
    """Place two values among those of the four joints of SHUFFLED."""
    return [77.0, values[1], -5.0, values[0]]


def foreign(run, torque='array'):
    """Topic, type, time and bytes of each message as another robot's software writes it."""
    stamps, values, ours = run
    states = JointStateEncoder(SHUFFLED, frame_id='base_link')
    arrays = {4: Float64MultiArrayEncoder(4), 2: Float64MultiArrayEncoder(2)}
    for k, stamp in enumerate(stamps.tolist()):
        q, dq, effort = (spread(field) for field in values[k])
        measured = effort if torque == 'effort' else [0.0] * 4
        yield '/arm/states', JOINT_STATE, stamp, states.encode(stamp, q, dq, measured)
        command = ours.applied[k]
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


@pytest.mark.parametrize('torque', ['array', 'pair', 'state'])
@pytest.mark.parametrize('storage', [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_shuffled_and_extra_joints_replay_to_the_same_torques(run, tmp_path, storage, torque):
    path = write(tmp_path / 'bag', foreign(run, torque), storage)
    result = what_if(path, CONFIG, names=NameMap.parse(MAP))
    np.testing.assert_array_equal(result.run.torque, run[2].run.torque)
    np.testing.assert_array_equal(result.applied, run[2].applied)


@pytest.mark.parametrize('version', [5, 8])  # Humble (without message definitions) and Iron
def test_bags_of_earlier_ros_releases_are_read(run, tmp_path, version):
    path = write(tmp_path / 'bag', foreign(run), StoragePlugin.SQLITE3, max(version, 8))
    if version == 5:
        text = (path / 'metadata.yaml').read_text()
        (path / 'metadata.yaml').write_text(text.replace('version: 8', 'version: 5'))
    result = what_if(path, CONFIG, names=NameMap.parse(MAP))
    assert np.abs(result.difference).max() == 0.0


def test_ros1_bag_is_read(run, tmp_path):
    path = write_ros1(tmp_path / 'run.bag', foreign(run))
    result = what_if(path, CONFIG, names=NameMap.parse(MAP))
    np.testing.assert_array_equal(result.run.torque, run[2].run.torque)


def test_effort_is_taken_as_torque_if_there_are_no_commands(run, tmp_path):
    path = write(tmp_path / 'bag', foreign(run, 'effort'))
    names = NameMap.parse([entry for entry in MAP if 'commands' not in entry])
    result = what_if(path, CONFIG, names=names)
    assert result.source == 'effort of /arm/states'
    # The effort of a state is the torque that led to it: the last torque is unknown.
    np.testing.assert_array_equal(result.applied[:-1], run[2].applied[:-1])
    assert np.isnan(result.applied[-1]).all()


def test_commands_at_another_rate_are_held_until_the_next_one(run, tmp_path):
    messages = list(foreign(run, 'pair'))
    kept = [entry for k, entry in enumerate(messages) if entry[0] != '/arm/torque' or k % 4 == 1]
    result = what_if(write(tmp_path / 'bag', kept), CONFIG, names=NameMap.parse(MAP))
    np.testing.assert_array_equal(result.applied[1], run[2].applied[0])  # previous command held
    np.testing.assert_array_equal(result.applied[2], run[2].applied[2])


def test_replay_command_reads_a_foreign_bag(run, tmp_path, capsys):
    path = write(tmp_path / 'bag', foreign(run), StoragePlugin.SQLITE3)
    words = [word for entry in MAP for word in ('--map', entry)]
    assert main(['replay', str(path), '--config', 'recommended', *words]) == 0
    assert 'recorded torque: /arm/torque' in capsys.readouterr().out


def names_of(**changes):
    entries = dict(entry.split('=') for entry in MAP) | changes
    return NameMap.parse(f'{ours}={theirs}' for ours, theirs in entries.items())


@pytest.mark.parametrize(
    ('changes', 'error', 'message'),
    [
        ({'joint_states': '/arm/state'}, BagError, r"'/arm/state' of type sensor_msgs"),
        (
            {'joint_states': '/arm/torque', 'commands': '/arm/states'},
            BagError,
            r'/arm/torque \(std_msgs',
        ),
        ({'joint1': 'shoulder'}, UnreadableMessageError, "'shoulder' is not in .* gripper, elbow"),
        ({'joint3': 'base'}, BlfDscError, 'joint3 is neither a topic nor one of the joints'),
    ],
)
def test_wrong_name_is_reported_with_the_names_in_the_bag(run, tmp_path, changes, error, message):
    path = write(tmp_path / 'bag', foreign(run))
    with pytest.raises(error, match=message):
        what_if(path, CONFIG, names=names_of(**changes))


def test_bag_without_torques_is_rejected_with_a_hint_to_map_commands(run, tmp_path):
    states = [message for message in foreign(run) if message[0] == '/arm/states']
    empty = JointStateEncoder(SHUFFLED, ('position', 'velocity'))
    bare = [
        (topic, type_, at, empty.encode(at, spread(run[1][k, 0]), spread(run[1][k, 1])))
        for k, (topic, type_, at, _) in enumerate(states)
    ]
    names = NameMap.parse([entry for entry in MAP if 'commands' not in entry])
    with pytest.raises(BlfDscError, match='--map commands='):
        what_if(write(tmp_path / 'bag', bare), CONFIG, names=names)


def test_commands_in_unknown_joint_order_are_rejected(run, tmp_path):
    three = Float64MultiArrayEncoder(3)
    messages = [
        message if message[0] == '/arm/states' else (*message[:3], three.encode([1, 2, 3]))
        for message in foreign(run)
    ]
    with pytest.raises(BlfDscError, match='3 values, but there are 2 joints, and 4 in'):
        what_if(write(tmp_path / 'bag', messages), CONFIG, names=NameMap.parse(MAP))


def test_empty_bag_is_reported_as_empty(tmp_path):
    with Writer(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        writer.add_connection('/joint_states', JOINT_STATE, typestore=typestore())
    with pytest.raises(BagError, match='is empty: it holds no message'):
        what_if(tmp_path / 'bag', CONFIG)


def test_bag_of_a_newer_format_is_rejected(run, tmp_path):
    path = write(tmp_path / 'bag', foreign(run))
    text = (path / 'metadata.yaml').read_text()
    (path / 'metadata.yaml').write_text(text.replace('version: 9', 'version: 99'))
    with pytest.raises(BagError, match='99'):
        what_if(path, CONFIG, names=NameMap.parse(MAP))


@pytest.mark.parametrize('entry', ['joint1', '=x', 'joint1='])
def test_map_entry_with_one_side_missing_is_rejected(entry):
    with pytest.raises(BlfDscError, match='one side is missing'):
        NameMap.parse([entry])


def test_name_mapped_twice_is_rejected():
    with pytest.raises(BlfDscError, match='given twice'):
        NameMap.parse(['joint1=a', 'joint2=a'])
