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
from blf_dsc_controller.messages.codecs import JointStateEncoder
from blf_dsc_controller.messages.topics import JOINT_STATE, JOINT_STATES
from blf_dsc_controller.messages.types import definition

pytestmark = pytest.mark.usefixtures('blank_pictures')

pytest.importorskip('plotly', reason='needs plotly: pip install blf_dsc_controller[report]')

ODD = 'my_msgs/msg/Odd'  # of a package that does not exist
ODD_MESSAGE = ['/odd', ODD, 5, b'\0\1\0\0\7\0\0\0']
METADATA = 'metadata.yaml'


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    return recorded_run.record(tmp_path_factory.mktemp('recorded') / 'bag', 0.3)


@pytest.fixture(scope='module')
def entries(bag):
    return recorded_run.messages(bag)


@pytest.fixture
def copy(bag, tmp_path):
    """A copy of the bag that a test may damage."""
    return shutil.copytree(bag, tmp_path / 'copy')


@pytest.fixture
def rewritten(tmp_path):
    """Writes a bag of other messages."""
    return lambda entries: recorded_run.write(tmp_path / 'changed', entries)


@pytest.fixture
def readers(tmp_path):
    """Every way to read a bag, by command."""
    return {
        'replay': lambda bag: main(['replay', str(bag)]),
        'replay --config': lambda bag: main(['replay', str(bag), '--config', 'recommended']),
        'report': lambda bag: main(['report', str(bag), '--out', str(tmp_path / 'page.html')]),
        'export': lambda bag: main(['export', str(bag), '--out', str(tmp_path / 'table.csv')]),
        'plot': lambda bag: main(['plot', str(bag), '--out', str(tmp_path / 'plots')]),
    }


@pytest.fixture
def all_say(readers, capsys):
    """Asserts that every command fails with an error that contains these words."""

    def check(bag, *words):
        for name, command in readers.items():
            assert command(bag) == 1, name
            out, error = capsys.readouterr()
            assert error.startswith(f'blf_dsc {name.split()[0]}: '), name
            for word in words:
                assert word in error, name
            assert out == ''

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


def test_bag_without_joint_states_is_rejected(entries, rewritten, all_say):
    others = [entry for entry in entries if entry[0] != JOINT_STATES.resolved]
    present = '/blf_dsc_controller/commands (std_msgs/msg/Float64MultiArray)'
    all_say(rewritten(others), "no topic whose name ends in 'joint_states' of type", present)


def test_topic_of_wrong_type_is_rejected(entries, rewritten, all_say):
    states = [(*entry[:1], 'std_msgs/msg/String', *entry[2:]) for entry in entries]
    all_say(rewritten(states), 'of type sensor_msgs/msg/JointState', '(std_msgs/msg/String)')


@pytest.mark.parametrize('schema', [('', b''), ('ros2msg', b'{{ no definition'), None])
def test_missing_definition_of_another_topic_loses_no_other_message(
    entries, readers, tmp_path, capsys, schema
):
    file = write_mcap(
        tmp_path / 'bag',
        [ODD_MESSAGE, *entries],
        lambda type_name: (
            schema if type_name == ODD else ('ros2msg', definition(type_name)[0].encode())
        ),
    )
    for name in ('replay --config', 'report', 'export', 'plot'):
        assert readers[name](file) == 0, capsys.readouterr().err
    assert main(['recover', str(file), '--out', str(tmp_path / 'clean')]) == 0
    output = capsys.readouterr().out
    with Reader(tmp_path / 'clean') as reader:
        found = {c.topic: c.msgcount for c in reader.connections}
    assert found['/joint_states'] == 301
    if schema is None:  # not even the type's name is known
        assert 'LOST bag_0.mcap: 1 messages of topics whose name or type is unknown' in output
    else:
        assert found['/odd'] == 1


