# SPDX-License-Identifier: Apache-2.0
"""Stiffness of joints from the positions of motors and links."""

from __future__ import annotations

import re

import numpy as np
import pytest
import yaml
from random_arm import (
    PANDA,
    PANDA_CHAIN,
    PANDA_TEXT,
    PERIOD,
    reference_of,
    shake,
    truth_of,
)

from blf_dsc_controller import change, load_loop, read_run, simulate
from blf_dsc_controller.bags.content import NameMap
from blf_dsc_controller.bags.writer import BagWriter
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.configuration.nodes import PLANT
from blf_dsc_controller.configuration.robot import Robot
from blf_dsc_controller.identification.from_files import read_recording
from blf_dsc_controller.messages.codecs import JointStateEncoder
from blf_dsc_controller.messages.topics import JOINT_STATE
from blf_dsc_controller.simulation.loop import simulate_into_bag

ROBOT = Robot(urdf=PANDA_TEXT, tip='panda_hand_tcp')
STIFFNESS = np.array([14e3, 14e3, 14e3, 14e3, 8e3, 8e3, 8e3])  # N m/rad
DURATION = 12.0  # s
EVERY = 5  # samples of 1 ms
ENCODER = 2.0 * np.pi / 2.0**20  # rad
N = len(PANDA)


class Motion:
    """States of an arm whose motors are twisted against its links by its torques."""

    def __init__(self):
        truth = truth_of(PANDA_CHAIN, 4)
        states = shake(PANDA_CHAIN, truth, reference_of(PANDA_CHAIN, 9), DURATION)
        # the torque of a state is that which acts after it
        self.q, dq, _ = np.moveaxis(states[:-1], 1, 0)
        self.motor = states[1:, 2]
        rotors = truth.rotors * np.gradient(dq, PERIOD, axis=0)
        friction = truth.viscous * dq + truth.coulomb * np.tanh(dq / 0.005)
        self.link = self.motor - rotors - friction
        self.rate = np.gradient(self.link, PERIOD, axis=0)
        self.time = np.arange(len(dq)) * PERIOD


@pytest.fixture(scope='module')
def motion():
    return Motion()


# Recordings.


def write_both(path, motion, twist):
    """Write 3 s of links, and of motors of the same names, twisted by `twist` of k."""
    links, motors = JointStateEncoder(PANDA), JointStateEncoder(PANDA)
    with BagWriter(path, flush_interval=None) as bag:
        of_links, of_motors = (
            bag.add_topic(name, JOINT_STATE, [])
            for name in ('/joint_states', '/motor_states')
        )
        for k in range(600):
            stamp = 10**9 + k * 5_000_000
            q, torque = motion.q[k * EVERY], motion.motor[k * EVERY]
            bag.write(of_links, links.encode(stamp, q, q, torque), stamp)
            late = stamp + 1_000_000  # where the twist is 1/3000 of that after 3 s more
            raw = motors.encode(late, q + twist(k), q, torque)
            bag.write(of_motors, raw, late)


def test_positions_of_motors_in_bags_are_those_of_another_topic(tmp_path, motion):
    path = tmp_path / 'bag'
    write_both(path, motion, lambda k: 0.001 * k / 600 * np.arange(1, N + 1))
    names = NameMap.parse(['theta=/motor_states', 'joint_states=/joint_states'])
    recording = read_recording(path, PANDA_TEXT, PANDA, names=names)
    assert recording.twist is not None
    unasked = read_recording(path, PANDA_TEXT, PANDA)
    np.testing.assert_array_equal(unasked.twist[:], recording.twist[:])


def test_a_column_of_motors_that_is_given_has_the_unit_of_its_name(tmp_path):
    time = 0.01 * np.arange(200)
    q, twist = np.sin(time), 0.01 * np.sin(3.0 * time)
    rows = np.column_stack((time, q, np.cos(time), np.rad2deg(q + twist)))
    header = 't,q_1,tau_1,motor deg'
    np.savetxt(tmp_path / 'a.csv', rows, delimiter=',', header=header, comments='')
    names = NameMap.parse(['theta=motor deg'])
    recording = read_recording(tmp_path / 'a.csv', PANDA_TEXT, PANDA[:1], names=names)
    expected = (twist - np.median(twist))[: len(recording.twist), None]
    np.testing.assert_allclose(recording.twist, expected, atol=1e-6)


