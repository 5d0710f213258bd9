# SPDX-License-Identifier: Apache-2.0
"""Identification of an arm from bags of our plant and of MuJoCo: confidence, terms, loads."""

from __future__ import annotations

import os
import re

import mujoco
import numpy as np
import pinocchio
import pytest
from friction_laws import with_friction
from nights import at_night
from random_arm import (
    FIELDS,
    GRAVITY,
    PANDA,
    PANDA_CHAIN,
    PANDA_TEXT,
    PERIOD,
    changed,
    holding,
    is_covered,
    measured,
    pinocchio_model,
    random_urdf,
    recording_of,
    reference_of,
    shake,
    shake_elastic,
    truth_of,
    write_states,
)
from scipy.integrate import solve_ivp

from blf_dsc_controller import BlfDscError, load_loop, simulate
from blf_dsc_controller.arms.base_parameters import base_parameters
from blf_dsc_controller.arms.inertia import pseudo_inertia
from blf_dsc_controller.arms.model import regressors_at
from blf_dsc_controller.arms.urdf import read_chain
from blf_dsc_controller.bags.content import NameMap
from blf_dsc_controller.cli import identify as command
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.configuration.nodes import PLANT
from blf_dsc_controller.configuration.robot import Robot
from blf_dsc_controller.identification.corrected_urdf import corrected_urdf
from blf_dsc_controller.identification.from_files import identify_bag, read_recording
from blf_dsc_controller.identification.identify import identify_arm
from blf_dsc_controller.identification.problems import problems_of
from blf_dsc_controller.identification.sliding import sliding_direction
from blf_dsc_controller.identification.summary import notes_of
from blf_dsc_controller.identification.values import base_matrix
from blf_dsc_controller.simulation.loop import write_bag

ROBOT = Robot(urdf=PANDA_TEXT)
ARMS = 6 if os.environ.get('NIGHTLY') else 2
TRUTH = truth_of(PANDA_CHAIN, 1)


def torques(text, rotors, seed=77):
    """Torques of a URDF along a motion that is in no bag, from pinocchio."""
    model = pinocchio_model(text, PANDA)
    model.armature[:] = rotors
    data = model.createData()
    motion = reference_of(PANDA_CHAIN, seed).at(np.arange(0, 20, 0.05))
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
    text = corrected_urdf(
        PANDA_TEXT, found.chain, found.parts.bodies, viscous, coulomb, 'note'
    )
    is_physical(text)
    return text


def is_physical(text):
    for body in read_chain(text, 'panda_link0', 'panda_hand_tcp', PANDA).inertias:
        assert np.linalg.eigvalsh(pseudo_inertia(body))[0] > 0.0


@pytest.fixture(scope='module')
def states():
    """40 s of our own plant, with 20 bit encoders and torque sensors of 1 % noise."""
    return measured(shake(PANDA_CHAIN, TRUTH, reference_of(PANDA_CHAIN, 2), 40.0), 3)


@pytest.fixture(scope='module')
def found(states, tmp_path_factory):
    return identify_bag(
        write_states(tmp_path_factory.mktemp('bag') / 'bag', PANDA, states), ROBOT
    )


def test_corrected_urdf_predicts_the_torques_of_an_unseen_motion(found):
    assert unseen_error(PANDA_TEXT, np.zeros(7)) > 0.1
    text = corrected(found)
    assert unseen_error(text, found.parts.terms[0]) < 0.005
    # MuJoCo loads it, fingers included
    assert mujoco.MjModel.from_xml_string(text).nq == 9


def test_values_match_the_truth_and_the_held_back_part_is_predicted(found):
    rotors, viscous, coulomb, _, offset = found.parts.terms[:5]
    np.testing.assert_allclose(viscous, TRUTH.viscous, rtol=0.01)
    np.testing.assert_allclose(coulomb, TRUTH.coulomb, rtol=0.01)
    # For the first joint only the sum with its link's inertia can be identified.
    np.testing.assert_allclose(rotors[1:], TRUTH.rotors[1:], rtol=0.02)
    assert (np.abs(offset) < 0.03).all()
    # Torques held over a period are half a period late.
    assert found.values[-1] == pytest.approx(0.5 * PERIOD, abs=0.2 * PERIOD)
    share = found.score.errors / found.score.torque
    assert (share[2] < 0.005).all()  # 1 % noise, averaged over windows of 200 samples
    assert (share[0] > 0.1).all()
    assert found.score.held_back[0] == pytest.approx(32.0, abs=0.2)


