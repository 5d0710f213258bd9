# SPDX-License-Identifier: Apache-2.0
"""Bags of other software: other topics, joints and orders, shared topics, other formats."""

from __future__ import annotations

import csv

import numpy as np
import pytest
import recorded_run
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from synthetic_bag import Synthetic

from blf_dsc_controller.bags.content import NameMap, read_content
from blf_dsc_controller.bags.reader import applied_torque, read_run, single_run
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.codecs import (
    Float64MultiArrayEncoder,
    JointStateEncoder,
    typestore,
)
from blf_dsc_controller.messages.topics import (
    COMMANDS,
    FLOAT64_MULTI_ARRAY,
    JOINT_STATE,
    JOINT_STATES,
)

pytestmark = pytest.mark.usefixtures('blank_pictures')

pytest.importorskip('plotly', reason='needs plotly: pip install blf_dsc_controller[report]')

SHUFFLED = ('gripper', 'elbow_pitch', 'base', 'shoulder_pitch')
MAP = {
    'joint_states': '/arm/states',
    'commands': '/arm/torque',
    'joint1': 'shoulder_pitch',
    'joint2': 'elbow_pitch',
}
ARM = Synthetic(100)


def names_of(**changes):
    return NameMap.parse(f'{our}={their}' for our, their in {**MAP, **changes}.items() if their)


def spread(values):
    """Place two values among those of the four joints of SHUFFLED."""
    return [77.0, values[1], -5.0, values[0]]


def foreign(torque='array', fields=('position', 'velocity', 'effort')):
    """Topic, type, time and bytes of each message as another robot's software writes it."""
    states = JointStateEncoder(SHUFFLED, fields)
    for k, stamp in enumerate(ARM.stamp.tolist()):
        known = [spread(field[k]) for field in (ARM.position, ARM.error, ARM.disturbance)]
        yield '/arm/states', JOINT_STATE, stamp, states.encode(stamp, *known[: len(fields)])
        command = ARM.torque[k]
        sent = {'array': spread(command), 'pair': command, 'three': [1, 2, 3]}.get(torque)
        if sent is not None:
            raw = Float64MultiArrayEncoder(len(sent)).encode(sent)
            yield '/arm/torque', FLOAT64_MULTI_ARRAY, stamp + 9, raw
        if torque == 'state':
            raw = states.encode(stamp, [0] * 4, [0] * 4, spread(command))
            yield '/arm/torque', JOINT_STATE, stamp + 9, raw


def write(path, messages, storage=StoragePlugin.MCAP, version=9, compression=CompressionMode.NONE):
    writer = Writer(path, version=version, storage_plugin=storage)
    writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
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
                stamp, types = message.header.stamp, store.types
                time = types['builtin_interfaces/msg/Time'](stamp.sec, stamp.nanosec)
                header = types['std_msgs/msg/Header'](k, time, 'base_link')
                arrays = (message.name, message.position, message.velocity, message.effort)
                message = types[JOINT_STATE](header, *arrays)
            writer.write(connections[topic], at, store.serialize_ros1(message, type_name))
    return path


MCAP, SQLITE3 = StoragePlugin.MCAP, StoragePlugin.SQLITE3


@pytest.mark.parametrize(
    ('storage', 'version', 'compression', 'torque'),
    [
        (MCAP, 9, CompressionMode.NONE, 'array'),
        (MCAP, 9, CompressionMode.FILE, 'pair'),
        (MCAP, 9, CompressionMode.MESSAGE, 'array'),
        (SQLITE3, 8, CompressionMode.NONE, 'state'),
        (SQLITE3, 8, CompressionMode.FILE, 'array'),
        (SQLITE3, 8, CompressionMode.MESSAGE, 'array'),
        (SQLITE3, 5, CompressionMode.NONE, 'array'),  # of Humble, without definitions
        (None, 1, CompressionMode.NONE, 'pair'),  # of ROS 1
    ],
)
def test_shuffled_and_extra_joints_are_read_by_name(
    tmp_path, storage, version, compression, torque
):
    if version == 1:
        path = write_ros1(tmp_path / 'run.bag', foreign(torque))
    else:
        path = write(tmp_path / 'bag', foreign(torque), storage, max(version, 8), compression)
    if version == 5:
        text = (path / 'metadata.yaml').read_text()
        (path / 'metadata.yaml').write_text(text.replace('version: 8', 'version: 5'))
    run = read_run(path, names=names_of())
    assert run.joints == ('joint1', 'joint2')
    np.testing.assert_array_equal(run.stamp, ARM.stamp)
    found = (run.position, run.velocity, run.effort, run.torque)
    expected = (ARM.position, ARM.error, ARM.disturbance, ARM.torque)
    for values, known in zip(found, expected, strict=True):
        np.testing.assert_array_equal(values, known)


