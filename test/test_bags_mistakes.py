# SPDX-License-Identifier: Apache-2.0
"""Unusable bags give one clear error line from every command, and no traceback.

A wrong topic, a missing type definition, an empty bag, the bag of another robot, another version.
"""

from __future__ import annotations

import shutil

import pytest
import recorded_run
from mcap.writer import Writer
from rosbags.rosbag2 import Reader

from blf_dsc_controller.cli.main import main
from blf_dsc_controller.messages.codecs import JointStateEncoder, definition
from blf_dsc_controller.messages.topics import JOINT_STATE

pytestmark = pytest.mark.usefixtures('blank_pictures')

pytest.importorskip('plotly', reason='needs plotly: pip install blf_dsc_controller[report]')

ODD = ['/odd', 'my_msgs/msg/Odd', 5, b'\0\1\0\0\7\0\0\0']  # of a package that does not exist
COMMANDS = {
    'replay': (),
    'report': ('--out', 'page.html'),
    'export': ('--out', 'table.csv'),
    'plot': ('--out', 'plots'),
    'identify': ('--urdf', 'two_link.urdf', '--out', 'new.urdf'),
}


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    return recorded_run.record(tmp_path_factory.mktemp('recorded') / 'bag', 0.3)


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
        code = main([command, str(bag), *(words or COMMANDS[command])])
        return code, *capsys.readouterr()

    return call


@pytest.fixture
def all_say(run):
    """Asserts that all commands fail with one error that contains these words."""

    def check(bag, *words, but=()):
        for command in sorted({*COMMANDS} - {*but}):
            code, out, error = run(command, bag)
            assert (code, out) == (1, ''), command
            assert error.startswith(f'blf_dsc {command}: '), error
            assert [word for word in words if word not in error] == [], error

    return check


def write_mcap(folder, entries, schema):
    """Write one MCAP file; `schema` returns encoding and text of a type, or None for no schema."""
    folder.mkdir()
    with (folder / 'bag_0.mcap').open('wb') as stream:
        writer = Writer(stream)
        writer.start('ros2', 'another')
        channels = {}
        for topic, type_name, at, raw in entries:
            if topic not in channels:
                found = schema(type_name)
                number = 0 if found is None else writer.register_schema(type_name, *found)
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
    encoder, zeros = JointStateEncoder(joints), [[0.0] * len(joints)] * 3
    return lambda entries: [
        [*entry[:3], encoder.encode(entry[2], *zeros)] if entry[0] == '/joint_states' else entry
        for entry in entries
    ]


def unnamed(_):
    raw = JointStateEncoder(()).encode(1, [], [], [])
    return [['/joint_states', JOINT_STATE, k, raw] for k in range(9)]


OTHER = ("'joint1' is not in the message, which names", 'another robot', '--map joint1=ITS_NAME')


@pytest.mark.parametrize(
    ('change', 'words', 'but'),
    [
        (without_states, ("name ends in 'joint_states' of type", 'commands (std_msgs/msg'), ()),
        (of_type_string, ('of type sensor_msgs/msg/JointState', '(std_msgs/msg/String)'), ()),
        (with_joints('wheel', 'arm'), OTHER, ('identify',)),
        (with_joints('base', 'shoulder', 'elbow'), OTHER, ('identify',)),
        (unnamed, ('it names no joint',), ('replay', 'identify')),
        (lambda _: [], ('is empty: it holds no message',), ()),
    ],
)
def test_bag_of_other_content(entries, tmp_path, all_say, change, words, but):
    all_say(recorded_run.write(tmp_path / 'changed', change(entries)), *words, but=but)


@pytest.mark.parametrize('schema', [('', b''), ('ros2msg', b'{{ no definition'), None])
def test_missing_definition_of_another_topic_loses_no_other_message(entries, tmp_path, run, schema):
    file = write_mcap(
        tmp_path / 'bag',
        [ODD, *entries],
        lambda name: schema if name == ODD[1] else ('ros2msg', definition(name)[0].encode()),
    )
    for command in ('replay', 'report', 'export', 'plot'):
        assert run(command, file)[0] == 0
    code, output, _ = run('recover', file, '--out', 'clean')
    assert code == 0
    with Reader(tmp_path / 'clean') as reader:
        found = {c.topic: c.msgcount for c in reader.connections}
    assert found['/joint_states'] == 301
    assert found.get('/odd') == (None if schema is None else 1)
    lost = 'LOST bag_0.mcap: 1 messages of topics whose name or type is unknown'
    assert (lost in output) == (schema is None)  # not even the type's name is known


def test_types_of_this_package_need_a_name_but_no_definition(entries, tmp_path, run, all_say):
    file = write_mcap(tmp_path / 'bag', entries, lambda _: ('', b''))
    assert run('recover', file, '--out', 'clean')[0] == 0
    for each in (file, tmp_path / 'clean'):
        assert run('replay', each)[0] == 0
    file = write_mcap(tmp_path / 'unnamed', entries, lambda _: None)
    all_say(file, '/joint_states (of unknown type)')
    code, output, _ = run('recover', file, '--out', 'none')
    lost = f'LOST bag_0.mcap: {len(entries)} messages of topics whose name or type'
    assert (code, lost in output) == (1, True)


def test_files_that_are_missing_or_hold_less_than_the_metadata_say(entries, copy, run, all_say):
    all_say(copy.parent, f'did you mean {copy}?')
    written = recorded_run.write(copy.parent / 'bag', without_states(entries))
    shutil.copy(written / 'bag_0.mcap', copy)
    all_say(copy, 'it holds 0 messages of /joint_states, but counts 301')
    (copy / 'bag_0.mcap').unlink()
    all_say(copy, f'{copy} cannot be read as a bag', 'bag_0.mcap')
    code, _, error = run('recover', copy, '--out', 'clean')
    assert (code, 'there is no MCAP file to recover' in error) == (1, True)


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


@pytest.mark.parametrize('declared', [1 << 29 | 1, 1 << 62])
def test_chunk_that_declares_too_large_a_size_is_not_unpacked(copy, all_say, declared):
    file = copy / 'bag_0.mcap'
    data = file.read_bytes()
    size = data.index(b'\x06', 100) + 9 + 16  # of the first chunk, after its times
    file.write_bytes(data[:size] + declared.to_bytes(8, 'little') + data[size + 8 :])
    all_say(file, f'a chunk would unpack to {declared} bytes')