def test_confidence_intervals_contain_the_truth_as_often_as_stated():
    """95 % intervals, for arms drawn from the prior with different noise and motions."""
    inside = []
    for seed in range(ARMS):
        truth = truth_of(PANDA_CHAIN, 10 + seed)
        motion = shake(PANDA_CHAIN, truth, reference_of(PANDA_CHAIN, 20 + seed), 20.0)
        found = identify_arm(recording_of(measured(motion, seed)), ROBOT)
        inside.append(is_covered(found, truth))
        masses = np.arange(0, 70, 10)
        off = np.abs(found.values[masses] - truth.inertias[:, 0])
        inside.append(off < 1.96 * np.sqrt(np.diag(found.covariance)[masses]))
    # 75 intervals of each arm, correlated: a few percent less would be chance; the bounds and the
    # correlation lengths are conservative.
    assert 0.92 < np.mean(np.concatenate(inside)) <= 1.0


def test_arm_simulated_in_mujoco_is_identified(tmp_path):
    """MuJoCo has another integrator, true stiction and efforts simultaneous with positions."""
    model = mujoco.MjModel.from_xml_string(TRUE_TEXT)
    model.opt.timestep = PERIOD
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    model.dof_armature[:7] = TRUTH.rotors
    model.dof_armature[7:] = 1e3  # keeps the fingers where they are
    data = mujoco.MjData(model)
    reference = reference_of(PANDA_CHAIN, 5)
    data.qpos[:7], data.qvel[:7], _ = reference.at(0.0)
    states = np.zeros((20_000, 3, 7))
    gains = np.array([87.0] * 4 + [12.0] * 3) / 4.0
    for k, state in enumerate(states):
        q, dq, _ = reference.at(k * PERIOD)
        feedback = 30.0 * (q - data.qpos[:7]) + 3.0 * (dq - data.qvel[:7])
        data.qfrc_applied[:7] = gains * feedback
        state[:] = data.qpos[:7], data.qvel[:7], data.qfrc_applied[:7]
        mujoco.mj_step(model, data)
    found = identify_bag(
        write_states(tmp_path / 'bag', PANDA, measured(states, 4)), ROBOT
    )
    assert unseen_error(corrected(found), found.parts.terms[0]) < 0.005


@pytest.mark.parametrize('effort', ['torque', 'command'])
def test_commands_replace_efforts_that_are_missing_or_not_wanted(
    states, tmp_path, effort
):
    """With `--effort command` those in the bag, here currents, are not used; names are mapped."""
    names = NameMap.parse(['panda_joint4=elbow'])
    joints = [names.joints.get(joint, joint) for joint in PANDA]
    fields = FIELDS[: 2 + (effort == 'command')]
    some = states[:8000]
    currents = some * [[1.0], [1.0], [0.1]]
    write_states(tmp_path / 'bag', joints, currents, fields=fields, commands=some[:, 2])
    stages = []
    found = identify_bag(
        tmp_path / 'bag', ROBOT, names=names, effort=effort, begin=stages.append
    )
    assert len(stages) > 3
    assert found.source == '/arm/commands'
    assert not list(problems_of(found, effort))
    commanded = effort == 'command'
    recording = read_recording(
        tmp_path / 'bag', PANDA_TEXT, names=names, commanded=commanded
    )
    assert recording.joints == PANDA
    np.testing.assert_allclose(
        recording.torque, states[: len(recording.q), 2], atol=1e-12
    )


def test_lost_states_do_not_bias_the_result(states, found, tmp_path):
    with_gaps = states.copy()
    with_gaps[10_000:12_000] = np.nan  # neither positions nor torques
    with_gaps[30_000:30_050, 2] = np.nan
    bag = write_states(tmp_path / 'bag', PANDA, with_gaps)
    other = identify_bag(bag, ROBOT)
    assert unseen_error(corrected(other), other.parts.terms[0]) < 0.005
    np.testing.assert_allclose(other.parts.terms[1], found.parts.terms[1], rtol=0.01)


