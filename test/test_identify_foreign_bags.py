# SPDX-License-Identifier: Apache-2.0
"""Bags of other drivers and tools, as recordings: stamps, split messages, storages."""

from __future__ import annotations

import json

import numpy as np
import pytest
from mcap.writer import Writer as McapWriter
from random_arm import PANDA, PANDA_TEXT

from blf_dsc_controller import BlfDscError
from blf_dsc_controller.bags.content import NameMap
from blf_dsc_controller.bags.sources import open_bag
from blf_dsc_controller.bags.writer import BagWriter
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.identification.from_files import read_recording
from blf_dsc_controller.messages.codecs import JointStateEncoder
from blf_dsc_controller.messages.topics import JOINT_STATE

PERIOD = 0.005  # s
TIME = np.arange(400) * PERIOD
START = 1_000_000_000  # ns
SPEED = np.arange(1.0, 8.0)
Q = np.sin(np.multiply.outer(TIME, SPEED))
TAU = 10.0 * np.cos(np.multiply.outer(TIME, SPEED))


def stamps_of(time):
    return [START + round(t * 1e9) for t in time]


def messages(joints, time, late=0.0, *, stamped=True):
    """Times of reception and bytes of the states of some joints, sampled `late` [s]."""
    encoder = JointStateEncoder(joints)
    at = [PANDA.index(name) for name in joints]
    for stamp, t in zip(stamps_of(time + late), time + late, strict=True):
        q = np.sin(SPEED[at] * t)
        torque = 10.0 * np.cos(SPEED[at] * t)
        raw = encoder.encode(stamp if stamped else 0, q, np.zeros(len(at)), torque)
        yield stamp, bytes(raw)


def written(path, *parts):
    entries = sorted(entry for part in parts for entry in part)
    with BagWriter(path, flush_interval=None) as bag:
        handle = bag.add_topic('/joint_states', JOINT_STATE, [])
        for received, raw in entries:
            bag.write(handle, raw, received)
    return path


def is_the_motion(recording, tolerance, begin=0.0):
    assert recording.joints == PANDA
    assert recording.period == pytest.approx(PERIOD, rel=1e-6)
    samples = len(recording.q) - 1  # at the last one, not all joints may be known
    assert samples > len(TIME) - 5
    known = ~recording.gap[:samples]
    assert known.mean() > 0.98
    time = begin + np.arange(samples)[known] * recording.period
    expected = np.sin(np.multiply.outer(time, SPEED))
    np.testing.assert_allclose(recording.q[:samples][known], expected, atol=tolerance)


def test_states_without_stamps_are_at_their_times_of_reception(tmp_path):
    bag = written(tmp_path / 'bag', messages(PANDA, TIME, stamped=False))
    recording = read_recording(bag, PANDA_TEXT)
    is_the_motion(recording, 1e-6)
    assert 'without stamps: by the times of reception' in recording.source


@pytest.mark.parametrize('late', [0.0, 0.002])
def test_joints_that_come_in_two_messages_are_one_arm(tmp_path, late):
    """Between its samples, the second one is interpolated: (w h)^2 / 8 of it."""
    shuffled = (PANDA[6], 'gripper', PANDA[4], PANDA[5])
    arm = [name for name in shuffled if name in PANDA]
    second = messages(arm, TIME, late)
    bag = written(tmp_path / 'bag', messages(PANDA[:4], TIME), second)
    begin = PERIOD if late else 0.0  # before, the second one is unknown
    is_the_motion(read_recording(bag, PANDA_TEXT), 2e-4, begin)
    with pytest.raises(BlfDscError, match='come in 2 messages'):
        read_recording(bag, PANDA_TEXT, commanded=True)


# What is checked of tables is checked of bags.


SLOW = 0.15 * np.sin(np.multiply.outer(TIME, SPEED))  # rad


def states_bag(path, q, torque):
    """A bag of states at TIME."""
    encoder = JointStateEncoder(PANDA)
    zero = np.zeros(7)
    entries = [
        (stamp, bytes(encoder.encode(stamp, q[k], zero, torque[k])))
        for k, stamp in enumerate(stamps_of(TIME))
    ]
    return written(path, entries)


def refused(bag, *entries, urdf=PANDA_TEXT):
    with pytest.raises(BlfDscError) as error:
        read_recording(bag, urdf, names=NameMap.parse(entries))
    assert '\n' not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize('factor', [1.0, 10.0])
def test_degrees_in_bags_are_refused_with_what_to_type(tmp_path, factor):
    """Of small motions, which stay within two turns, by their speed."""
    q = factor * SLOW
    bag = states_bag(tmp_path / 'bag', np.degrees(q), TAU)
    message = refused(bag)
    assert 'the position of panda_joint' in message
    assert "If it is in degrees: --map 'q=[deg]'; if it is in rad" in message
    assert ('turns by at most' in message) == (factor > 1.0)
    names = NameMap.parse(['q=[deg]'])
    recording = read_recording(bag, PANDA_TEXT, names=names)
    np.testing.assert_allclose(recording.q[:390], q[:390], atol=1e-6)
    kept = read_recording(bag, PANDA_TEXT, names=NameMap.parse(['q=[rad]']))
    np.testing.assert_allclose(kept.q[:390], np.degrees(q[:390]), atol=1e-5)