def test_types_of_this_package_need_no_definition(entries, readers, tmp_path, capsys):
    file = write_mcap(tmp_path / 'bag', entries, lambda _: ('', b''))
    assert readers['replay --config'](file) == 0
    assert main(['recover', str(file), '--out', str(tmp_path / 'clean')]) == 0
    capsys.readouterr()
    with Reader(tmp_path / 'clean') as reader:
        text = {c.msgtype: c.msgdef.data for c in reader.connections}
    assert 'float64[] position' in text[JOINT_STATE]


def test_topics_of_unknown_type(entries, tmp_path, all_say, capsys):
    file = write_mcap(tmp_path / 'bag', entries, lambda _: None)
    all_say(file, '/joint_states (of unknown type)')
    assert main(['recover', str(file), '--out', str(tmp_path / 'clean')]) == 1
    output = capsys.readouterr().out
    lost = [int(line.split()[2]) for line in output.splitlines() if 'name or type' in line]
    assert sum(lost) == len(entries)


def test_empty_bag(rewritten, all_say, tmp_path, capsys):
    path = rewritten([])
    all_say(path, f'{path} is empty: it holds no message')
    assert main(['recover', str(path), '--out', str(tmp_path / 'clean')]) == 0
    assert 'none of the recorded messages was lost' in capsys.readouterr().out


def test_metadata_that_lists_missing_messages(copy, entries, all_say, tmp_path):
    others = [entry for entry in entries if entry[0] != JOINT_STATES.resolved]
    other = recorded_run.write(tmp_path / 'bag', others)
    shutil.copy(other / 'bag_0.mcap', copy)
    all_say(copy, 'it holds 0 messages of /joint_states, but counts 301')


def test_bag_folder_without_its_mcap_file(copy, all_say, tmp_path, capsys):
    (copy / 'bag_0.mcap').unlink()
    all_say(copy, f'{copy} cannot be read as a bag', 'bag_0.mcap')
    assert main(['recover', str(copy), '--out', str(tmp_path / 'clean')]) == 1
    assert 'there is no MCAP file to recover' in capsys.readouterr().err


@pytest.mark.parametrize('joints', [('wheel', 'arm'), ('base', 'shoulder', 'elbow')])
def test_bag_of_another_robot(entries, rewritten, all_say, joints):
    encoder = JointStateEncoder(joints)
    zero = [0.0] * len(joints)
    changed = [
        [*entry[:3], encoder.encode(entry[2], zero, zero, zero)]
        if entry[0] == JOINT_STATES.resolved
        else entry
        for entry in entries
    ]
    all_say(
        rewritten(changed),
        f"'joint1' is not in the message, which names {', '.join(joints)}",
        'another robot',
        '--map joint1=ITS_NAME',
    )


def test_joint_states_without_joint_names(readers, tmp_path, capsys):
    nameless = JointStateEncoder(())
    path = recorded_run.write(
        tmp_path / 'bag',
        [['/joint_states', JOINT_STATE, k, nameless.encode(k, [], [], [])] for k in range(9)],
    )
    for name in ('report', 'export', 'plot'):
        assert readers[name](path) == 1
        assert 'it names no joint' in capsys.readouterr().err


@pytest.mark.parametrize(
    ('original', 'replacement', 'words'),
    [
        ('version: 9', 'version: 99', 'Rosbag2 version 99 not supported'),
        ('identifier: mcap', 'identifier: tape', "Storage plugin 'tape' not supported"),
        ('rosbag2_bagfile_information', 'other', 'metadata key is missing'),
    ],
)
def test_bag_of_another_format(copy, all_say, original, replacement, words, tmp_path, capsys):
    text = (copy / METADATA).read_text()
    assert original in text
    (copy / METADATA).write_text(text.replace(original, replacement))
    all_say(copy, words, f'to save the undamaged part: blf_dsc recover {copy}')
    assert main(['recover', str(copy), '--out', str(tmp_path / 'clean')]) == 0
    assert 'none of the recorded messages was lost' in capsys.readouterr().out


def test_folder_of_a_run_suggests_the_bag_in_it(copy, capsys):
    assert main(['replay', str(copy.parent)]) == 1
    assert f'did you mean {copy}?' in capsys.readouterr().err
