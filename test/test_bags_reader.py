# SPDX-License-Identifier: Apache-2.0
"""Bags are read back as the arrays they were made of, under any topic names, and as a table."""

from __future__ import annotations

import csv
import re

import numpy as np
import pytest
import recorded_run
import synthetic_bag
from foreign_readers import raw_records
from mcap.opcode import Opcode
from mcap.records import Chunk
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from synthetic_bag import BOUND_RAD, JOINTS, LIMIT_NM, PARAMETERS, TRUE, Synthetic

from blf_dsc_controller.bags.content import NameMap, read_content
from blf_dsc_controller.bags.reader import read_run
from blf_dsc_controller.bags.sources import BagError, BagMessage, DamageError, records_in
from blf_dsc_controller.bags.topic_messages import TopicMessages, UnreadableMessageError
from blf_dsc_controller.bags.writer import BagWriter
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.messages.codecs import JointStateEncoder, typestore
from blf_dsc_controller.messages.journal import EventType, Journal
from blf_dsc_controller.messages.topics import (
    COMMANDS,
    DIAGNOSTICS,
    JOINT_STATES,
    JOURNAL,
    LEARNING,
    REFERENCE,
    TRACKING_ERROR,
)

SAMPLES = 200
JOINT_NAMES = {joint: joint for joint in JOINTS}


@pytest.fixture(scope='module')
def made():
    return Synthetic(SAMPLES)


@pytest.fixture(scope='module')
def messages(made):
    return list(made.messages(with_timing=True))


def without(messages, *topics):
    return [entry for entry in messages if entry[0] not in topics]