def test_stand_ins_and_torques_that_nobody_recorded_are_missing_in_bags(tmp_path):
    q, torque = Q.copy(), TAU.copy()
    q[[50, 51, 90], 2] = -9999.0
    torque[60, 4] = 1e10
    torque[200:205] = 0.0
    recording = read_recording(states_bag(tmp_path / 'bag', q, torque), PANDA_TEXT)
    for said in (
        'the position of panda_joint3 is -9999 in 3 row(s), read as missing',
        'the effort of panda_joint5 is 1e+10 in 1 row(s), read as missing',
        'torques are exactly 0 in 5 row(s), read as missing',
    ):
        assert said in recording.source
    # over two that are missing, the fastest is off by (7 rad/s x 15 ms)^2 / 8
    is_the_motion(recording, 2e-3)
    assert recording.gap[200:204].all()
    assert not recording.gap[:190].any()


@pytest.mark.parametrize('others', [(), ('fer_finger_joint1', 'fer_finger_joint2')])
def test_joints_with_another_prefix_are_told_what_to_type(tmp_path, others):
    """Every joint needs its name, as those of a Panda, which is called fer now."""
    names = tuple(f'fer_joint{k}' for k in range(1, 8))
    encoder = JointStateEncoder((*others, *names))
    zero = np.zeros(len(others))
    entries = []
    for k, stamp in enumerate(stamps_of(TIME)):
        q, torque = np.append(zero, Q[k]), np.append(zero, TAU[k])
        entries.append((stamp, bytes(encoder.encode(stamp, q, 0.0 * q, torque))))
    bag = written(tmp_path / 'bag', entries)
    _, typed = refused(bag).split('if these are the same joints, give --map ')
    assert typed.startswith(
        'panda_joint1=fer_joint1 --map panda_joint2=fer_joint2 --map'
    )
    recording = read_recording(
        bag, PANDA_TEXT, names=NameMap.parse(typed.split(' --map '))
    )
    is_the_motion(recording, 1e-6)


def foreign_mcap(path, encoding, profile):
    """A file of joint states in JSON or as ROS 1 writes them."""
    with path.open('wb') as stream:
        writer = McapWriter(stream)
        writer.start(profile=profile)
        kind = {'json': 'jsonschema', 'ros1': 'ros1msg'}[encoding]
        schema = writer.register_schema(JOINT_STATE, kind, b'{}')
        channel = writer.register_channel('/joint_states', encoding, schema)
        for stamp in stamps_of(TIME[:20]):
            data = json.dumps({'position': [0.0] * 7}).encode()
            writer.add_message(channel, stamp, data, stamp)
        writer.finish()
    return path


@pytest.mark.parametrize(
    ('encoding', 'profile', 'remedy'),
    [
        ('json', '', 'as CSV, which `blf_dsc identify` reads'),
        ('json', 'ros2', 'as CSV, which `blf_dsc identify` reads'),
        ('ros1', 'ros1', 'give the .bag of ROS 1'),
    ],
)
def test_other_encodings_of_mcap_are_named_with_what_to_do(
    tmp_path, capsys, encoding, profile, remedy
):
    """Recovery, which would be of no use, is not advised, and says so itself."""
    path = foreign_mcap(tmp_path / 'run.mcap', encoding, profile)
    with pytest.raises(BlfDscError, match=f'its messages are {encoding}') as error:
        read_recording(path, PANDA_TEXT)
    assert remedy in str(error.value)
    assert 'recover' not in str(error.value)
    assert main(['recover', str(path), '--out', str(tmp_path / 'clean')]) == 1
    output = capsys.readouterr().out
    assert f'20 messages of /joint_states: they are {encoding}, not CDR' in output
    assert 'ALL LOST' in output


def test_file_of_cdr_without_a_profile_is_saved_by_recovery(tmp_path, capsys):
    path = tmp_path / 'run.mcap'
    with path.open('wb') as stream:
        writer = McapWriter(stream)
        writer.start()
        text = b'std_msgs/Header header'
        schema = writer.register_schema(JOINT_STATE, 'ros2msg', text)
        channel = writer.register_channel('/joint_states', 'cdr', schema)
        for stamp, raw in messages(PANDA, TIME):
            writer.add_message(channel, stamp, raw, stamp)
        writer.finish()
    assert main(['recover', str(path), '--out', str(tmp_path / 'clean')]) == 0
    capsys.readouterr()
    with open_bag(tmp_path / 'clean') as bag:
        assert bag.counts['/joint_states'] == len(TIME)
