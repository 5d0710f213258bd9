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
COMMANDS = ('replay', 'report', 'export', 'plot')


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    return recorded_run.record(tmp_path_factory.mktemp('recorded') / 'bag', 0.3)


@pytest.fixture
def copy(bag, tmp_path):
    """A copy of the bag that a test may damage."""
    return shutil.copytree(bag, tmp_path / 'copy')


def run(command, bag, folder):
    """Run a command on a bag and return its exit code."""
    options = {
        'report': ['--out', str(folder / 'page.html')],
        'export': ['--out', str(folder / 'table.csv')],
        'plot': ['--out', str(folder / 'plots')],
    }
    return main([command, str(bag), *options.get(command, [])])


@pytest.fixture
def all_say(tmp_path, capsys):
    """Asserts that commands fail with one error that contains these words."""

    def check(bag, *words, but=()):
        for command in sorted({*COMMANDS} - {*but}):
            assert run(command, bag, tmp_path) == 1, command
            out, error = capsys.readouterr()
            assert error.startswith(f'blf_dsc {command}: '), command
            assert [word for word in words if word not in error] == [], (command, error)
            assert out == ''

    return check


@pytest.fixture
def recovered(tmp_path, capsys):
    """Recovers a bag; returns the exit code, the output and the clean bag."""

    def recover(bag):
        code = main(['recover', str(bag), '--out', str(tmp_path / 'clean')])
        return code, ''.join(capsys.readouterr()), tmp_path / 'clean'

    return recover


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


OTHER = ("'joint1' is not in the message, which names", 'another robot', '--map joint1=ITS_NAME')


@pytest.mark.parametrize(
    ('change', 'words'),
    [
        (without_states, ("whose name ends in 'joint_states' of type", 'commands (std_msgs/msg')),
        (of_type_string, ('of type sensor_msgs/msg/JointState', '(std_msgs/msg/String)')),
        (with_joints('wheel', 'arm'), OTHER),
        (with_joints('base', 'shoulder', 'elbow'), OTHER),
        (lambda _: [], ('is empty: it holds no message',)),
    ],
)
def test_bag_of_other_content(bag, tmp_path, all_say, change, words):
    entries = recorded_run.messages(bag)
    all_say(recorded_run.write(tmp_path / 'changed', change(entries)), *words)


def test_joint_states_without_joint_names(tmp_path, all_say):
    raw = JointStateEncoder(()).encode(1, [], [], [])
    nameless = [['/joint_states', JOINT_STATE, k, raw] for k in range(9)]
    path = recorded_run.write(tmp_path / 'bag', nameless)
    all_say(path, 'it names no joint', but=('replay',))


@pytest.mark.parametrize('schema', [('', b''), ('ros2msg', b'{{ no definition'), None])
def test_missing_definition_of_another_topic_loses_no_other_message(
    bag, tmp_path, capsys, recovered, schema
):
    file = write_mcap(
        tmp_path / 'bag',
        [ODD, *recorded_run.messages(bag)],
        lambda name: schema if name == ODD[1] else ('ros2msg', definition(name)[0].encode()),
    )
    for command in COMMANDS[1:]:
        assert run(command, file, tmp_path) == 0, capsys.readouterr().err
    code, output, clean = recovered(file)
    assert code == 0
    with Reader(clean) as reader:
        found = {c.topic: c.msgcount for c in reader.connections}
    assert found['/joint_states'] == 301
    assert found.get('/odd') == (None if schema is None else 1)
    lost = 'LOST bag_0.mcap: 1 messages of topics whose name or type is unknown'
    assert (lost in output) == (schema is None)  # not even the type's name is known


def test_types_of_this_package_need_no_definition(bag, tmp_path, recovered):
    file = write_mcap(tmp_path / 'bag', recorded_run.messages(bag), lambda _: ('', b''))
    for each in (file, recovered(file)[2]):
        assert run('replay', each, tmp_path) == 0


def test_topics_of_unknown_type(bag, tmp_path, all_say, recovered):
    entries = recorded_run.messages(bag)
    file = write_mcap(tmp_path / 'bag', entries, lambda _: None)
    all_say(file, '/joint_states (of unknown type)')
    code, output, _ = recovered(file)
    assert code == 1
    assert f'LOST bag_0.mcap: {len(entries)} messages of topics whose name or type' in output


def test_metadata_that_lists_missing_messages(bag, copy, all_say, tmp_path):
    kept = without_states(recorded_run.messages(bag))
    shutil.copy(recorded_run.write(tmp_path / 'bag', kept) / 'bag_0.mcap', copy)
    all_say(copy, 'it holds 0 messages of /joint_states, but counts 301')


def test_bag_folder_without_its_mcap_file_or_above_it(copy, all_say, recovered):
    all_say(copy.parent, f'did you mean {copy}?')
    (copy / 'bag_0.mcap').unlink()
    all_say(copy, f'{copy} cannot be read as a bag', 'bag_0.mcap')
    code, output, _ = recovered(copy)
    assert code == 1
    assert 'there is no MCAP file to recover' in output


@pytest.mark.parametrize(
    ('original', 'replacement', 'words'),
    [
        ('version: 9', 'version: 99', 'Rosbag2 version 99 not supported'),
        ('identifier: mcap', 'identifier: tape', "Storage plugin 'tape' not supported"),
        ('rosbag2_bagfile_information', 'other', 'metadata key is missing'),
    ],
)
def test_bag_of_another_format(copy, all_say, recovered, original, replacement, words):
    metadata = copy / 'metadata.yaml'
    assert original in metadata.read_text()
    metadata.write_text(metadata.read_text().replace(original, replacement))
    all_say(copy, words, f'to save the undamaged part: blf_dsc recover {copy}')
    code, output, _ = recovered(copy)
    assert code == 0
    assert 'none of the recorded messages was lost' in output
