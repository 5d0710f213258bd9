# SPDX-License-Identifier: Apache-2.0
"""Messages to bytes and back: identical to ROS 2's serialisation, clear errors for bad ones."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from blf_dsc_controller.messages.codecs import (
    Float64MultiArrayEncoder,
    JointStateDecoder,
    JointStateEncoder,
    typestore,
)
from blf_dsc_controller.messages.errors import (
    MessageError,
)

JOINT_STATE_FIELDS = ('position', 'velocity', 'effort')
STAMP = 1_734_000_123_456_789_012
NAMES = st.lists(st.text('abé/_ ', max_size=9), min_size=1, max_size=8, unique=True)
STAMPS = st.sampled_from([-1, 0]) | st.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1)
VALUES = st.floats(allow_nan=False)
NAN = float('nan')


def cdr(type_name, *fields):
    """Serialise a message by rosbags."""
    name = type_name.replace('/', '/msg/')
    message = typestore().types[name](*fields)
    return bytes(typestore().serialize_cdr(message, name))


def made(type_name, *fields):
    return typestore().types[type_name.replace('/', '/msg/')](*fields)


def joint_state(names, *arrays, frame_id='', stamp=STAMP):
    header = made(
        'std_msgs/Header',
        made('builtin_interfaces/Time', *divmod(stamp, 10**9)),
        frame_id,
    )
    fields = (np.array(values, dtype=float) for values in arrays)
    return cdr('sensor_msgs/JointState', header, list(names), *fields)


def multi_array(data, *dimensions):
    layout = made('std_msgs/MultiArrayLayout', list(dimensions), 0)
    return cdr('std_msgs/Float64MultiArray', layout, np.array(data, dtype=float))


@given(NAMES, st.sets(st.sampled_from(JOINT_STATE_FIELDS)), st.data())
def test_encoded_messages_equal_full_serialisation(names, fields, data):
    values = st.lists(VALUES, min_size=len(names), max_size=len(names))
    arrays = {
        name: data.draw(values) if name in fields else [] for name in JOINT_STATE_FIELDS
    }
    encoder = JointStateEncoder(names, fields)
    array = Float64MultiArrayEncoder(len(names))
    encoder.encode(7, *([0.5] * len(each) for each in arrays.values()))
    assert encoder.encode(STAMP, **arrays) == joint_state(names, *arrays.values())
    numbers = data.draw(values)
    assert array.encode(numbers) == multi_array(numbers)
    for encode in (array.encode, partial(encoder.encode, 0)):
        with pytest.raises(ValueError, match='broadcast'):
            encode([*numbers, 0.0])


@given(NAMES, st.text('base_', max_size=9), STAMPS, st.randoms())
def test_decoder_matches_joints_by_name(names, frame_id, stamp, random):
    values = {
        name: [index + 0.25, -index, 1e3 * index] for index, name in enumerate(names)
    }
    wanted = random.sample(names, random.randint(1, len(names)))
    decoder = JointStateDecoder(wanted)
    for _ in range(3):
        random.shuffle(names)
        columns = np.array([values[name] for name in names]).T
        raw = joint_state(names, *columns, frame_id=frame_id, stamp=stamp)
        assert decoder.decode(raw) == stamp
        decoded = np.array([decoder.position, decoder.velocity, decoder.effort]).T
        assert decoded.tolist() == [values[name] for name in wanted]


GOOD = joint_state('ab', [1, 2], [3, 4], [5, 6])
SPARSE = joint_state('ab', [1, 2], [], [7, 8])


@pytest.mark.parametrize(
    ('raw', 'values'),
    [
        (joint_state('ba', [8, 7], [10, 9], [12, 11]), [7, 8, 9, 10, 11, 12]),
        (joint_state('ba', [8, 7], [10, 9], []), [7, 8, 9, 10, NAN, NAN]),
        # As long as another, also with the zeros that rclpy may append to a message.
        (joint_state('ab', [1, 2], [3, 4], []), [1, 2, 3, 4, NAN, NAN]),
        (joint_state('ab', [], [], []), [NAN] * 6),
        (joint_state('bcac', [8, 0, 7, 0], [10, 0, 9, 0], []), [7, 8, 9, 10, NAN, NAN]),
        (SPARSE, [1, 2, NAN, NAN, 7, 8]),
        (SPARSE + bytes(4), [1, 2, NAN, NAN, 7, 8]),
        # Anything may be in the option byte of the encapsulation, in padding, and after
        # the end.
        (GOOD[:3] + b'\xff' + GOOD[4:17] + b'\xff' + GOOD[18:], [1, 2, 3, 4, 5, 6]),
        (GOOD + b'\xff' * 5, [1, 2, 3, 4, 5, 6]),
    ],
)
@pytest.mark.parametrize('before', [GOOD, joint_state('ab', [1, 2], [3, 4], [])])
def test_decoder_follows_a_change_of_layout(before, raw, values):
    decoder = JointStateDecoder('ab', required=())
    decoder.decode(before)
    for _ in range(2):
        assert decoder.decode(raw) == STAMP
        np.testing.assert_array_equal(decoder.values, values)


@pytest.mark.parametrize(
    ('raw', 'error', 'words'),
    [
        (
            joint_state('ac', [7, 7], [7, 7], [7, 7]),
            MessageError,
            "'b' is .* names a, c: set",
        ),
        (
            joint_state('aba', [1, 2, 3], [4, 5, 6], []),
            MessageError,
            "'a' appears 2",
        ),
        *(
            (joint_state('ab', [1, 2], [4.0] * k, []), MessageError, f'{k} values')
            for k in (0, 1, 3)
        ),
        (joint_state('ab', [1, 2], [3, 4], [5]), MessageError, '1 values'),
        (b'\x00\x00' + GOOD[2:], MessageError, '00 00, not with 00 01'),
    ],
)
def test_bad_message_is_rejected_and_does_not_affect_the_next(raw, error, words):
    decoder = JointStateDecoder('ab')
    decoder.decode(GOOD)
    with pytest.raises(error, match=words):
        decoder.decode(raw)
    assert decoder.position.tolist() == [1, 2]
    assert decoder.decode(GOOD) == STAMP