def test_bags_that_cannot_be_identified_are_rejected_for_their_reason(states, tmp_path):
    some = states[:8000]
    still = np.repeat(states[:1], 8000, axis=0)
    still[:, 2] += 1.0
    inner = tuple(name.replace('panda_joint4', 'elbow') for name in PANDA)
    bags = {
        'does not hold the torques': {
            'states': some,
            'fields': ('position', 'velocity'),
        },
        'are zero': {'states': some * [[1.0], [1.0], [0.0]]},
        'no joint of the URDF': {
            'states': some,
            'joints': tuple(f'ur_{i}' for i in range(7)),
        },
        "joint 'panda_joint4' is not in": {'states': some, 'joints': inner},
        'the recording lasts 2 s': {'states': states[:2001]},
        'at least one in 0.02 s': {'states': some, 'period': 0.1},
        'no joint moves': {'states': still},
    }
    for k, (reason, given) in enumerate(bags.items()):
        bag = write_states(tmp_path / f'{k}', **{'joints': PANDA, **given})
        with pytest.raises(BlfDscError, match=re.escape(reason)):
            identify_bag(bag, ROBOT)


def test_states_with_odd_stamps_are_rejected_and_take_no_memory(states, tmp_path):
    """Resampled at their interval, an hour would be 26 TB."""
    for k, stamps in enumerate(
        (range(5, 15), (*range(1, 11_000_000, 1_000_000), 3_600_000_000_000))
    ):
        write_states(tmp_path / f'{k}', PANDA, states, stamps=stamps)
        with pytest.raises(BlfDscError, match='are their stamps of one clock'):
            read_recording(tmp_path / f'{k}', PANDA_TEXT)
    with pytest.raises(BlfDscError, match='a unique stamp'):
        read_recording(
            write_states(tmp_path / 'b', PANDA, states[:99], period=0.0), PANDA_TEXT
        )


@pytest.fixture
def paper_bag(tmp_path):
    """Bag of the paper's arm, with its sinusoidal disturbance, along a preset's reference."""

    def write(preset):
        plant = {'duration': 20.0, 'arm.m2': 0.7}
        config = load_loop(preset, {PLANT: plant})
        run = simulate(config.controller, config.plant)
        write_bag(tmp_path / preset, run, config.plant)
        return tmp_path / preset

    return write


def test_arm_of_the_paper_is_identified_from_its_urdf(paper_bag):
    """Along this reference, the disturbance does not look like a parameter."""
    robot = Robot(urdf='two_link.urdf', gravity=(0.0, 0.0, -9.8))
    found = identify_bag(paper_bag('two_tone'), robot)
    K = base_matrix(found.parameters, 2)[: len(found.parameters.combinations)]
    shown = dict(zip(found.parameters.combinations, K @ found.values, strict=True))
    assert shown['m*cx2'] == pytest.approx(0.7 * 0.8, rel=0.02)
    assert shown['m*cx1 + m2'] == pytest.approx(0.5 + 0.7, rel=0.02)


def test_disturbance_that_lasts_is_not_mistaken_for_noise(paper_bag, tmp_path, capsys):
    words = ['identify', str(paper_bag('recommended')), '--urdf', 'two_link.urdf']
    words += ['--gravity', '0', '0', '-9.8', '--out', str(tmp_path / 'new.urdf')]
    assert main(words) == 0
    assert 'the residual of joint1 lasts' in capsys.readouterr().out


LOAD = 2.0  # kg, a ball ...
CENTRE = (0.02, -0.03, 0.05)  # m, ... in the tip
BASE = base_parameters(PANDA_CHAIN, GRAVITY)
AT_TIP = Robot(urdf=PANDA_TEXT, tip='panda_hand_tcp')


def moved(duration, seed=2, truth=TRUTH):
    """States (N, 3, n) of a motion with viscous and Coulomb friction."""
    return shake(PANDA_CHAIN, truth, reference_of(PANDA_CHAIN, seed), duration)


def gravity_of(inertias, q):
    """Torque of gravity (N, n) at the positions (N, n)."""
    still = np.zeros_like(q)
    return regressors_at(BASE.model, q, still, still, still) @ BASE.of(
        inertias, np.zeros(7)
    )


def identified(states, *arguments, robot=AT_TIP, every=1):
    """What is found if every state, or one of so many, is recorded."""
    seen = measured(states, 3)[::every]
    return identify_arm(recording_of(seen, period=every * PERIOD), robot, *arguments)


@pytest.fixture(scope='module')
def plain():
    return moved(20.0)


@pytest.fixture(scope='module')
def simple(plain):
    return identified(plain)


def total(found):
    return np.linalg.norm(found.score.errors[2]) / np.linalg.norm(found.score.torque)


