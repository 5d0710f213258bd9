# SPDX-License-Identifier: Apache-2.0
"""Bags of other software: other topics, joints and orders, shared topics, other formats.

Unusable ones, and malicious files of all kinds, give one clear error line from every
command.
"""

from __future__ import annotations

import csv
import os
import shutil
from itertools import pairwise

import numpy as np
import pytest
import recorded_run
from mcap.opcode import Opcode
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from recorded_run import Synthetic, raw_records
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import (
    CompressionFormat,
    CompressionMode,
    Reader,
    StoragePlugin,
    Writer,
)
from rosbags.typesys import Stores, get_typestore

from blf_dsc_controller import BlfDscError, load_loop, read_run, share_folder
from blf_dsc_controller.bags.content import NameMap
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.configuration.robot import Robot
from blf_dsc_controller.messages.codecs import (
    Float64MultiArrayEncoder,
    JointStateEncoder,
    definition,
    typestore,
)
from blf_dsc_controller.messages.topics import (
    COMMANDS,
    FLOAT64_MULTI_ARRAY,
    JOINT_STATE,
    JOINT_STATES,
)

pytestmark = pytest.mark.usefixtures('blank_pictures')

pytest.importorskip('plotly', reason='needs plotly: pip install .[report]')

SHUFFLED = ('gripper', 'elbow_pitch', 'base', 'shoulder_pitch')
MAP = {
    'joint_states': '/arm/states',
    'commands': '/arm/torque',
    'joint1': 'shoulder_pitch',
    'joint2': 'elbow_pitch',
}
ARM = Synthetic(100)


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    return recorded_run.record(tmp_path_factory.mktemp('recorded') / 'bag', 0.3)


def names_of(**changes):
    return NameMap.parse(
        f'{our}={their}' for our, their in {**MAP, **changes}.items() if their
    )


def spread(values):
    """Place two values among those of the four joints of SHUFFLED."""
    return [77.0, values[1], -5.0, values[0]]


def foreign(torque='array', fields=('position', 'velocity', 'effort')):
    """Topic, type, time and bytes of each message as another robot's software writes it."""
    states = JointStateEncoder(SHUFFLED, fields)
    for k, stamp in enumerate(ARM.stamp.tolist()):
        known = [
            spread(field[k]) for field in (ARM.position, ARM.error, ARM.disturbance)
        ]
        yield (
            '/arm/states',
            JOINT_STATE,
            stamp,
            states.encode(stamp, *known[: len(fields)]),
        )
        command = ARM.torque[k]
        sent = {'array': spread(command), 'pair': command, 'three': [1, 2, 3]}.get(
            torque
        )
        if sent is not None:
            raw = Float64MultiArrayEncoder(len(sent)).encode(sent)
            yield '/arm/torque', FLOAT64_MULTI_ARRAY, stamp + 9, raw
        if torque == 'state':
            raw = states.encode(stamp, [0] * 4, [0] * 4, spread(command))
            yield '/arm/torque', JOINT_STATE, stamp + 9, raw


def write(
    path,
    messages,
    storage=StoragePlugin.MCAP,
    version=9,
    compression=CompressionMode.NONE,
):
    """Write a bag of rosbag2, or of ROS 1 (version 1)."""
    if version == 1:
        writer = Writer1(path)
        store = get_typestore(Stores.ROS1_NOETIC)
    else:
        writer = Writer(path, version=version, storage_plugin=storage)
        store = typestore()
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for topic, type_name, at, raw in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(
                    topic, type_name, typestore=store
                )
            if version == 1:
                raw = typestore().cdr_to_ros1(raw, type_name)  # noqa: PLW2901
            writer.write(connections[topic], at, raw)
    return path


MCAP = StoragePlugin.MCAP
SQLITE3 = StoragePlugin.SQLITE3


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
    path = tmp_path / ('run.bag' if version == 1 else 'bag')
    write(path, foreign(torque), storage, 8 if version == 5 else version, compression)
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


def test_wrong_names_are_reported_with_the_names_in_the_bag(bag, tmp_path):
    path = write(tmp_path / 'bag', foreign())
    swapped = {'joint_states': '/arm/torque', 'commands': '/arm/states'}
    for each, changes, message in (
        (path, {'joint_states': '/arm/state'}, r"'/arm/state' of type sensor_msgs"),
        (path, swapped, r'/arm/torque \(std_msgs'),
        (path, {'joint1': 'x'}, r'--map joint1=x: .* no x, but base, elbow'),
        (bag, {**dict.fromkeys(MAP), 'joint3': 'base'}, 'nor one of the joints'),
        (bag, {**dict.fromkeys(MAP), 'joint1': 'joint2'}, 'map joint2, too; expected'),
    ):
        with pytest.raises(BlfDscError, match=message):
            read_run(each, names=names_of(**changes))
    for entries, words in (
        *((([entry],), 'one side is missing') for entry in ('joint1', '=x', 'joint1=')),
        ((['joint1=a', 'joint2=a'],), 'given twice'),
        ((['joint1=a', 'joint1=b'],), 'given twice'),
    ):
        with pytest.raises(BlfDscError, match=words):
            NameMap.parse(*entries)


