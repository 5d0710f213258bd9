# SPDX-License-Identifier: Apache-2.0
"""Identification of an arm from bags of our plant and of MuJoCo, with its confidence."""

from __future__ import annotations

import re

import mujoco
import numpy as np
import pinocchio
import pytest
from random_arm import PANDA, pinocchio_model
from shaken_arm import (
    FIELDS,
    GRAVITY,
    PANDA_CHAIN,
    PANDA_TEXT,
    PERIOD,
    is_covered,
    measured,
    recording_of,
    reference_of,
    shake,
    truth_of,
    write_states,
)

from blf_dsc_controller.arms.urdf import pseudo_inertia, read_chain
from blf_dsc_controller.bags.content import NameMap
from blf_dsc_controller.bags.sources import BagError
from blf_dsc_controller.bags.writer import BagWriter
from blf_dsc_controller.cli.identify import problems_of
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.configuration.nodes import PLANT, load_loop
from blf_dsc_controller.configuration.robot import Robot
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.identification.corrected_urdf import corrected_urdf
from blf_dsc_controller.identification.identify import identify_arm, identify_bag
from blf_dsc_controller.identification.prior import base_matrix
from blf_dsc_controller.identification.recording import read_recording
from blf_dsc_controller.messages.codecs import JointStateEncoder
from blf_dsc_controller.messages.topics import JOINT_STATE
from blf_dsc_controller.simulation.loop import simulate, write_bag

ROBOT = Robot(urdf=PANDA_TEXT)
TRUTH = truth_of(PANDA_CHAIN, 1)


def torques(text, rotors, seed=77):
    """Torques of a URDF along a motion that is in no bag, from pinocchio."""
    model = pinocchio_model(text, PANDA)
    model.armature[:] = rotors
    data, motion = model.createData(), reference_of(PANDA_CHAIN, seed).at(np.arange(0, 20, 0.05))
    return np.array([pinocchio.rnea(model, data, *row) for row in motion])


TRUE_TEXT = corrected_urdf(
    PANDA_TEXT, PANDA_CHAIN, TRUTH.inertias, TRUTH.viscous, TRUTH.coulomb, 'true'
)


def unseen_error(text, rotors):
    """Relative error of the torques along an unseen motion."""
    expected = torques(TRUE_TEXT, TRUTH.rotors)
    return np.linalg.norm(torques(text, rotors) - expected) / np.linalg.norm(expected)


def corrected(found):
    """The corrected URDF, with every body physical."""
    viscous, coulomb = found.dynamics
    text = corrected_urdf(PANDA_TEXT, found.chain, found.parts.bodies, viscous, coulomb, 'note')
    is_physical(text)
    return text


def is_physical(text):
    for body in read_chain(text, 'panda_link0', 'panda_hand_tcp', PANDA).inertias:
        assert np.linalg.eigvalsh(pseudo_inertia(body))[0] > 0.0


@pytest.fixture(scope='module')
def states():
    """A minute of our own plant, with 20 bit encoders and torque sensors of 1 % noise."""
    return measured(shake(PANDA_CHAIN, TRUTH, reference_of(PANDA_CHAIN, 2), 60.0), 3)


@pytest.fixture(scope='module')
def bag(states, tmp_path_factory):
    return write_states(tmp_path_factory.mktemp('identify') / 'bag', PANDA, states)


@pytest.fixture(scope='module')
def found(bag):
    return identify_bag(bag, ROBOT)


def test_corrected_urdf_predicts_the_torques_of_an_unseen_motion(found):
    assert unseen_error(PANDA_TEXT, np.zeros(7)) > 0.1
    text = corrected(found)
    assert unseen_error(text, found.parts.terms[0]) < 0.005
    assert mujoco.MjModel.from_xml_string(text).nq == 9  # MuJoCo loads it, fingers included


def test_values_match_the_truth_and_the_held_back_part_is_predicted(found):
    rotors, viscous, coulomb, _, offset = found.parts.terms[:5]
    np.testing.assert_allclose(viscous, TRUTH.viscous, rtol=0.01)
    np.testing.assert_allclose(coulomb, TRUTH.coulomb, rtol=0.01)
    # For the first joint only the sum with its link's inertia can be identified.
    np.testing.assert_allclose(rotors[1:], TRUTH.rotors[1:], rtol=0.02)
    assert (np.abs(offset) < 0.03).all()
    # Torques held over a period are half a period late.
    assert found.values[-1] == pytest.approx(0.5 * PERIOD, abs=0.2 * PERIOD)
    share = found.errors / found.torque
    assert (share[2] < 0.005).all()  # 1 % noise, averaged over windows of 200 samples
    assert (share[0] > 0.1).all()
    assert found.held_back[0] == pytest.approx(48.0, abs=0.2)