def test_terms_that_the_data_do_not_show_are_left_out(simple):
    load, stribeck, quadratic = simple.parts.terms[[3, 5, 6]]
    assert not load.any()
    assert not simple.parts.coupling.any()
    # of 14, by chance
    assert np.count_nonzero(stribeck) + np.count_nonzero(quadratic) <= 1


def test_load_friction_and_stribeck_friction_are_recognised(plain):
    states = plain.copy()
    gravity = gravity_of(TRUTH.inertias, plain[:, 0])
    v = states[:, 1]
    sliding = np.tanh(v / 0.005)  # as the plant's own friction
    states[:, 2] += 0.06 * np.abs(gravity) * sliding
    states[:, 2, 3] += 3.0 * sliding[:, 3] * np.exp(-((v[:, 3] / 0.1) ** 2))
    states[:, 2, 0] += 3.0
    found = identified(states)
    assert total(found) < 0.005
    np.testing.assert_allclose(found.parts.terms[3, [1, 3]], 0.06, rtol=0.1)
    assert found.parts.terms[5, 3] == pytest.approx(3.0, rel=0.1)
    # The URDF has viscous and Coulomb friction only: they take over what they can.
    assert found.score.errors[1, 3] < 0.2 * found.score.errors[0, 3]
    # An offset is not friction.
    assert found.parts.terms[4, 0] == pytest.approx(3.0, rel=0.01)
    expected = TRUTH.viscous[0], TRUTH.coulomb[0]
    np.testing.assert_allclose(found.dynamics[:, 0], expected, rtol=0.02)


@pytest.fixture
def identified_by_command(monkeypatch):
    """Run `blf_dsc identify` with some words, and return what it found."""
    found = []

    def identify_and_keep(*arguments, **options):
        found.append(identify_bag(*arguments, **options))
        return found[-1]

    def run(*words):
        assert main(['identify', *map(str, words)]) == 0
        return found.pop()

    monkeypatch.setattr(command, 'identify_bag', identify_and_keep)
    return run


def test_coupled_wrist_is_recognised_and_named_in_table_and_report(
    plain, tmp_path, capsys, identified_by_command
):
    states = plain.copy()
    h = PERIOD
    others = states[:, 1, [6, 5]]
    both = np.sign(states[:, 1, 5:].sum(axis=1, keepdims=True))
    states[:, 2, 5:] += (
        0.02 * np.gradient(others, h, axis=0) + 0.3 * others + 0.8 * both
    )
    bag = write_states(tmp_path / 'bag', PANDA, measured(states, 3))
    urdf, out, page = (
        tmp_path / name for name in ('robot.urdf', 'new.urdf', 'page.html')
    )
    urdf.write_text(PANDA_TEXT)
    found = identified_by_command(bag, '--urdf', urdf, '--out', out, '--report', page)
    np.testing.assert_allclose(found.parts.coupling, (0.02, 0.3, 0.8), rtol=0.05)
    output = capsys.readouterr().out
    assert 'one motor drives panda_joint6 and panda_joint7' in output
    assert 'Izz1 + rotor1 + Iyy2' in output
    assert 'NOT SHOWN' not in output
    is_physical(out.read_text())
    text = page.read_text()
    assert all(words in text for words in ('s of 7 joints', 'panda_link7', '<img'))


def test_rest_at_the_end_is_left_out(plain, simple):
    states = plain
    resting = np.vstack((states, np.repeat(states[-1:], 10_000, axis=0)))
    resting[len(states) :, 1] = 0.0
    resting[len(states) :, 2] += 5.0  # stiction, which is no fault of the model
    recording = recording_of(measured(resting, 3))
    recording.gap[len(states)] = True  # it stops between two samples
    other = identify_arm(recording, AT_TIP)
    assert other.rest == pytest.approx(10.0, abs=0.5)
    assert other.score.held_back[1] < 20.5
    assert total(other) == pytest.approx(total(simple), rel=0.2)
    assert not list(problems_of(other, 'torque'))


@pytest.mark.nightly
def test_efforts_with_and_without_gravity_are_named_if_the_other_was_said(plain):
    short = plain[:12_000]
    gravity = gravity_of(TRUTH.inertias, short[:, 0])
    without = short - gravity[:, None] * [[0.0], [0.0], [1.0]]
    missing = identified(without, every=10)
    assert 'GRAVITY IS MISSING' in next(problems_of(missing, 'torque'))
    whole = identified(short, 'without-gravity', every=10)
    assert 'GRAVITY IS DOUBLE' in next(problems_of(whole, 'without-gravity'))


