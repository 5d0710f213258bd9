# SPDX-License-Identifier: Apache-2.0
"""Messages to bytes and back: identical to ROS 2's serialisation, clear errors for bad ones."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from blf_dsc_controller.messages.codecs import (
    DuplicatedJointError,
    Float64MultiArrayDecoder,
    Float64MultiArrayEncoder,
    JointStateDecoder,
    JointStateEncoder,
    MessageError,
    MissingJointError,
    ShortArrayError,
    encode_clock,
    typestore,
)

STAMP = 1_734_000_123_456_789_012
NAMES = st.lists(st.text('abé/_ ', max_size=9), min_size=1, max_size=8, unique=True)
FRAMES = st.text('base_', max_size=9)
VALUES = st.floats(allow_nan=False)


def joint_state(names, position, velocity, effort, stamp=STAMP, frame_id=''):
    types = typestore().types
    time = types['builtin_interfaces/msg/Time'](*divmod(stamp, 10**9))
    header = types['std_msgs/msg/Header'](stamp=time, frame_id=frame_id)
    arrays = [np.array(values, dtype=float) for values in (position, velocity, effort)]
    return types['sensor_msgs/msg/JointState'](header, list(names), *arrays)


def serialised(message, *, little_endian=True):
    return bytes(
        typestore().serialize_cdr(message, message.__msgtype__, little_endian=little_endian)
    )


def multi_array(data, dimensions=()):
    types = typestore().types
    layout = types['std_msgs/msg/MultiArrayLayout'](list(dimensions), 0)
    return types['std_msgs/msg/Float64MultiArray'](layout, np.array(data, dtype=float))


def raw_joint_state(*arguments, little_endian=True, **options):
    return serialised(joint_state(*arguments, **options), little_endian=little_endian)


@given(NAMES, FRAMES, st.sets(st.sampled_from(('position', 'velocity', 'effort'))), st.data())
def test_encoded_joint_state_equals_full_serialisation(names, frame_id, fields, data):
    arrays = {
        field: data.draw(st.lists(VALUES, min_size=len(names), max_size=len(names)))
        if field in fields
        else []
        for field in ('position', 'velocity', 'effort')
    }
    encoder = JointStateEncoder(names, fields, frame_id)
    encoder.encode(7, *([0.5] * len(values) for values in arrays.values()))

    assert encoder.encode(STAMP, **arrays) == raw_joint_state(
        names, *arrays.values(), frame_id=frame_id
    )


@given(NAMES, FRAMES, st.booleans(), st.randoms(use_true_random=False))
def test_decoder_matches_joints_by_name(names, frame_id, little_endian, random):
    values = {name: [index + 0.25, -index, 1e3 * index] for index, name in enumerate(names)}
    wanted = random.sample(names, random.randint(1, len(names)))
    decoder = JointStateDecoder(wanted)
    for _ in range(3):
        random.shuffle(names)
        columns = np.array([values[name] for name in names]).T
        raw = raw_joint_state(names, *columns, frame_id=frame_id, little_endian=little_endian)

        assert decoder.decode(raw) == STAMP
        decoded = np.array([decoder.position, decoder.velocity, decoder.effort]).T
        assert decoded.tolist() == [values[name] for name in wanted]


GOOD = raw_joint_state('ab', [1, 2], [3, 4], [5, 6])
NAN = float('nan')


@pytest.mark.parametrize(
    ('raw', 'values'),
    [
        (raw_joint_state('ba', [8, 7], [10, 9], [12, 11]), [7, 8, 9, 10, 11, 12]),
        (raw_joint_state('ba', [8, 7], [10, 9], []), [7, 8, 9, 10, NAN, NAN]),
        # As long as another, also with the zeros that rclpy may append to a message.
        (raw_joint_state('ab', [1, 2], [3, 4], []), [1, 2, 3, 4, NAN, NAN]),
        (raw_joint_state('ab', [1, 2], [], [7, 8]), [1, 2, NAN, NAN, 7, 8]),
        (raw_joint_state('ab', [1, 2], [], [7, 8]) + bytes(4), [1, 2, NAN, NAN, 7, 8]),
        # Anything may be in the option byte of the encapsulation, in padding, and after the end.
        (GOOD[:3] + b'\xff' + GOOD[4:17] + b'\xff' + GOOD[18:], [1, 2, 3, 4, 5, 6]),
        (GOOD + b'\xff' * 5, [1, 2, 3, 4, 5, 6]),
    ],
)
@pytest.mark.parametrize('before', [GOOD, raw_joint_state('ab', [1, 2], [3, 4], [])])
def test_decoder_follows_a_change_of_layout(before, raw, values):
    decoder = JointStateDecoder('ab', required=())
    decoder.decode(before)
    for _ in range(2):
        assert decoder.decode(raw) == STAMP
        np.testing.assert_array_equal(decoder.values, values)


def test_missing_joint_is_named_and_others_may_be_repeated():
    raw = raw_joint_state(('shoulder', 'wrist', 'wrist'), [1, 2, 3], [3, 4, 5], [])
    with pytest.raises(MissingJointError, match=r"'elbow'.*names shoulder, wrist") as caught:
        JointStateDecoder(['elbow']).decode(raw)
    assert caught.value.joint == 'elbow'
    decoder = JointStateDecoder(['shoulder'])
    decoder.decode(raw)
    assert decoder.position.tolist() == [1]


@pytest.mark.parametrize(
    ('raw', 'error', 'words'),
    [
        (raw_joint_state('ac', [7, 7], [7, 7], [7, 7]), MissingJointError, 'joint .b.'),
        (raw_joint_state('aba', [1, 2, 3], [4, 5, 6], []), DuplicatedJointError, "'a' appears 2"),
        *(
            (raw_joint_state('ab', [1, 2], [4.0] * k, []), ShortArrayError, f'{k} values')
            for k in (0, 1, 3)
        ),
        (raw_joint_state('ab', [1, 2], [3, 4], [5]), ShortArrayError, '1 values'),
        (b'\x00\x07' + GOOD[2:], MessageError, '00 07'),
    ],
)
def test_bad_message_is_rejected_and_does_not_affect_the_next(raw, error, words):
    decoder = JointStateDecoder('ab')
    decoder.decode(GOOD)
    with pytest.raises(error, match=words):
        decoder.decode(raw)
    assert decoder.position.tolist() == [1, 2]
    assert decoder.decode(GOOD) == STAMP


@pytest.mark.parametrize('warm', [False, True])
@pytest.mark.parametrize(
    ('create', 'raw'),
    [
        (lambda: JointStateDecoder('ab'), GOOD),
        (lambda: Float64MultiArrayDecoder(2), Float64MultiArrayEncoder(2).encode([1, 2])),
    ],
)
def test_every_truncation_is_rejected(create, raw, warm):
    decoder = create()
    for length in range(len(raw)):
        if warm:
            decoder.decode(raw)
        with pytest.raises(MessageError, match='is cut off'):
            decoder.decode(raw[:length])


@pytest.mark.parametrize('arrays', [([1, 2, 3],), ([1, 2], [3, 4])])
def test_encoder_rejects_arrays_of_wrong_length(arrays):
    with pytest.raises(ValueError, match='shape'):
        JointStateEncoder(['a', 'b'], ('position',)).encode(0, *arrays)


@given(st.lists(VALUES, max_size=9))
def test_multi_array_round_trip(data):
    encoder = Float64MultiArrayEncoder(len(data))
    decoder = Float64MultiArrayDecoder(len(data))

    assert encoder.encode(data) == serialised(multi_array(data))
    assert decoder.decode(encoder.encode(data)) == len(data)
    assert decoder.values.tolist() == data


@pytest.mark.parametrize('little_endian', [False, True])
def test_multi_array_with_dimensions(little_endian):
    dimension = typestore().types['std_msgs/msg/MultiArrayDimension']('joints', 3, 3)
    raw = serialised(multi_array([1, 2, 3], [dimension]), little_endian=little_endian)
    decoder = Float64MultiArrayDecoder(3)
    assert decoder.decode(raw) == 3
    assert decoder.decode(Float64MultiArrayEncoder(2).encode([4, 5])) == 2
    assert decoder.values.tolist() == [1, 2, 3]


def test_clock_equals_full_serialisation():
    types = typestore().types
    clock = types['rosgraph_msgs/msg/Clock'](types['builtin_interfaces/msg/Time'](1, 5))
    assert encode_clock(1_000_000_005) == serialised(clock)