def test_confidence_intervals_contain_the_truth_as_often_as_stated():
    """95 % intervals, for arms drawn from the prior with different noise and motions."""
    inside = []
    for seed in range(6):
        truth = truth_of(PANDA_CHAIN, 10 + seed)
        motion = shake(PANDA_CHAIN, truth, reference_of(PANDA_CHAIN, 20 + seed), 20.0)
        found = identify_arm(recording_of(measured(motion, seed)), ROBOT)
        inside.append(is_covered(found, truth))
        masses = np.arange(0, 70, 10)
        off = np.abs(found.values[masses] - truth.inertias[:, 0])
        inside.append(off < 1.96 * np.sqrt(np.diag(found.covariance)[masses]))
    # 450 intervals, correlated within an arm: a few percent less would be chance; the bounds and
    # the correlation lengths are conservative.
    assert 0.92 < np.mean(np.concatenate(inside)) <= 1.0


def test_arm_simulated_in_mujoco_is_identified(tmp_path):
    """MuJoCo has another integrator, true stiction and efforts simultaneous with positions."""
    model = mujoco.MjModel.from_xml_string(TRUE_TEXT)
    model.opt.timestep = PERIOD
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    model.dof_armature[:7] = TRUTH.rotors
    model.dof_armature[7:] = 1e3  # keeps the fingers where they are
    data, reference = mujoco.MjData(model), reference_of(PANDA_CHAIN, 5)
    data.qpos[:7], data.qvel[:7], _ = reference.at(0.0)
    states = np.zeros((30_000, 3, 7))
    gains = np.array([87.0] * 4 + [12.0] * 3) / 4.0
    for k, state in enumerate(states):
        q, dq, _ = reference.at(k * PERIOD)
        feedback = 30.0 * (q - data.qpos[:7]) + 3.0 * (dq - data.qvel[:7])
        data.qfrc_applied[:7] = gains * feedback
        state[:] = data.qpos[:7], data.qvel[:7], data.qfrc_applied[:7]
        mujoco.mj_step(model, data)
    found = identify_bag(write_states(tmp_path / 'bag', PANDA, measured(states, 4)), ROBOT)
    assert unseen_error(corrected(found), found.parts.terms[0]) < 0.005


def test_small_motion_of_two_joints_leaves_other_parameters_at_the_prior():
    reference = reference_of(PANDA_CHAIN, 6)
    amplitude = np.zeros_like(reference.amplitude)
    amplitude[0, [1, 3]] = 0.1
    states = shake(PANDA_CHAIN, TRUTH, reference._replace(amplitude=amplitude), 20.0)
    found = identify_arm(recording_of(measured(states, 3)), ROBOT)
    corrected(found)
    G = base_matrix(found.parameters, 7)
    prior, posterior = (np.diag(G @ C @ G.T) for C in (found.prior_covariance, found.covariance))
    shown = dict(zip(found.parameters.combinations, posterior < 0.5 * prior, strict=False))
    assert not any(shown[name] for name in ('Izz7', 'Ixx7 - Iyy7', 'rotor7'))
    gravity_of_joint_4 = next(name for name in shown if name.startswith('m*cx4'))
    assert shown[gravity_of_joint_4]
    assert {PANDA[0], PANDA[2], PANDA[4], PANDA[6]} <= set(found.still)


def test_command_writes_the_urdf_and_prints_the_table(bag, tmp_path, capsys):
    urdf, out = tmp_path / 'robot.urdf', tmp_path / 'corrected.urdf'
    urdf.write_text(PANDA_TEXT)
    assert main(['identify', str(bag), '--urdf', str(urdf), '--out', str(out)]) == 0
    output = capsys.readouterr().out
    for word in ('panda_link7', 'rotor inertia', 'Izz1 + rotor1 + Iyy2', 'held back', 'delay of'):
        assert word in output
    assert 'NOT SHOWN' not in output
    is_physical(out.read_text())


def test_other_publishers_joint_names_and_orders_are_recognised(states, tmp_path):
    """A gripper on the same topic, joints in another order and one with another name."""
    published = ('elbow' if name == 'panda_joint4' else name for name in PANDA[::-1])
    arm, hand = JointStateEncoder(tuple(published)), JointStateEncoder(('panda_finger_joint1',))
    with BagWriter(tmp_path / 'bag', flush_interval=None) as bag:
        handle = bag.add_topic('/franka/joint_states', JOINT_STATE, [])
        for k, state in enumerate(states[:8000]):
            stamp = 1_000_000_000 + 1_000_000 * k
            bag.write(handle, bytes(arm.encode(stamp, *state[:, ::-1])), stamp)
            bag.write(handle, bytes(hand.encode(stamp, [0.0], [0.0], [0.0])), stamp)
    names = NameMap.parse(['panda_joint4=elbow'])
    recording = read_recording(tmp_path / 'bag', PANDA_TEXT, names=names)
    assert recording.joints == PANDA
    assert recording.source == 'effort of /franka/joint_states'
    np.testing.assert_allclose(recording.q, states[: len(recording.q), 0], atol=1e-12)
    np.testing.assert_allclose(recording.torque, states[: len(recording.q), 2], atol=1e-12)