def test_gripper_on_the_same_topic_is_told_from_the_arm_under_any_name(
    bag, tmp_path, capsys
):
    fingers = JointStateEncoder(('left_finger',))
    entries = []
    for k, entry in enumerate(recorded_run.messages(bag)):
        if entry[0] == JOINT_STATES.resolved and k % 7 == 0:  # of some states only
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
    mapped = ['--map', 'joint_states=/arm/states', '--map', 'commands=/arm/torque']
    tables = []
    for each, words in ((bag, []), (shared, []), (renamed, mapped)):
        out = tmp_path / f'{each.name}.csv'
        for command in (
            ['replay', str(each)],
            ['export', str(each), '--out', str(out)],
            ['report', str(each), '--out', str(tmp_path / f'{each.name}.html')],
        ):
            assert main([*command, *words]) == 0, capsys.readouterr().err
        tables.append(list(csv.reader(out.open())))
    assert tables[0] == tables[1] == tables[2]
    assert '/arm/torque: 604 values bit-equal' in capsys.readouterr().out
    # Without the mapping, the joint states are not found.
    assert main(['export', str(renamed), '--out', str(tmp_path / 'none.csv')]) == 1


# Unusable bags.

# of a package that does not exist
ODD = ['/odd', 'my_msgs/msg/Odd', 5, b'\0\1\0\0\7\0\0\0']
TOOLS = {
    'replay': (),
    'report': ('--out', 'page.html'),
    'export': ('--out', 'table.csv'),
    'identify': ('--urdf', 'two_link.urdf', '--out', 'new.urdf'),
}


@pytest.fixture
def entries(bag):
    return recorded_run.messages(bag)