# From the arm to its stiffness.

GEARS = {
    'sensor.side': 'both',
    'sensor.resolution': ENCODER,
    'duration': 8.0,
    'events.begin': [100.0],
}


def test_simulated_arm_with_encoders_on_both_sides_shows_its_gears(tmp_path, capsys):
    """A Panda's torque sensors, ripple, friction and lags, in lock-step; seven intervals of 95 %.

    With encoders at the links alone, the torques are the same.
    """
    loop = load_loop('panda', {PLANT: GEARS})
    simulate_into_bag(tmp_path / 'bag', loop.controller, loop.plant)
    (tmp_path / 'panda.urdf').write_text(PANDA_TEXT)
    words = [str(tmp_path / 'bag'), '--urdf', str(tmp_path / 'panda.urdf')]
    words += ['--tip', 'panda_hand_tcp', '--out', str(tmp_path / 'new.urdf')]
    assert main(['identify', *words, '--out', str(tmp_path / 'arm.yaml')]) == 0
    text = ' '.join(capsys.readouterr().out.split())
    assert 'positions of motors of /motor_states' in text
    found = yaml.safe_load((tmp_path / 'arm.yaml').read_text())['/**']
    stiffness = found['ros__parameters']['robot.joint_stiffness']
    np.testing.assert_allclose(stiffness, loop.plant.joint.stiffness, rtol=0.02)
    rows = re.findall(r'([\d.]+) N m/rad ([\d.]+) to ([\d.]+)', text)
    ends = np.array(rows, float)
    half = 0.5 * (ends[:, 2] - ends[:, 1])
    assert len(ends) == N
    assert (abs(ends[:, 0] - loop.plant.joint.stiffness) < 1.7 * half).all()
    links = change(loop.plant, {'sensor.side': 'link', 'duration': 1.0})
    torque = simulate(loop.controller, links).run().torque
    np.testing.assert_array_equal(
        torque, read_run(tmp_path / 'bag').torque[: len(torque)]
    )


# What the command says.


@pytest.fixture
def commanded(tmp_path, motion, capsys):
    """Return a function that identifies a table with twists (N, n) by the command."""

    def run(twist):
        rows = slice(None, None, EVERY)
        q, theta = (
            np.round(each[rows] / ENCODER) * ENCODER
            for each in (motion.q, motion.q + twist + 0.3)  # with another zero
        )
        values = {'q': q, 'theta': theta, 'tau_J': motion.motor[rows]}
        np.savez(tmp_path / 'a.npz', t=motion.time[rows], **values)
        (tmp_path / 'panda.urdf').write_text(PANDA_TEXT)
        words = [str(tmp_path / 'a.npz'), '--urdf', str(tmp_path / 'panda.urdf')]
        words += ['--tip', 'panda_hand_tcp', '--out', str(tmp_path / 'new.urdf')]
        assert main(['identify', *words, '--out', str(tmp_path / 'arm.yaml')]) == 0
        written = yaml.safe_load((tmp_path / 'arm.yaml').read_text())['/**']
        found = written['ros__parameters'].get('robot.joint_stiffness')
        return found, capsys.readouterr().out

    return run


def test_stiffness_is_printed_and_written_whatever_else_moves_the_encoders(
    commanded, motion
):
    """An error once per turn, springs that lag, and play: each a fifth of the twist."""
    twist = motion.link / STIFFNESS
    size = 0.2 * twist.std(axis=0)
    others = np.sin(motion.q + 0.7) - np.sign(motion.rate) + np.sign(motion.link)
    found, text = commanded(twist + size * others)
    assert "positions of motors 'theta_0' to 'theta_6'" in ' '.join(text.split())
    table = text[text.index('stiffness between motor and link') :].splitlines()
    for name, line in zip(PANDA, table[1:], strict=False):
        assert line.startswith(name)
        assert 'N m/rad' in line
    np.testing.assert_allclose(found, STIFFNESS, rtol=0.1)


def test_motors_that_move_as_their_links_show_no_stiffness(commanded):
    """As of a robot without a second encoder, which reports one position twice."""
    assert not commanded(0.0)[0]
