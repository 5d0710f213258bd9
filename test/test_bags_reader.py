# SPDX-License-Identifier: Apache-2.0
"""Bags are read back as the arrays they were made of, under any topic names, and as a table."""

from __future__ import annotations

import csv
import re

import numpy as np
import pytest
import recorded_run
from recorded_run import BOUND_RAD, JOINTS, LIMIT_NM, PARAMETERS, TRUE, Synthetic

from blf_dsc_controller import BagError, read_run
from blf_dsc_controller.bags.content import NameMap, read_content
from blf_dsc_controller.bags.topic_messages import UnreadableMessageError
from blf_dsc_controller.bags.writer import BagWriter
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.messages.codecs import (
    JointStateEncoder,
    typestore,
)
from blf_dsc_controller.messages.journal import EventType, Journal
from blf_dsc_controller.messages.topics import (
    COMMANDS,
    DIAGNOSTICS,
    JOINT_STATES,
    JOURNAL,
    MONITOR,
    REFERENCE,
)

SAMPLES = 200
MADE = Synthetic(SAMPLES)
MESSAGES = list(MADE.messages(with_timing=True))
STATES = [entry for entry in MESSAGES if entry[0] is JOINT_STATES]
ENCODER = JointStateEncoder(JOINTS)


def without(*topics):
    return [entry for entry in MESSAGES if entry[0] not in topics]