def test_efforts_without_gravity_are_used(plain, simple):
    # The drive compensates the gravity of the URDF exactly: then this is the whole torque.
    without = plain.copy()
    without[:, 2] -= gravity_of(PANDA_CHAIN.inertias, plain[:, 0])
    right = identified(without, 'without-gravity')
    assert total(right) < 2.0 * total(simple)
    assert not list(problems_of(right, 'without-gravity'))


def is_the_load(found):
    value, deviation = found.load
    off = np.abs(value - (LOAD, *CENTRE))
    assert off[0] < 0.05 * LOAD
    assert (off[1:] < 0.005).all()
    assert (off < 4.0 * deviation).all()


@pytest.fixture(scope='module')
def loaded():
    return moved(20.0, 5, holding(TRUTH, LOAD, CENTRE))


def test_load_that_is_picked_up_is_found_and_weighed(
    plain, loaded, tmp_path, capsys, identified_by_command
):
    """The change is found; the jump from one motion to the other is a gap of the recording."""
    bag = tmp_path / 'bag'
    jump = np.full((10, 3, 7), np.nan)
    write_states(bag, PANDA, np.vstack((plain, jump, loaded)))
    urdf = tmp_path / 'robot.urdf'
    urdf.write_text(PANDA_TEXT)
    tip = '--tip', AT_TIP.tip
    found = identified_by_command(bag, '--urdf', urdf, *tip, '--payload')
    assert found.carried.begin == pytest.approx(20.0, abs=1.0)
    is_the_load(found)
    assert 'load from' in capsys.readouterr().out


@pytest.mark.parametrize('seed', range(2))
def test_corrected_random_urdf_has_the_given_bodies(seed):
    """With links fixed to links, links without inertias and empty tags."""
    text, joints = random_urdf(4, seed)
    text = re.sub('<link name="l1">.*?</link>', '<link name="l1" note="a > b" />', text)
    chain = read_chain(text, 'base', 'tip', joints)
    bodies = changed(chain, np.random.default_rng(seed))
    friction = np.arange(1.0, 5.0)
    new = corrected_urdf(text, chain, bodies, friction, 0.1 * friction, 'a -- b')
    again = read_chain(new, 'base', 'tip', joints)
    np.testing.assert_allclose(again.inertias, bodies, rtol=1e-9, atol=1e-9)
    assert [joint.damping for joint in again.joints] == friction.tolist()
    model = pinocchio_model(new, joints)
    inertias = np.array(
        [inertia.toDynamicParameters() for inertia in list(model.inertias)[1:]]
    )
    np.testing.assert_allclose(inertias, bodies, rtol=1e-9, atol=1e-9)


def test_rest_of_the_file_is_unchanged():
    text = PANDA_TEXT.replace(
        '<mass value="0.73" />', '<mass value="0.73" /><!-- a guess -->'
    )
    text = text.replace('name="panda_link1"', "name='panda_link1'  note='a > b'", 1)
    friction = np.ones(7)
    new = corrected_urdf(
        text, PANDA_CHAIN, 1.1 * PANDA_CHAIN.inertias, friction, friction, 'note'
    )
    changed_parts = (
        r'<inertial>.*?</inertial>|\s*<dynamics[^>]*>|<!--\nnote\n-->\n|\s+(?=</joint>)'
    )

    def rest(urdf):
        return re.sub(changed_parts, '', urdf, flags=re.DOTALL)

    assert rest(new) == rest(text)
    assert new.count('<dynamics damping="1" friction="1" />') == 7
    for kept in ('panda_link0', 'panda_leftfinger', 'panda_rightfinger'):
        link = rf'<link name="{kept}">.*?</link>'
        assert re.search(link, new, re.DOTALL)[0] == re.search(link, text, re.DOTALL)[0]
    chain = read_chain(new, 'panda_link0', 'panda_hand_tcp', PANDA)
    np.testing.assert_allclose(chain.inertias, 1.1 * PANDA_CHAIN.inertias, atol=1e-9)
    twice = corrected_urdf(new, chain, chain.inertias, friction, friction, '')
    assert twice.count('<inertial>') == new.count('<inertial>')
    assert twice.count('<dynamics') == 7