@pytest.fixture
def copy(bag, tmp_path):
    """A copy of the bag that a test may damage."""
    return shutil.copytree(bag, tmp_path / 'copy')


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Runs a command on a bag; returns its exit code, output and errors."""
    monkeypatch.chdir(tmp_path)

    def call(command, bag, *words):
        code = main([command, str(bag), *(words or TOOLS[command])])
        return code, *capsys.readouterr()

    return call


@pytest.fixture
def all_say(run):
    """Asserts that all commands fail with one error that contains these words."""

    def check(bag, *words, but=()):
        for command in sorted({*TOOLS} - {*but}):
            code, out, error = run(command, bag)
            assert (code, out) == (1, ''), command
            assert error.startswith(f'blf_dsc {command}: '), error
            assert [word for word in words if word not in error] == [], error

    return check


def defined(type_name):
    return 'ros2msg', definition(type_name)[0].encode()


def write_mcap(folder, entries, schema=defined, compression='zstd'):
    """Write one MCAP file.

    `schema` returns encoding and text of a type, or None for no schema.
    """
    folder.mkdir()
    with (folder / 'bag_0.mcap').open('wb') as stream:
        writer = McapWriter(stream, compression=CompressionType[compression.upper()])
        writer.start('ros2', 'another')
        channels = {}
        for topic, type_name, at, raw in entries:
            if topic not in channels:
                found = schema(type_name)
                number = (
                    0 if found is None else writer.register_schema(type_name, *found)
                )
                channels[topic] = writer.register_channel(topic, 'cdr', number)
            writer.add_message(channels[topic], at, raw, at)
        writer.finish()
    return folder / 'bag_0.mcap'


def without_states(entries):
    return [entry for entry in entries if entry[0] != '/joint_states']


def of_type_string(entries):
    return [(entry[0], 'std_msgs/msg/String', *entry[2:]) for entry in entries]


def with_joints(*joints):
    """Replace the joint states by those of another robot."""
    encoder = JointStateEncoder(joints)
    zeros = [[0.0] * len(joints)] * 3
    return lambda entries: [
        [*entry[:3], encoder.encode(entry[2], *zeros)]
        if entry[0] == '/joint_states'
        else entry
        for entry in entries
    ]


def unnamed(_):
    raw = JointStateEncoder(()).encode(1, [], [], [])
    return [['/joint_states', JOINT_STATE, k, raw] for k in range(9)]


OTHER = (
    "'joint1' is not in the message, which names",
    'another robot',
    '--map joint1=ITS_NAME',
)


@pytest.mark.parametrize(
    ('change', 'words', 'but'),
    [
        (
            without_states,
            ("name ends in 'joint_states' of type", 'commands (std_msgs/msg'),
            (),
        ),
        (
            of_type_string,
            ('of type sensor_msgs/msg/JointState', '(std_msgs/msg/String)'),
            (),
        ),
        (with_joints('wheel', 'arm'), OTHER, ('identify',)),
        (with_joints('base', 'shoulder', 'elbow'), OTHER, ('identify',)),
        (unnamed, ('it names no joint',), ('replay', 'identify')),
        (lambda _: [], ('is empty: it holds no message',), ()),
    ],
)
def test_bag_of_other_content(entries, tmp_path, all_say, change, words, but):
    all_say(recorded_run.write(tmp_path / 'changed', change(entries)), *words, but=but)


@pytest.mark.parametrize('schema', [('', b''), ('ros2msg', b'{{ no definition'), None])
def test_missing_definition_of_another_topic_loses_no_other_message(
    entries, tmp_path, run, schema
):
    file = write_mcap(
        tmp_path / 'bag',
        [ODD, *entries],
        lambda name: schema if name == ODD[1] else defined(name),
    )
    for command in ('replay', 'report', 'export'):
        assert run(command, file)[0] == 0
    code, output, _ = run('recover', file, '--out', 'clean')
    assert code == 0
    with Reader(tmp_path / 'clean') as reader:
        found = {c.topic: c.msgcount for c in reader.connections}
    assert found['/joint_states'] == 301
    assert found.get('/odd') == (None if schema is None else 1)
    lost = 'LOST bag_0.mcap: 1 messages of topics whose name or type is unknown'
    assert (lost in output) == (schema is None)  # not even the type's name is known


def test_files_that_are_missing_or_hold_other_numbers_than_stated(
    entries, copy, all_say
):
    all_say(copy.parent, f'did you mean {copy}?')
    others = without_states(entries)
    for changed, count in ((others, 0), (entries + entries, 602)):
        written = recorded_run.write(copy.parent / f'{count}', changed)
        shutil.copy(written / f'{count}_0.mcap', copy / 'bag_0.mcap')
        all_say(copy, f'it holds {count} messages of /joint_states, but counts 301')
    (copy / 'bag_0.mcap').unlink()
    all_say(
        copy,
        f'{copy} cannot be read as a bag: its metadata.yaml names bag_0.mcap, which the folder '
        'lacks: copy it there\n',
    )
    (copy / 'bag_1.mcap').touch()
    all_say(copy, f'to save what its other files hold: blf_dsc recover {copy}')


@pytest.mark.parametrize(
    ('original', 'replacement', 'words'),
    [
        ('version: 9', 'version: 99', 'Rosbag2 version 99 not supported'),
        ('identifier: mcap', 'identifier: tape', "Storage plugin 'tape' not supported"),
        ('rosbag2_bagfile_information', 'other', 'metadata key is missing'),
        ('', '', 'the folder has no metadata.yaml, as after an interrupted recording'),
    ],
)
def test_bag_of_another_format_or_without_metadata(
    copy, all_say, run, original, replacement, words
):
    metadata = copy / 'metadata.yaml'
    text = metadata.read_text()
    metadata.unlink()
    if original:
        metadata.write_text(text.replace(original, replacement))
    all_say(copy, words, f'to save the undamaged part: blf_dsc recover {copy}')
    code, output, _ = run('recover', copy, '--out', 'clean')
    assert (code, 'none of the recorded messages was lost' in output) == (0, True)


@pytest.mark.parametrize('declared', [1 << 27 | 1, 1 << 62])
def test_chunk_that_declares_too_large_a_size_is_not_unpacked(copy, all_say, declared):
    file = copy / 'bag_0.mcap'
    data = file.read_bytes()
    (chunk, _), *_ = (
        (at, raw) for at, raw in raw_records(data) if raw[0] == Opcode.CHUNK
    )
    size = chunk + 9 + 16  # after its times
    file.write_bytes(data[:size] + declared.to_bytes(8, 'little') + data[size + 8 :])
    all_say(file, f'a chunk would unpack to {declared} bytes')


@pytest.mark.parametrize('compression', ['zstd', 'lz4'])
def test_compressed_chunk_that_is_cut_off_is_an_error_and_a_loss(
    entries, tmp_path, all_say, run, compression
):
    """What is left of it unpacks to its beginning; nothing else shows that it is not whole."""
    file = write_mcap(tmp_path / 'bag', entries, compression=compression)
    data = file.read_bytes()
    at, raw = next(each for each in raw_records(data) if each[1][0] == Opcode.CHUNK)
    head = 9 + 24 + 4 + 4 + len(compression)  # its times, sizes and name
    packed = raw[head + 8 : -9]
    body = raw[9:33] + bytes(4) + raw[37:head]  # without a checksum
    body += len(packed).to_bytes(8, 'little') + packed
    cut = raw[:1] + len(body).to_bytes(8, 'little') + body
    private = bytes([0x80, *bytes(8)])  # a record without content, so that offsets stay
    file.write_bytes(data[:at] + cut + private + data[at + len(raw) :])
    all_say(file, 'cut off')
    _, output, _ = run('recover', file, '--out', 'clean')
    assert 'LOST' in output


@pytest.mark.parametrize('inside', [False, True])
def test_named_pipe_is_no_bag(tmp_path, all_say, run, inside):
    folder = tmp_path / 'pipes'
    folder.mkdir()
    os.mkfifo(folder / 'bag_0.mcap')
    path = folder if inside else folder / 'bag_0.mcap'
    all_say(path, f'{folder / "bag_0.mcap"} is not a regular file')
    code, _, error = run('recover', path, '--out', 'clean')
    assert (code, 'is not a regular file' in error) == (1, True)


# Malicious files.

BOMB = '- &a [x, x]\n' + ''.join(
    f'- &{b} [*{a}, *{a}]\n' for a, b in pairwise('abcdefghi')
)


def test_named_pipe_is_rejected_as_parameter_file_and_urdf(tmp_path, capsys):
    os.mkfifo(tmp_path / 'pipe')
    assert main(['run', '--offline', '--config', str(tmp_path / 'pipe')]) == 1
    with pytest.raises(BlfDscError, match='is not a regular file'):
        _ = Robot(urdf=str(tmp_path / 'pipe')).text
    capsys.readouterr()


@pytest.mark.parametrize(
    ('text', 'words'),
    [
        ('[' * 100_000, 'nested more than 50 levels'),
        ('a:\n' + '- 1\n' * 100_000, 'more than 50000 entries: leave out'),
        (BOMB, 'does not support the alias'),
    ],
)
def test_unreasonable_yaml_is_rejected(tmp_path, text, words):
    path = tmp_path / 'given.yaml'
    path.write_text(text)
    with pytest.raises(BlfDscError, match=words):
        load_loop(path)


ROBOT = '<robot name="x">'
NUMBERS = r'of at most 1e\+06 in magnitude'


@pytest.mark.parametrize(
    ('change', 'words'),
    [
        (lambda _: '<!DOCTYPE r [<!ENTITY a "x">]>', 'DOCTYPE'),
        (lambda _: ROBOT + '<link name="a"/>' * 100_000 + '</robot>', 'at most 500'),
        (
            lambda _: ROBOT + '<a>' * 10**5 + '</a>' * 10**5 + '</robot>',
            'the links are none',
        ),
        (lambda text: text.replace(' izz="', ' izz="1e308" was="'), NUMBERS),
        (lambda text: text.replace(' xyz="', ' xyz="1e200 0 0" was="'), NUMBERS),
    ],
    ids=['entities', 'large', 'deep', 'inertia', 'place'],
)
def test_unreasonable_urdf_is_rejected(change, words):
    text = (share_folder() / 'config' / 'ur5e.urdf').read_text()
    with pytest.raises(BlfDscError, match=words):
        Robot(urdf=change(text), tip='tool0').chain(())


# Output files.


def test_nothing_is_overwritten_without_force(bag, tmp_path, capsys):
    for name, *words in (
        ('out', 'report', bag, '--out', tmp_path / 'out'),
        ('out.csv', 'export', bag, '--out', tmp_path / 'out.csv'),
        ('tracking.png', 'report', bag, '--png', tmp_path),
        (
            *('new.urdf', 'identify', bag, '--urdf', 'panda.urdf'),
            *('--out', tmp_path / 'new.urdf'),
        ),
        ('out.yaml', 'excite', tmp_path / 'out.yaml', '--config', 'panda'),
    ):
        out = tmp_path / name
        kept = tmp_path / 'kept'
        command = [str(word) for word in words]
        kept.write_text('kept')
        out.symlink_to(kept)
        assert main(command) == 1
        assert f'{out} exists already' in capsys.readouterr().err
        if command[0] in ('report', 'export'):
            assert main([*command, '--force']) == 0
            assert not out.is_symlink()
            assert main([*command, '--force']) == 0
        assert kept.read_text() == 'kept'
        out.unlink()