@pytest.mark.parametrize('effort', ['torque', 'command'])
def test_commands_replace_efforts_that_are_missing_or_not_wanted(states, tmp_path, effort):
    """With `--effort command` those in the bag, here currents, are not used."""
    fields, some = FIELDS[: 2 + (effort == 'command')], states[:8000]
    currents = some * [[1.0], [1.0], [0.1]]
    write_states(tmp_path / 'bag', PANDA, currents, fields=fields, commands=some[:, 2])
    found = identify_bag(tmp_path / 'bag', ROBOT, effort=effort)
    assert found.source == '/arm/commands'
    assert not list(problems_of(found, effort))
    recording = read_recording(tmp_path / 'bag', PANDA_TEXT, commanded=effort == 'command')
    np.testing.assert_allclose(recording.torque, states[: len(recording.q), 2], atol=1e-12)


def test_lost_states_do_not_bias_the_result(states, found, tmp_path):
    with_gaps = states.copy()
    with_gaps[10_000:12_000] = np.nan  # neither positions nor torques
    with_gaps[30_000:30_050, 2] = np.nan
    bag = write_states(tmp_path / 'bag', PANDA, with_gaps)
    other = identify_bag(bag, ROBOT)
    assert unseen_error(corrected(other), other.parts.terms[0]) < 0.005
    np.testing.assert_allclose(other.parts.terms[1], found.parts.terms[1], rtol=0.01)


def test_bags_that_cannot_be_identified_are_rejected_for_their_reason(states, tmp_path):
    some, still = states[:8000], np.repeat(states[:1], 8000, axis=0)
    still[:, 2] += 1.0
    inner = tuple(name.replace('panda_joint4', 'elbow') for name in PANDA)
    bags = {
        'does not hold the torques': {'states': some, 'fields': ('position', 'velocity')},
        'are zero': {'states': some * [[1.0], [1.0], [0.0]]},
        'no joint of the URDF': {'states': some, 'joints': tuple(f'ur_{i}' for i in range(7))},
        "joint 'panda_joint4' is not in": {'states': some, 'joints': inner},
        'the bag holds 2 s': {'states': states[:2001]},
        'at least one in 0.02 s': {'states': some, 'period': 0.1},
        'no joint moves': {'states': still},
    }
    for k, (reason, given) in enumerate(bags.items()):
        bag = write_states(tmp_path / f'{k}', **{'joints': PANDA, **given})
        with pytest.raises(BlfDscError, match=re.escape(reason)):
            identify_bag(bag, ROBOT)


def test_states_with_odd_stamps_are_rejected_and_take_no_memory(states, tmp_path):
    """Resampled at their interval, an hour would be 26 TB."""
    for k, stamps in enumerate(((5, 6, 7), (*range(1, 6_000_000, 1_000_000), 3_600_000_000_000))):
        write_states(tmp_path / f'{k}', PANDA, states, stamps=stamps)
        with pytest.raises(BagError, match='are their stamps of one clock'):
            read_recording(tmp_path / f'{k}', PANDA_TEXT)
    with pytest.raises(BagError, match='a unique stamp'):
        read_recording(write_states(tmp_path / 'b', PANDA, states[:99], period=0.0), PANDA_TEXT)


def test_arm_of_the_paper_is_identified_from_its_urdf(tmp_path, capsys):
    """With its sinusoidal disturbance, which lasts; not to be mistaken for noise."""
    plant = {'duration': 20.0, 'arm.m2': 0.7}
    config = load_loop('recommended', {PLANT: plant})
    run = simulate(config.controller, config.plant)
    write_bag(tmp_path / 'bag', run, config.plant)
    robot = Robot(urdf='two_link.urdf', gravity=(0.0, 0.0, -9.8))
    found = identify_bag(tmp_path / 'bag', robot)
    K = base_matrix(found.parameters, 2)[: len(found.parameters.combinations)]
    shown = dict(zip(found.parameters.combinations, K @ found.values, strict=True))
    assert shown['m*cx2'] == pytest.approx(0.7 * 0.8, rel=0.02)
    assert shown['m*cx1 + m2'] == pytest.approx(0.5 + 0.7, rel=0.05)
    bag, out = str(tmp_path / 'bag'), str(tmp_path / 'new.urdf')
    command = ['identify', bag, '--urdf', 'two_link.urdf', '--gravity', '0', '0', '-9.8']
    assert main([*command, '--out', out]) == 0
    assert 'the residual of joint1 lasts' in capsys.readouterr().out


def test_gravity_depends_on_the_mounting(states):
    """With the gravity of a ceiling mount the same motion cannot be explained."""
    hanging = Robot(urdf=PANDA_TEXT, gravity=(0.0, 0.0, 9.81))
    wrong = identify_arm(recording_of(states), hanging)
    assert np.linalg.norm(wrong.errors[2]) > 0.1 * np.linalg.norm(wrong.torque)
    assert ROBOT.gravity == GRAVITY
