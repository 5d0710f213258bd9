# SPDX-License-Identifier: Apache-2.0
"""Damiao's frames agree with those of damiao-motor, which others wrote."""

from __future__ import annotations

import numpy as np
import pytest

from blf_dsc_controller.motors import damiao
from blf_dsc_controller.motors.damiao import Register, StateCodes, Status
from blf_dsc_controller.motors.frame import Frame

theirs = pytest.importorskip('damiao_motor.core.motor')


def motor(model):
    """Return their motor of a model, without a bus."""
    return theirs.DaMiaoMotor(1, 0x11, None, motor_type=model)


@pytest.mark.parametrize('model', sorted(damiao.MODELS))
def test_commands_agree_with_those_of_damiao_motor(model):
    """Between two codes both take the lower one, a quarter of a step above it."""
    random = np.random.default_rng(1)
    ranges = damiao.ranges_of([damiao.MODELS[model]])
    for _ in range(300):
        codes = [int(random.integers(0, 2**field.bits - 1)) for field in ranges]
        frame = Frame(
            *(
                field.values([code]) + 0.25 * field.step
                for field, code in zip(ranges, codes, strict=True)
            )
        )
        (ours,) = damiao.command_data(frame, ranges)
        q, dq, kp, kd, torque = (float(each[0]) for each in frame)
        assert ours == motor(model).encode_cmd_msg(q, dq, torque, kp, kd)
        assert damiao.codes_of_command(ours) == tuple(codes)


@pytest.mark.parametrize('model', sorted(damiao.MODELS))
def test_states_agree_with_those_of_damiao_motor(model):
    random = np.random.default_rng(2)
    ranges = damiao.ranges_of([damiao.MODELS[model]])
    fields = ranges.position, ranges.velocity, ranges.torque
    for _ in range(300):
        q, dq, torque = (int(random.integers(0, 2**field.bits)) for field in fields)
        state = StateCodes(1, Status.ENABLED, q, dq, torque, 41, 52)
        data = damiao.state_data(state)
        assert damiao.state_of(data) == state
        found = motor(model).decode_sensor_feedback(data)
        assert (found['can_id'], found['status']) == (1, 'ENABLED')
        assert (found['t_mos'], found['t_rotor']) == (41.0, 52.0)
        ours = [
            float(f.values([c])[0]) for f, c in zip(fields, state[2:5], strict=True)
        ]
        np.testing.assert_allclose(
            [found['pos'], found['vel'], found['torq']], ours, atol=1e-12
        )


def test_special_frames_and_statuses_are_theirs():
    each = theirs.DaMiaoMotor
    assert each.encode_enable_msg() == damiao.ENABLE
    assert each.encode_disable_msg() == damiao.DISABLE
    assert each.encode_clear_error_msg() == damiao.CLEAR
    names = theirs._STATE_NAME_MAP
    assert set(names) == {status.value for status in Status}
    assert set(damiao.REMEDIES) == set(Status) - {Status.ENABLED}


def test_requests_and_readings_are_theirs():
    class Sent:
        def send(self, message):
            self.message = message

    bus = Sent()
    asked = theirs.DaMiaoMotor(3, 0x13, bus, motor_type='4310')
    asked.request_register_reading(Register.TORQUE)
    assert bus.message.arbitration_id == damiao.TO_ALL
    request = damiao.request_data(3, damiao.READ, Register.TORQUE)
    assert bytes(bus.message.data) == request
    asked.request_motor_feedback()
    assert bytes(bus.message.data) == damiao.request_data(3, damiao.REFRESH)
    for register, value in ((Register.TORQUE, 28.0), (Register.MODE, 1)):
        data = damiao.reading_data(3, register, value)
        assert theirs.is_register_reply(data)
        asked.process_feedback_frame(data)
        assert asked.registers[register] == value
        assert damiao.reading_of(data, 3, register) == value
    assert damiao.reading_of(data, 4, Register.MODE) is None