@pytest.mark.parametrize(
    'rename',
    [
        lambda topic: topic.resolved,
        lambda topic: '/left/arm' + topic.resolved,
        lambda topic: '/' + topic.leaf,
        lambda topic: f'/another_node/{topic.leaf}',
    ],
)
def test_arrays_round_trip_under_any_topic_names(tmp_path, rename):
    run = read_run(recorded_run.write_made(tmp_path / 'bag', MESSAGES, rename))
    assert run.joints == JOINTS
    for found, expected in (
        (run.stamp, MADE.stamp),
        (run.position, MADE.position),  # joints matched by name
        (run.reference, MADE.reference),
        (run.error, MADE.error),
        (run.torque, MADE.torque),
        (run.monitor.select(PARAMETERS), MADE.estimate),
        (run.truth.select(PARAMETERS), np.tile(TRUE, (20, 1))),
        (run.timing.column('late_steps'), np.arange(SAMPLES) // 100),
        (run.bound, np.full((SAMPLES, 2), BOUND_RAD)),
        (run.torque_limit, np.full((SAMPLES, 2), LIMIT_NM)),
    ):
        np.testing.assert_array_equal(found, expected)
    assert run.duration == pytest.approx(0.199)


def test_journal_tells_which_joint_states_the_controller_used(tmp_path):
    """An FR3 also publishes them at 30 Hz, under the usual name."""
    used, journal = '/franka/joint_states', Journal()
    journal.note(EventType.CONFIGURE, parameters={}, topics={'joint_states': used})
    with BagWriter(tmp_path / 'bag') as bag:
        told = bag.add_topic(JOURNAL.resolved, JOURNAL.type, [])
        handles = [
            bag.add_topic(name, JOINT_STATES.type, [])
            for name in ('/joint_states', used)
        ]
        bag.write(told, journal.pending[0].encode(), STATES[0][1])
        for number, (_, stamp, raw) in enumerate(STATES):
            for handle in handles if number % 30 == 0 else handles[1:]:
                bag.write(handle, raw, stamp)
    states = read_content(tmp_path / 'bag').topics[JOINT_STATES]
    assert (states.name, states.size) == (used, SAMPLES)


def test_namespace_selects_one_of_several_robots(tmp_path):
    with BagWriter(tmp_path / 'bag') as bag:
        for side, first in (('left', 0), ('right', 7)):
            handles = {}
            for topic, stamp, raw in MESSAGES[first:]:
                if topic not in handles:
                    name = f'/{side}{topic.resolved}'
                    handles[topic] = bag.add_topic(name, topic.type, [topic.offered])
                bag.write(handles[topic], raw, stamp)
    with pytest.raises(BagError, match=r'/left/joint_states, .*--namespace /left$'):
        read_run(tmp_path / 'bag')
    assert read_run(tmp_path / 'bag', 'left').stamp.size == SAMPLES
    assert read_run(tmp_path / 'bag', '/right').stamp.size < SAMPLES


def test_only_joint_states_are_required(tmp_path):
    decoy = (DIAGNOSTICS, 0, b'\0\1\0\0')
    path = recorded_run.write_made(
        tmp_path / 'bag',
        [decoy, *STATES],
        lambda topic: '/x/learning' if topic is DIAGNOSTICS else topic.resolved,
    )
    run = read_run(path)  # a topic of another type is ignored
    assert run.joints == JOINTS[::-1]
    np.testing.assert_array_equal(run.position, MADE.position[:, ::-1])
    unknown = (run.reference, run.error, run.bound, run.monitor, run.truth, run.timing)
    assert unknown == (None,) * len(unknown)


def test_what_is_missing_is_computed_from_what_is_there(tmp_path):
    path = recorded_run.write_made(tmp_path / 'bag', without(REFERENCE))
    np.testing.assert_allclose(read_run(path).reference, MADE.reference, atol=1e-15)
    lost = next(k for k, entry in enumerate(MESSAGES) if entry[0] is COMMANDS)
    path = recorded_run.write_made(
        tmp_path / 'one', MESSAGES[:lost] + MESSAGES[lost + 1 :]
    )
    np.testing.assert_array_equal(read_run(path).torque, MADE.torque)


@pytest.mark.parametrize('longest', [1, 2])
def test_stamps_that_fall_once_begin_another_run(tmp_path, longest):
    """A simulator was reset: the longer run is read, and what is left out is counted."""
    later = without(COMMANDS)
    short = [entry for entry in later if entry[1] < MADE.stamp[50]]
    kept = [
        entry
        for entry in later
        if not (entry[0] is MONITOR and entry[1] == MADE.stamp[10])
    ]
    first, second = (short, kept) if longest == 2 else (kept, short)
    again = [(topic, at + 10**9, raw) for topic, at, raw in second]
    run = read_run(recorded_run.write_made(tmp_path / 'bag', first + again))
    np.testing.assert_array_equal(run.stamp, MADE.stamp)
    np.testing.assert_array_equal(run.error, MADE.error)
    assert run.monitor.stamp.tolist() == [*MADE.stamp[:10], *MADE.stamp[11:]]
    assert run.notes == (
        (
            '50 of 250 joint states left out: their stamps fall 1 times, so that 2 runs are in the '
            f'bag; run {longest}, the longest, is shown'
        ),
    )


SHARED = 'several publishers share /joint_states'


@pytest.mark.parametrize(
    ('kind', 'words'),
    [
        ('backwards', SHARED),
        ('interleaved', SHARED),
        ('numbered', SHARED),
        ('unset', 'all 400 messages of /joint_states have the stamp 0 ns'),
    ],
)
def test_states_of_several_publishers_or_without_stamps_are_refused(
    tmp_path, kind, words
):
    # ns; only numbers show two in even turns
    delay = 500_000 if kind == 'numbered' else 400_000
    states = []
    for _, at, raw in STATES:
        times = (0, 0) if kind == 'unset' else (at, at + delay)
        own, other = (ENCODER.encode(time, [9, 9], [0, 0], [0, 0]) for time in times)
        states += [(at, raw if kind == 'backwards' else own), (at + delay, other)]
    if kind == 'backwards':
        states = states[::-2]
        later, earlier = (1e-9 * (MADE.stamp[-k] + delay) for k in (1, 2))
        words += (
            f', or its clock runs backwards: its stamps fall {SAMPLES - 1} times, '
            f'the first time from {later:.9g} s to {earlier:.9g} s'
        )
    with BagWriter(tmp_path / 'bag') as bag:
        handle = bag.add_topic('/joint_states', JOINT_STATES.type, [])
        for k, (at, raw) in enumerate(states):
            bag.write(handle, raw, at, sequence=1 + k // 2 if kind == 'numbered' else 0)
    with pytest.raises(BagError, match=re.escape(words)):
        read_run(tmp_path / 'bag')


def test_repeated_states_and_those_of_other_joints_are_counted(tmp_path):
    gripper = JointStateEncoder(['finger']).encode(5, [0], [0], [0])
    kept = [STATES[0], STATES[0], (JOINT_STATES, STATES[0][1], gripper), *STATES[1:]]
    names = NameMap({}, {joint: joint for joint in JOINTS})
    run = read_run(recorded_run.write_made(tmp_path / 'bag', kept), names=names)
    assert run.stamp.size == SAMPLES
    assert run.notes == (
        '1 of 202 joint states left out: they name other joints',
        '1 joint states left out: they repeat the stamp before',
    )


def test_text_without_end_is_refused(tmp_path):
    """It compresses to nothing."""
    message = typestore().types[JOURNAL.type](data='x' * (1 << 24))
    raw = bytes(typestore().serialize_cdr(message, JOURNAL.type))
    entries = [[t.resolved, t.type, at, raw] for t, at, raw in STATES]
    entries.insert(3, [JOURNAL.resolved, JOURNAL.type, 0, raw])
    with pytest.raises(BagError, match=f'a message of {JOURNAL.resolved} has 17 MB'):
        read_run(recorded_run.write(tmp_path / 'bag', entries))


@pytest.mark.parametrize(
    ('sequences', 'lost'),
    [
        # each publisher has its own numbers
        (
            (4, 5, 0, 8, 9, 2, 3, 10, 4, 4, 5, 1, 2),
            '2 missed, 7 sent before the recorder connected',
        ),
        (range(99, 1, -1), ''),  # of whatever it may be
        ((*range(1, 21), 20, 21), ''),  # the same one, recorded twice
        ((*range(1, 21), 11, 21), ''),
    ],
)
def test_gaps_in_sequence_numbers_are_losses(tmp_path, sequences, lost):
    with BagWriter(tmp_path / 'bag') as bag:
        handle = bag.add_topic('/joint_states', JOINT_STATES.type, [])
        for k, sequence in enumerate(sequences):
            content = sequence if lost == '' else k
            raw = ENCODER.encode(content, [0, 0], [0, 0], [0, 0])
            bag.write(handle, raw, k, sequence=sequence)
    expected = {'/joint_states': lost} if lost else {}
    assert read_content(tmp_path / 'bag').losses == expected


def test_undecodable_message_is_reported_with_topic_and_number(tmp_path):
    bad = [*MESSAGES[:100], (MONITOR, MESSAGES[100][1], b'\0\1\0\0'), *MESSAGES[100:]]
    number = 1 + sum(topic is MONITOR for topic, *_ in MESSAGES[:100])
    with pytest.raises(
        UnreadableMessageError, match=f'message {number} of /blf.*/monitor'
    ):
        read_run(recorded_run.write_made(tmp_path / 'bag', bad))


# The table.


def read_table(path):
    if path.suffix == '.parquet':
        parquet = pytest.importorskip('pyarrow.parquet', reason='needs pyarrow')
        return {
            name: np.array(v)
            for name, v in parquet.read_table(path).to_pydict().items()
        }
    with path.open(newline='') as stream:
        names, *rows = csv.reader(stream)
    return dict(zip(names, np.array(rows, dtype=float).T, strict=True))


@pytest.mark.parametrize('ending', ['csv', 'parquet', 'xlsx'])
def test_exported_table_round_trips_row_by_row(tmp_path, ending, capsys):
    if ending == 'parquet':
        pytest.importorskip('pyarrow', reason='needs pyarrow')
    kept = [
        m
        for m in MESSAGES
        if not (m[0] in (REFERENCE, MONITOR) and m[1] == MADE.stamp[5])
    ]
    bag = recorded_run.write_made(tmp_path / 'bag', kept)
    out = tmp_path / f'table.{ending}'
    code = main(['export', str(bag), '--out', str(out)])
    if ending == 'xlsx':
        assert (code, 'neither .csv nor .parquet' in capsys.readouterr().err) == (
            1,
            True,
        )
        return
    found = read_table(out)
    estimate = found['monitor m2*l2^2 [kg m^2]']
    for values, expected in (
        (found['stamp [ns]'], MADE.stamp),
        (found['position elbow [rad]'], MADE.position[:, 1]),
        (found['torque shoulder [N m]'], MADE.torque[:, 0]),
        (estimate[6:], MADE.estimate[6:, 1]),
        (estimate[5], MADE.estimate[4, 1]),  # lost: the last before it holds
        # Published every tenth sample, and held in between.
        (
            found['truth disturbance elbow [N m]'],
            np.repeat(MADE.disturbance[::10, 1], 10),
        ),
        (found['bound shoulder [rad]'], np.full(SAMPLES, BOUND_RAD)),
    ):
        np.testing.assert_array_equal(values, expected)
    # Lost, too, but known from position and error.
    np.testing.assert_allclose(
        found['reference elbow [rad]'], MADE.reference[:, 1], atol=1e-15
    )


def test_every_exported_column_has_a_unit(tmp_path):
    path = recorded_run.record(tmp_path / 'bag', 0.1)
    assert main(['export', str(path), '--out', str(tmp_path / 'table.csv')]) == 0
    found = read_table(tmp_path / 'table.csv')
    assert [name for name in found if not re.search(r' \[.+\]$', name)] == []
    assert {
        'time [s]',
        'monitor m2*l2^2 [kg m^2]',
        'monitor lambda_min [s^-4]',
        'monitor disturbance joint1 [N m]',
        'monitor compute_time [s]',
        'monitor distance_to_bound joint1 [rad]',
    } <= {*found}
    # known where there is a message
    velocity = found['reference_velocity joint1 [rad/s]']
    assert np.isfinite(velocity[::10]).all()
    assert np.isnan(np.delete(velocity, np.s_[::10])).all()