def test_arrays_round_trip(tmp_path, made, messages):
    run = read_run(synthetic_bag.write(tmp_path / 'bag', messages))
    assert run.joints == JOINTS
    assert run.stamp.tolist() == made.stamp.tolist()
    np.testing.assert_array_equal(run.position, made.position)  # joints matched by name
    np.testing.assert_array_equal(run.reference, made.reference)
    np.testing.assert_array_equal(run.error, made.error)
    np.testing.assert_array_equal(run.torque, made.torque)
    np.testing.assert_array_equal(run.learning.select(PARAMETERS), made.estimate)
    np.testing.assert_array_equal(run.truth.select(PARAMETERS), np.tile(TRUE, (20, 1)))
    np.testing.assert_array_equal(run.timing.column('late_steps'), np.arange(SAMPLES) // 100)
    assert np.all(run.bound == BOUND_RAD)
    assert np.all(run.torque_limit == LIMIT_NM)
    assert run.duration == pytest.approx(0.199)
    assert run.message_counts['/joint_states'] == SAMPLES
    assert run.message_counts['/sim_plant/truth'] == SAMPLES / 10


@pytest.mark.parametrize(
    'rename',
    [
        lambda topic: '/left/arm' + topic.resolved,
        lambda topic: '/' + topic.leaf,
        lambda topic: f'/another_node/{topic.leaf}',
    ],
)
def test_topics_under_other_names_are_found(tmp_path, made, messages, rename):
    run = read_run(synthetic_bag.write(tmp_path / 'bag', messages, rename))
    np.testing.assert_array_equal(run.error, made.error)
    np.testing.assert_array_equal(run.torque, made.torque)
    assert run.truth is not None
    assert run.bound is not None


def test_journal_tells_which_joint_states_the_controller_used(tmp_path, messages):
    """An FR3 also publishes them at 30 Hz, under the usual name."""
    used, journal = '/franka/joint_states', Journal()
    journal.note(EventType.CONFIGURE, parameters={}, topics={'joint_states': used})
    with BagWriter(tmp_path / 'bag') as bag:
        told = bag.add_topic(JOURNAL.resolved, JOURNAL.type, [])
        handles = [bag.add_topic(name, JOINT_STATES.type, []) for name in ('/joint_states', used)]
        stamp = messages[0][1]
        bag.write(told, journal.pending[0].encode(), stamp)
        states = [entry for entry in messages if entry[0] is JOINT_STATES]
        for number, (_, stamp, raw) in enumerate(states):
            for handle in handles if number % 30 == 0 else handles[1:]:
                bag.write(handle, raw, stamp)
    content = read_content(tmp_path / 'bag')
    assert content.topics[JOINT_STATES].name == used
    assert content.topics[JOINT_STATES].size == len(states)


def test_namespace_selects_one_of_several_robots(tmp_path, messages):
    with synthetic_bag.BagWriter(tmp_path / 'bag') as bag:
        for side, stamps in (('left', 0), ('right', 7)):
            handles = {}
            for topic, stamp, raw in messages[stamps:]:
                if topic not in handles:
                    name = f'/{side}{topic.resolved}'
                    handles[topic] = bag.add_topic(name, topic.type, [topic.offered])
                bag.write(handles[topic], raw, stamp)
    with pytest.raises(BagError, match='/left/joint_states, /right/joint_states'):
        read_run(tmp_path / 'bag')
    assert read_run(tmp_path / 'bag', 'left').stamp.size == SAMPLES
    assert read_run(tmp_path / 'bag', '/right').stamp.size < SAMPLES


def test_only_joint_states_are_required(tmp_path, made, messages):
    states = [entry for entry in messages if entry[0] is JOINT_STATES]
    decoy = (DIAGNOSTICS, 0, b'\0\1\0\0')
    path = synthetic_bag.write(
        tmp_path / 'bag',
        [decoy, *states],
        lambda topic: '/x/learning' if topic is DIAGNOSTICS else topic.resolved,
    )
    run = read_run(path)  # a topic of another type is ignored
    assert run.joints == JOINTS[::-1]
    np.testing.assert_array_equal(run.position, made.position[:, ::-1])
    unknown = (run.reference, run.error, run.bound, run.learning, run.truth, run.timing)
    assert unknown == (None,) * len(unknown)


def test_what_is_missing_is_computed_from_what_is_there(tmp_path, made, messages):
    path = synthetic_bag.write(tmp_path / 'bag', without(messages, TRACKING_ERROR))
    np.testing.assert_allclose(read_run(path).error, made.error, atol=1e-15)

    lost = next(k for k, entry in enumerate(messages) if entry[0] is COMMANDS)
    path = synthetic_bag.write(tmp_path / 'one', messages[:lost] + messages[lost + 1 :])
    np.testing.assert_array_equal(read_run(path).torque, made.torque)

    states = JointStateEncoder(JOINTS)
    with_effort = [
        (JOINT_STATES, k, states.encode(k, [0, 0], [0, 0], [k, -k])) for k in range(SAMPLES)
    ]
    torque = read_run(synthetic_bag.write(tmp_path / 'none', with_effort)).torque
    # The effort in a state is the torque that led to it.
    assert torque[:-1, 0].tolist() == list(range(1, SAMPLES))
    assert np.isnan(torque[-1]).all()


def test_stamps_that_fall_once_begin_another_run(tmp_path, made, messages):
    """A simulator was reset: the longer run is read, and what is left out is counted."""
    later = without(messages, COMMANDS)
    begun = [entry for entry in later if entry[1] < made.stamp[50]]
    kept = [entry for entry in later if not (entry[0] is LEARNING and entry[1] == made.stamp[10])]
    shifted = [(topic, at + 10**9, raw) for topic, at, raw in kept]
    run = read_run(synthetic_bag.write(tmp_path / 'bag', begun + shifted))
    np.testing.assert_array_equal(run.stamp, made.stamp)
    np.testing.assert_array_equal(run.error, made.error)
    assert run.learning.stamp.tolist() == [*made.stamp[:10], *made.stamp[11:]]
    assert run.notes == (
        (
            '50 of 250 joint states left out: their stamps fall 1 times, so that 2 runs are in the '
            'bag; run 2, the longest, is shown'
        ),
    )


@pytest.mark.parametrize('kind', ['backwards', 'interleaved', 'numbered'])
def test_states_of_several_publishers_are_refused(tmp_path, messages, kind):
    states = without(messages, *{entry[0] for entry in messages} - {JOINT_STATES})
    encoder = JointStateEncoder(JOINTS)
    delay = 500_000 if kind == 'numbered' else 400_000  # ns; only numbers show two in even turns
    other = [
        (JOINT_STATES, at + delay, encoder.encode(at + delay, [9, 9], [0, 0], [0, 0]))
        for _, at, _ in states
    ]
    both = [entry for pair in zip(states, other, strict=True) for entry in pair]
    with BagWriter(tmp_path / 'bag') as bag:
        handle = bag.add_topic('/joint_states', JOINT_STATES.type, [])
        for k, (_, at, raw) in enumerate(states[::-1] if kind == 'backwards' else both):
            bag.write(handle, raw, at, sequence=1 + k // 2 if kind == 'numbered' else 0)
    with pytest.raises(BagError, match='several publishers share /joint_states'):
        read_run(tmp_path / 'bag')


def test_repeated_states_and_those_of_other_joints_are_counted(tmp_path, messages):
    gripper = JointStateEncoder(['finger']).encode(5, [0], [0], [0])
    states = without(messages, *{entry[0] for entry in messages} - {JOINT_STATES})
    kept = [states[0], states[0], (JOINT_STATES, states[0][1], gripper), *states[1:]]
    run = read_run(synthetic_bag.write(tmp_path / 'bag', kept), names=NameMap({}, JOINT_NAMES))
    assert run.stamp.size == SAMPLES
    assert run.notes == (
        '1 of 202 joint states left out: they name other joints',
        '1 joint states left out: they repeat the stamp before',
    )


def test_lost_chunk_is_an_error_of_every_reader(tmp_path, messages):
    """Also if the index does not mention it, and if it is in the file twice."""
    path = synthetic_bag.write(tmp_path / 'bag', messages)
    data = (path / 'bag_0.mcap').read_bytes()
    chunk = next(raw for _, raw in raw_records(data) if raw[0] == Opcode.CHUNK)
    start = int.from_bytes(data[-28:-20], 'little')  # of the description, without a checksum
    for times in (0, 2):
        begin = (start + (times - 1) * len(chunk)).to_bytes(8, 'little')
        footer = data[-37:-28] + begin + bytes(12) + data[-8:]
        changed = (data[:-37] + footer).replace(chunk, times * chunk, 1)
        (path / 'bag_0.mcap').write_bytes(changed)
        with pytest.raises(BagError, match=r'messages of .*, but counts'):
            read_run(path)


@pytest.mark.parametrize('storage', [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
@pytest.mark.parametrize(
    'mode', [CompressionMode.NONE, CompressionMode.FILE, CompressionMode.MESSAGE]
)
def test_bags_from_rosbags_writer_are_read(tmp_path, made, messages, storage, mode):
    writer = Writer(tmp_path / 'bag', version=9, storage_plugin=storage)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for topic, stamp, raw in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(
                    topic.resolved, topic.type, typestore=typestore()
                )
            writer.write(connections[topic], stamp, raw)
    run = read_run(tmp_path / 'bag')
    np.testing.assert_array_equal(run.error, made.error)
    np.testing.assert_array_equal(run.torque, made.torque)


def test_broken_bags_are_distinguished(tmp_path, messages):
    path = synthetic_bag.write(tmp_path / 'bag', messages)
    (path / 'bag_0.mcap').write_bytes((path / 'bag_0.mcap').read_bytes()[:-1000])
    for words in ('blf_dsc recover', r'no metadata\.yaml'):
        with pytest.raises(BagError, match=words):
            read_run(path)
        (path / 'metadata.yaml').unlink(missing_ok=True)


def test_any_rows_of_long_topics_of_several_layouts_are_read():
    encoders = [JointStateEncoder(names) for names in (('a', 'b'), ('b', 'a'), ('c',))]
    messages = TopicMessages('/x', JOINT_STATES.type)
    for k in range(3000):
        values = [k] if k % 3 == 2 else [k, -k][:: 1 - k % 3 * 2]
        raw = encoders[k % 3].encode(k, values, values, values)
        messages.add(BagMessage('/x', k + 7, raw, k + 1))
    messages.decode()
    for states, expected in (
        (messages.joint_states(('b', 'a')), np.flatnonzero(np.arange(3000) % 3 < 2)),
        (messages.joint_states(('c',)), np.arange(2, 3000, 3)),
    ):
        for rows in (slice(None), slice(600, 900), np.array([999, 3, 700]), slice(0)):
            known = expected[rows]
            found = states.select(rows)
            np.testing.assert_array_equal(found.number, known)
            np.testing.assert_array_equal(found.received, known + 7)
            np.testing.assert_array_equal(states.field(1, rows)[:, -1], known)


def test_record_longer_than_its_chunk_is_an_error_without_a_checksum_too():
    data = bytes([Opcode.MESSAGE, 30, *bytes(7), *bytes(25)])
    with pytest.raises(DamageError, match='does not match its length'):
        list(records_in(Chunk('', data, 0, 0, 0, len(data))))


def test_undecodable_message_is_reported_with_topic_and_number(tmp_path, messages):
    bad = [*messages[:100], (LEARNING, messages[100][1], b'\0\1\0\0'), *messages[100:]]
    path = synthetic_bag.write(tmp_path / 'bag', bad)
    with Reader(path) as reader:
        (learning,) = [c for c in reader.connections if c.topic == LEARNING.resolved]
        place = [bytes(raw) for _, _, raw in reader.messages([learning])].index(b'\0\1\0\0')
    with pytest.raises(UnreadableMessageError, match=f'message {place + 1} of /blf.*/learning'):
        read_run(path)


def read_table(path):
    if path.suffix == '.parquet':
        parquet = pytest.importorskip('pyarrow.parquet', reason='needs pyarrow')
        return {name: np.array(v) for name, v in parquet.read_table(path).to_pydict().items()}
    with path.open(newline='') as stream:
        names, *rows = csv.reader(stream)
    return dict(zip(names, np.array(rows, dtype=float).T, strict=True))


@pytest.mark.parametrize('ending', ['csv', 'parquet', 'xlsx'])
def test_exported_table_round_trips_row_by_row(tmp_path, made, messages, ending, capsys):
    if ending == 'parquet':
        pytest.importorskip('pyarrow', reason='needs pyarrow')
    kept = [m for m in messages if not (m[0] in (REFERENCE, LEARNING) and m[1] == made.stamp[5])]
    bag = synthetic_bag.write(tmp_path / 'bag', kept)
    out = tmp_path / f'table.{ending}'
    code = main(['export', str(bag), '--out', str(out)])
    if ending == 'xlsx':
        assert (code, 'neither .csv nor .parquet' in capsys.readouterr().err) == (1, True)
        return
    assert code == 0
    found = read_table(out)
    np.testing.assert_array_equal(found['stamp [ns]'], made.stamp)
    np.testing.assert_array_equal(found['position elbow [rad]'], made.position[:, 1])
    np.testing.assert_array_equal(found['torque shoulder [N m]'], made.torque[:, 0])
    estimate = found['learning m2*l2^2 [kg m^2]']
    assert np.isnan(estimate[5])  # lost, but the following rows have not moved up
    np.testing.assert_array_equal(estimate[6:], made.estimate[6:, 1])
    # Lost, too, but known from position and error.
    np.testing.assert_allclose(found['reference elbow [rad]'], made.reference[:, 1], atol=1e-15)
    # Published every tenth sample, and held in between.
    np.testing.assert_array_equal(
        found['truth disturbance elbow [N m]'], np.repeat(made.disturbance[::10, 1], 10)
    )
    assert set(found['bound shoulder [rad]']) == {0.002}


def test_every_exported_column_has_a_unit(tmp_path):
    path = recorded_run.record(tmp_path / 'bag', 0.1)
    assert main(['export', str(path), '--out', str(tmp_path / 'table.csv')]) == 0
    found = read_table(tmp_path / 'table.csv')
    assert [name for name in found if not re.search(r' \[.+\]$', name)] == []
    assert {
        'time [s]',
        'learning m2*l2^2 [kg m^2]',
        'learning lambda_min [s^-4]',
        'learning disturbance joint1 [N m]',
        'learning compute_time [s]',
        'monitor distance_to_bound joint1 [rad]',
    } <= {*found}
    states, errors, references = (
        read_content(path).topics[topic].joint_states(('joint1', 'joint2'), ())
        for topic in (JOINT_STATES, TRACKING_ERROR, REFERENCE)
    )
    for name, values in (
        ('effort joint2 [N m]', states.field(2)[:, 1]),
        ('xi2 joint1 [rad/s]', errors.field(1)[:, 0]),
        ('reference_velocity joint1 [rad/s]', references.field(1)[:, 0]),
        ('received [ns]', states.received),
    ):
        np.testing.assert_array_equal(found[name], values)