def test_sliding_direction_solves_the_equation_of_dahl():
    """Against scipy's integrator, along a motion with reversals and a rest."""
    t = np.linspace(0.0, 6.0, 6001)

    def speed(time):
        return np.where(time < 4.0, 0.01 * np.sin(3.0 * time), 0.0)

    distance = 2e-3
    exact = solve_ivp(
        lambda time, s: (speed(time) - np.abs(speed(time)) * s) / distance,
        (t[0], t[-1]),
        [0.0],
        t_eval=t,
        rtol=1e-8,
        max_step=0.01,
    ).y[0]
    q = 0.01 / 3.0 * (1.0 - np.cos(3.0 * np.minimum(t, 4.0)))  # its integral
    found = sliding_direction(q[:, None], speed(t)[:, None], np.array([distance]))
    np.testing.assert_allclose(found[:, 0], exact, atol=2e-3)
    assert np.ptp(found[4000:]) == 0.0  # at rest it stays


def test_contacts_that_yield_at_reversals_are_found(plain):
    """Coulomb friction of joint 2 builds up over 1 mrad."""
    states = plain.copy()
    contacts = np.zeros(7)
    contacts[1] = 1e-3
    s = sliding_direction(states[:, 0], states[:, 1], contacts)
    states[:, 2, 1] += 5.0 * s[:, 1]
    found = identified(states)
    assert found.distances[1] in (3e-4, 1e-3, 3e-3)
    assert total(found) < 0.005
    found_friction = found.parts.terms[2, 1] - TRUTH.coulomb[1]
    assert found_friction == pytest.approx(5.0, rel=0.05)


# What is said of doubtful recordings.


def mentions(found, words):
    return any(words in note for note in notes_of(found))


def test_recording_without_faults_has_neither_problems_nor_these_notes(simple):
    assert not list(problems_of(simple, 'torque'))
    for words in (
        *('is long', 'has an offset', 'hardly needs', 'predicts worse'),
        *('more than the model has terms for', 'cannot be known', 'not explained'),
    ):
        assert not mentions(simple, words)


@pytest.mark.parametrize(
    ('milliseconds', 'late'), [(20, 'torques'), *at_night((-20, 'positions'))]
)
def test_long_delay_is_named_with_what_is_late(plain, milliseconds, late):
    samples = round(1e-3 * milliseconds / PERIOD)
    states = plain.copy()
    states[:, 2] = np.roll(plain[:, 2], samples, axis=0)
    found = identified(states[abs(samples) : -abs(samples)])
    assert found.values[-1] == pytest.approx(1e-3 * milliseconds, abs=2e-3)
    assert mentions(found, f'{milliseconds} ms is long: are the {late} filtered')


def test_offset_for_which_a_urdf_has_no_place_is_named(plain):
    states = plain.copy()
    states[:, 2, 4] += 1.5
    found = identified(states)
    assert mentions(found, f'{PANDA[4]} has an offset of 1.5 N m')
    assert not mentions(found, f'{PANDA[1]} has an offset')


@pytest.mark.parametrize('what', ['elasticity', *at_night('gain')])
def test_intervals_hold_where_the_arm_is_not_as_its_model_says(what):
    """Torques of sensors whose gains are up to 20 % off, and motors behind springs.

    Without the wider model, 30 and 64 % of the intervals hold; of 95 %, ten less allow for chance.
    """
    truth = truth_of(PANDA_CHAIN, 0)
    zero = np.zeros(7)
    smooth = truth._replace(viscous=zero, coulomb=zero)
    random = np.random.default_rng(0)
    if what == 'gain':
        motion = moved(20.0, 0, smooth)
    else:
        stiffness = random.uniform(1e4, 3e4, 7)
        reference = reference_of(PANDA_CHAIN, 0)
        motion = shake_elastic(smooth, stiffness, reference, 20.0)
    states = with_friction('Coulomb', motion, truth.viscous, truth.coulomb, 0)
    if what == 'gain':
        states[:, 2] *= random.uniform(0.8, 1.2, 7)
    found = identify_arm(
        recording_of(measured(states, 0)[::10], period=10 * PERIOD), AT_TIP
    )
    off = np.abs(found.parts.terms[0] - truth.rotors)
    held = [*is_covered(found, truth), *(off < 1.96 * found.deviations.terms[0])]
    assert np.mean(held) >= 0.85
    words = {
        'gain': 'KNOWN UP TO THESE GAINS ONLY',
        'elasticity': 'are elastic behind',
    }[what]
    assert mentions(found, words)