def torque_of(path, messages, names):
    """Torques as `identify` reads them, and where they are from."""
    content = read_content(write(path, messages), '', names)
    states, _, _ = single_run(content, names.joints_of(('joint1', 'joint2')))
    source, torque = applied_torque(content, states)
    return source, torque.field(2)


def test_torques_are_those_of_the_commands_or_measured_or_unknown(tmp_path):
    unmapped = names_of(commands=None)
    source, torque = torque_of(tmp_path / 'bag', foreign('effort'), unmapped)
    assert source == 'effort of /arm/states'
    # The effort of a state is the torque that led to it: the last torque is unknown.
    np.testing.assert_array_equal(torque[:-1], ARM.disturbance[1:])
    assert np.isnan(torque[-1]).all()
    pairs = list(foreign('pair'))
    mixed = pairs[:100] + list(foreign('array'))[100:]
    for messages, names, words in (
        (foreign('', ('position', 'velocity')), unmapped, '--map commands='),
        (foreign('three'), names_of(), '3 values, but there are 2 joints, and 4 in'),
        (mixed, names_of(), 'not every message holds the same 2 values'),
    ):
        with pytest.raises(BlfDscError, match=words):
            torque_of(tmp_path / words[:3], messages, names)
    kept = [entry for k, entry in enumerate(pairs) if entry[0] != '/arm/torque' or k % 4 == 1]
    source, torque = torque_of(tmp_path / 'slow', kept, names_of())
    assert source == '/arm/torque'
    np.testing.assert_array_equal(torque[1], ARM.torque[0])  # previous command held
    np.testing.assert_array_equal(torque[2], ARM.torque[2])


@pytest.fixture(scope='module')
def ours(tmp_path_factory):
    return recorded_run.record(tmp_path_factory.mktemp('ours') / 'bag', 0.5)


def test_wrong_names_are_reported_with_the_names_in_the_bag(ours, tmp_path):
    path = write(tmp_path / 'bag', foreign())
    swapped = {'joint_states': '/arm/torque', 'commands': '/arm/states'}
    for bag, changes, message in (
        (path, {'joint_states': '/arm/state'}, r"'/arm/state' of type sensor_msgs"),
        (path, swapped, r'/arm/torque \(std_msgs'),
        (path, {'joint1': 'x'}, "'x' is not in .* gripper, elbow"),
        (ours, {**dict.fromkeys(MAP), 'joint3': 'base'}, 'nor one of the joints'),
    ):
        with pytest.raises(BlfDscError, match=message):
            read_run(bag, names=names_of(**changes))
    for entries, words in (
        *((([entry],), 'one side is missing') for entry in ('joint1', '=x', 'joint1=')),
        ((['joint1=a', 'joint2=a'],), 'given twice'),
    ):
        with pytest.raises(BlfDscError, match=words):
            NameMap.parse(*entries)


def test_gripper_on_the_same_topic_is_told_from_the_arm_under_any_name(ours, tmp_path, capsys):
    fingers, entries = JointStateEncoder(('left_finger',)), []
    for k, entry in enumerate(recorded_run.messages(ours)):
        if entry[0] == JOINT_STATES.resolved and k % 3 == 0:
            at = entry[2] - 5
            entries.append([*entry[:2], at, fingers.encode(at, [0.01], [0.0], [9.0])])
        entries.append(entry)
    # Without topics of a controller, the device with most joints is the arm.
    path = recorded_run.write(tmp_path / 'bag', recorded_run.of(entries, JOINT_STATES))
    assert read_run(path).joints == ('joint1', 'joint2')
    run = read_run(path, names=NameMap.parse(['grip=left_finger']))
    assert (run.joints, set(run.position[:, 0])) == (('grip',), {0.01})

    names = {JOINT_STATES.resolved: '/arm/states', COMMANDS.resolved: '/arm/torque'}
    messages = [[names.get(topic, topic), *rest] for topic, *rest in entries]
    shared = recorded_run.write(tmp_path / 'shared', entries)
    renamed = recorded_run.write(tmp_path / 'renamed', messages)
    mapped, tables = ['--map', 'joint_states=/arm/states', '--map', 'commands=/arm/torque'], []
    for bag, words in ((ours, []), (shared, []), (renamed, mapped)):
        out = tmp_path / f'{bag.name}.csv'
        for command in (
            ['replay', str(bag)],
            ['export', str(bag), '--out', str(out)],
            ['report', str(bag), '--out', str(tmp_path / f'{bag.name}.html')],
        ):
            assert main([*command, *words]) == 0, capsys.readouterr().err
        tables.append(list(csv.reader(out.open())))
    assert tables[0] == tables[1] == tables[2]
    assert '/arm/torque: 1002 values bit-equal' in capsys.readouterr().out
    # Without the mapping, the joint states are not found.
    assert main(['plot', str(renamed), '--out', str(tmp_path / 'none')]) == 1
