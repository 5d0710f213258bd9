# SPDX-License-Identifier: Apache-2.0
"""Commissioning: motions, responses against the linear arm, gains, and what cannot be measured."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import blf_dsc_controller as blf
from blf_dsc_controller import (
    BlfDscError,
    ControllerConfig,
    PlantConfig,
    change,
    load_loop,
    share_folder,
    simulate,
)
from blf_dsc_controller.analysis import figures
from blf_dsc_controller.arms.joint_gains import linear
from blf_dsc_controller.arms.linear_loop import (
    Joints,
    Loop,
    Timing,
    arm_response,
)
from blf_dsc_controller.arms.model import inertia_matrices
from blf_dsc_controller.arms.urdf import frames
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.commissioning import simulated
from blf_dsc_controller.configuration.schema import build, flatten
from blf_dsc_controller.factory.settings import settings_of_config
from blf_dsc_controller.reference.approach import reference_of
from blf_dsc_controller.reference.terms import sampled
from blf_dsc_controller.run import FIRST_STAMP, Oscillation, Stop
from blf_dsc_controller.warnings.expected_errors import expected_errors

ROTORS = (0.3, 0.1)  # kg m^2
SPRINGS = (3e3, 1.5e3)  # N m/rad: free resonances of 26 and 29 Hz
VISCOUS = (2.0, 1.0)  # N m s/rad
ROBOT = {
    'robot.urdf': (share_folder() / 'config' / 'two_link.urdf').read_text(),
    'robot.gravity': [0.0, 0.0, 0.0],
    'robot.rotor_inertia': list(ROTORS),
    'robot.lag': 0.001,
}
GIVEN = {**ROBOT, 'robot.payload': 0.1}
CONFIG = build(ControllerConfig, GIVEN)
POSTURE = np.array([0.3, 1.1])
TIMING = Timing(1e-3, delay=1)
ARM = build(
    PlantConfig,
    ROBOT
    | {
        'truth.rotor_inertia': list(ROTORS),
        'joint.stiffness': list(SPRINGS),
        'disturbance.constant': [0.0, 0.0],
        'disturbance.amplitude': [0.0, 0.0],
        'disturbance.viscous': list(VISCOUS),
        'actuator.delay': 1,
    },
)


@cache
def planned():
    """Return the motion around POSTURE."""
    return blf.Commissioning(CONFIG).motion(POSTURE)


@cache
def sliding():
    """Return the motion around POSTURE that keeps joints sliding."""
    return blf.Commissioning(CONFIG).sliding(POSTURE)


@cache
def seen():
    """Return the run of the simulated arm around POSTURE, without friction but viscous."""
    return simulated.measured(planned(), ARM)


@cache
def found():
    """Return what it shows."""
    return result_of(CONFIG, seen())


def result_of(config, *runs, **options):
    return blf.Commissioning(config, **options).result(runs)


def true_loop(gains, inertia):
    """Return the linear loop of the simulated arm with gains of its joints."""
    settings = settings_of_config(CONFIG)
    P = settings.initial_estimate[: settings.p]
    links = inertia_matrices(settings.model, P, POSTURE[None]) - np.diag(ROTORS)
    joints = Joints(np.array(ROTORS), np.array(VISCOUS), np.array(SPRINGS))
    return Loop(links, joints, TIMING, linear(gains, inertia, 1))


@pytest.mark.parametrize('motion', [planned, sliding])
def test_motion_begins_at_rest_and_keeps_its_limits(motion):
    made = motion().excitation
    reference = reference_of(motion().config)
    times = np.linspace(0.0, made.period, 20_000)
    q, dq, _ = sampled(reference, times).transpose(1, 0, 2)
    start = sampled(reference, [0.0])[0]
    np.testing.assert_allclose(start[1:], 0.0, atol=1e-7)
    np.testing.assert_allclose(start[0], POSTURE, atol=1e-9)
    chain = CONFIG.robot.chain(CONFIG.joints)
    tips = frames(chain, q)[-1][:, :3, 3]
    middle = frames(chain, POSTURE)[-1][:3, 3]
    travel = np.linalg.norm(tips - middle, axis=1).max()
    assert travel == pytest.approx(made.travel, rel=1e-2)  # of samples between others
    least = 0.4 if made.sliding else 0.5  # swings are as fast as they should be
    assert least * 0.01 < travel <= 0.0101
    np.testing.assert_allclose(np.abs(dq).max(axis=0), made.speed, rtol=0.05)


@pytest.mark.parametrize('travel', [1e-4, 1e-3, 0.1])
def test_travel_is_what_is_permitted(travel):
    commissioning = blf.Commissioning(CONFIG, travel=travel)
    shaken, slid = commissioning.motion(POSTURE), commissioning.sliding(POSTURE)
    for made in (shaken.excitation, slid.excitation):
        assert made.travel <= travel
        assert (made.speed <= 0.25 * np.array(CONFIG.limits.velocity)).all()
    if travel <= 1e-3:  # all of it is used
        assert slid.excitation.travel > 0.95 * travel


def test_a_joint_that_hardly_moves_the_tool_stays_within_its_limits():
    """The last wrist of a YAM, 50 mrad from its limit, would swing by 97 mrad otherwise."""
    yam = blf.load_loop('yam').controller  # whose motors close its feedback
    config = blf.change(yam, {'insist': ['feedback.stiffness']})
    commissioning = blf.Commissioning(config)
    posture = np.zeros(6)
    posture[1:3] = 1.2
    posture[5] = config.limits.position_upper[5] - 0.05
    for near in (commissioning.motion(posture), commissioning.sliding(posture)):
        times = np.linspace(0.0, near.excitation.period, 20_000)
        q = sampled(reference_of(near.config), times)[:, 0]
        assert (q >= config.limits.position_lower).all()
        # a fifth of the way is left for errors, and the last step of getting smaller is 5 %
        assert 0.036 < (q[:, 5] - posture[5]).max() < 0.0401


def test_responses_are_those_of_the_linear_arm():
    """Of springs, motors, delay and hold, at lines from 2 to 120 Hz."""
    (response,) = found().responses
    loop = true_loop(found().start, found().loops.inertia)
    s = 2j * np.pi * response.frequency
    G = arm_response(loop.links, loop.joints, TIMING, s)[0]
    size = np.linalg.norm(G, axis=(1, 2))
    error = np.linalg.norm(response.position - G, axis=(1, 2)) / size
    assert np.median(error) < 0.03
    # Where G peaks, 1 / 8 Hz between the lines of the joints are much, but not of its inverse,
    # which is J omega^2 while the arm is rigid, and twenty times as much at 120 Hz.
    inverses = np.linalg.inv(response.position) - np.linalg.inv(G)
    inertia = np.linalg.norm(np.diag(loop.links[0]) + ROTORS)
    error = np.linalg.norm(inverses, axis=(1, 2)) / (inertia * np.abs(s) ** 2)
    assert np.median(error) < 0.05
    assert error.max() < 0.15


def test_inertia_and_lags_are_found():
    findings = found().findings
    M = true_loop(found().start, found().loops.inertia).links[0]
    # the motors are behind springs, which adds some percent at 12 Hz
    np.testing.assert_allclose(findings.inertia, np.diag(M) + ROTORS, rtol=0.1)
    # one sample of delay and half of one for which torques are held
    assert findings.drive_lag == pytest.approx(1.5e-3, abs=1e-3)
    assert findings.velocity_lag < 1e-3
    assert findings.rate == pytest.approx(1000.0)
    assert findings.lost == 0.0
    assert findings.jitter < 1e-12  # s, of rounding


def test_lag_of_the_drives_is_written():
    """Of 5 samples of delay and half of one, beside the 1.5 ms that every loop has."""
    late = change(ARM, {'actuator.delay': 5})
    result = result_of(CONFIG, simulated.measured(planned(), late))
    assert result.parameters_but_bounds()['robot.lag'] == pytest.approx(4e-3, abs=1e-3)
    assert found().parameters()['robot.lag'] < 1e-3


def test_chosen_gains_have_the_margin_of_the_true_loop_and_twice_of_them_do_not():
    choice = found().choice
    assert choice.margin.value >= 0.5
    inertia = found().loops.inertia
    true = true_loop(choice.gains, inertia).margin()
    assert true.value == pytest.approx(choice.margin.value, abs=0.1)
    twice = true_loop(choice.gains.scaled(2.0), inertia).margin()
    assert twice.value < 0.4


def test_gains_have_the_margin_where_resonances_are_sharp():
    """Hardly damped, they are higher between two lines of the motion than at any of them."""
    viscous = [0.2, 0.1]  # N m s/rad
    sharp = change(ARM, {'disturbance.viscous': viscous})
    result = result_of(CONFIG, simulated.measured(planned(), sharp))
    loop = true_loop(result.choice.gains, result.loops.inertia)
    loop = loop._replace(joints=loop.joints._replace(viscous=np.array(viscous)))
    assert result.has_margin
    assert loop.margin().value > 0.4


def test_friction_does_not_hide_where_the_loop_is_unstable():
    """In one direction Coulomb friction damps nothing: the loop without it is the true one.

    Of an arm that sticks, one measures its friction instead: gains that seem to have the
    margin are beyond the limit of stability.  So it is measured again with swings, and once
    more with more torque, since much noise is left by friction.
    """
    rubbing = change(
        ARM, {'disturbance.coulomb': [1.0, 0.5], 'disturbance.stribeck': 0.5}
    )
    commissioning = blf.Commissioning(CONFIG, [POSTURE])
    (first,) = commissioning.motions
    run, config = simulated.measured(first, rubbing)
    stuck = result_of(CONFIG, (run, config))
    assert stuck.has_margin
    assert true_loop(stuck.choice.gains, stuck.loops.inertia).margin().value == 0.0
    again = commissioning.plan_repeat(first, run)
    assert not first.excitation.sliding
    assert commissioning.motion(POSTURE).excitation.sliding  # from the start, by then
    run, _ = simulated.measured(again, rubbing)
    again = commissioning.plan_repeat(again, run)
    seen = result_of(CONFIG, simulated.measured(again, rubbing))
    assert seen.has_margin
    gains = seen.choice.gains
    assert true_loop(gains, seen.loops.inertia).margin().value > 0.3


def test_events_of_the_simulated_arm_are_not_measured():
    """They are those of its own reference, such as a load that fades in."""
    events = {
        'events.begin': [1.0, 2.0],
        'events.payload': [0.5, 0.0],
        'events.ramp': [0.5, 0.0],
        'events.torque': [0.0, 0.0, 1.0, 1.0],
    }
    run, _ = simulated.measured(planned(), change(ARM, events), 0.1)
    alone, _ = simulated.measured(planned(), ARM, 0.1)
    assert np.array_equal(run.torque, alone.torque)


def test_simulated_arm_holds_with_the_chosen_gains():
    config = build(
        ControllerConfig,
        {**ROBOT, 'robot.payload': 0.1, 'reference.type': 'hold'}
        | found().parameters()
        | {'barrier.bound': [0.2, 0.2]},
    )
    push = {'duration': 10.0, 'disturbance.constant': [2.0, 1.0]}
    start = {'initial.position': POSTURE.tolist()}
    run = simulate(config, change(ARM, push | start)).run()
    assert run.stops == ()
    assert np.abs(run.velocity[-500:]).max() < 0.01


def refused(match, *runs, names=()):
    with pytest.raises(BlfDscError, match=match):
        blf.Commissioning(CONFIG).result(runs, names)


def test_what_is_no_commissioning_is_refused():
    run, config = seen()
    refused('not the motion of a commissioning', (run, CONFIG))
    reversed_ = replace(run, joints=run.joints[::-1]), config
    refused('run is of the joints joint2, joint1, the', reversed_)
    refused('bag_1 is of the joints joint2, joint1, the', reversed_, names=['bag_1'])
    stop = Stop(int(run.stamp[7000]), 'fault', 'a push')
    refused(
        'stopped 7 s after the start: a push', (replace(run, stops=(stop,)), config)
    )
    every = np.arange(run.stamp.size) % 20 != 0
    arrays = ('stamp', 'position', 'velocity', 'torque')
    lossy = replace(run, **{name: getattr(run, name)[every] for name in arrays})
    both = (run, config), (lossy, config)
    refused('^second: .* joint states are missing', *both, names=['first', 'second'])


def test_damping_lags_where_gains_gain_by_it_and_the_true_loop_has_the_margin():
    """Encoders beyond gears that give way, and heavy motors."""
    without = result_of(CONFIG, seen(), lags=()).choice
    choice = found().choice
    assert not without.gains.damping_lag.any()
    assert choice.gains.damping_lag.any()
    assert (choice.gains.damping / without.gains.damping).prod() > 2.0
    lags = found().parameters()['feedback.joint_damping_lag']
    np.testing.assert_array_equal(lags, choice.gains.damping_lag)
    inertia = found().loops.inertia
    loop = true_loop(choice.gains, inertia)
    at_once = loop._replace(feedback=loop.feedback._replace(damping_lag=0.0))
    assert at_once.margin().value < 0.85 * loop.margin().value


def test_arm_whose_damping_lags_is_measured_as_any_other():
    """Its margin as measured is that with the lag; what is chosen does not depend on it."""
    late = change(CONFIG, {'feedback.joint_damping_lag': [0.003, 0.003]})
    motion = blf.Commissioning(late).motion(POSTURE)
    seen = result_of(late, simulated.measured(motion, ARM))
    np.testing.assert_array_equal(seen.start.damping_lag, (0.003, 0.003))
    assert seen.choice.measured.value > 1.1 * found().choice.measured.value
    np.testing.assert_allclose(
        seen.choice.gains.damping, found().choice.gains.damping, rtol=0.11
    )


def test_inertias_of_the_arm_are_those_that_were_measured():
    """Of motors five times as heavy as assumed; a load in one of the runs is no motor."""
    assumed = {**GIVEN, 'robot.rotor_inertia': [each / 5.0 for each in ROTORS]}
    config = build(ControllerConfig, assumed)
    motion = blf.Commissioning(config).motion(POSTURE)
    runs = [simulated.measured(motion, ARM, payload) for payload in (0.0, 1.0)]
    result = result_of(config, *runs)
    settings = settings_of_config(result.config)
    (M,) = inertia_matrices(
        settings.model, settings.initial_estimate[: settings.p], POSTURE[None]
    )
    true = np.diag(true_loop(result.start, result.loops.inertia).links[0]) + ROTORS
    np.testing.assert_allclose(np.diag(M), true, rtol=0.1)  # as the inertias above
    assert result.findings.inertia[0] > 1.2 * true[0]  # 1 kg at 1 m and more
    assert build(ControllerConfig, {**GIVEN, **result.parameters()}) == result.config


def test_stop_damps_no_more_than_the_gains_with_the_margin():
    chosen = found().config
    assert (np.array(chosen.safety.damping) <= chosen.feedback.joint_damping).all()


def test_loop_of_ones_own_has_the_same_motions_and_gains():
    commissioning = blf.Commissioning(CONFIG, [POSTURE, (0.8, 0.5)])
    motion, other = commissioning.motions
    assert motion.config == planned().config
    np.testing.assert_array_equal(other.posture, (0.8, 0.5))
    result = commissioning.result([seen()])
    expected = found().parameters()
    assert result.parameters() == expected
    assert result.config.feedback.joint_damping == expected['feedback.joint_damping']
    # as from a file: the law's own gains follow from those of the joints
    written = build(ControllerConfig, {**GIVEN, **result.parameters()})
    assert result.config == written
    assert written.disturbance.gain != CONFIG.disturbance.gain


def test_gains_without_the_margin_are_no_parameters():
    """No loop has a modulus margin above 1: its gain vanishes at high frequencies."""
    result = blf.Commissioning(CONFIG, margin=1.1).result([seen()])
    assert not result.has_margin
    with pytest.raises(BlfDscError, match=r'no gains have the modulus margin of 1\.1'):
        result.parameters()


def test_bound_is_wide_enough_for_what_the_gains_allow_and_never_narrowed():
    # of the second, more digits than those of a bound that is widened
    tight = change(CONFIG, {'barrier.bound': [5e-4, 0.3049]})
    result = result_of(tight, seen())
    bound = result.parameters()['barrier.bound']
    errors = expected_errors(result.config, settings_of_config(result.config))
    needed = np.maximum(errors.unmodelled, errors.pick_up)
    assert needed[0] > 5e-4
    assert bound[0] == pytest.approx(1.1 * needed[0], rel=0.05)  # two digits
    assert bound[1] == 0.3049
    wide = change(CONFIG, {'barrier.bound': [0.3, 0.3]})
    assert 'barrier.bound' not in result_of(wide, seen()).parameters()


@cache
def rubbing():
    """Return a commissioning of an arm with friction of which its file knows nothing."""
    commissioning = blf.Commissioning(moving(), [POSTURE])
    motion, run = strongest(commissioning, STUCK)
    return commissioning.result([(run, motion.config)])


def strongest(commissioning, arm):
    """Return the last motion that measures a simulated arm, and its run."""
    motion = commissioning.motion(POSTURE)
    run, _ = simulated.measured(motion, arm)
    while again := commissioning.plan_repeat(motion, run):
        motion = again
        run, _ = simulated.measured(motion, arm)
    return motion, run


STUCK = change(
    ARM,
    {
        'disturbance.coulomb': [3.0, 1.5],  # N m
        'disturbance.stribeck': 0.5,
        'truth.rotor_inertia': [1.5, 0.5],
    },
)


def moving():
    """Return an arm that moves to and fro, at up to 1.2 rad/s^2, with a bound of 10 mrad."""
    values = {
        'reference.type': 'sinusoids',
        'reference.offset': POSTURE.tolist(),
        'reference.amplitude': [0.3, 0.3],
        'reference.frequency': [2.0],
        'reference.phase': [0.0],
        'barrier.bound': [0.01, 0.01],  # rad
    }
    return change(CONFIG, values)


def test_bound_is_kept_by_an_arm_with_more_friction_and_inertia_than_its_file_has():
    """From rest, before anything is learned."""
    seen = rubbing()
    start = {'initial.position': (POSTURE + 0.3).tolist(), 'duration': 10.0}
    run = simulate(seen.config, change(STUCK, start)).run()
    assert run.stops == ()
    largest = np.abs(run.error).max(axis=0)
    assert (largest > 0.01).any()  # wider it had to be
    assert (largest < seen.config.barrier.bound).all()


def test_friction_is_measured():
    """Of 3 and 1.5 N m, with half as much more near rest: some of it, since joints creep."""
    seen = rubbing()
    share = seen.findings.friction / [3.0, 1.5]
    assert (share > 0.6).all()
    assert (share < 1.5).all()
    assert found().findings.friction.max() < 0.2  # viscous, of 1 to 2 N m s/rad
    # with the longest lag alone the fit made 0.8 of 1.8 + 1.5 kg m^2
    assert np.isnan(seen.findings.inertia[0])
    assert seen.parameters()['robot.lag'] == CONFIG.robot.lag
    assert seen.unseen[0] > STUCK.truth.rotor_inertia[0] - ROTORS[0]
    written = seen.parameters()['commissioning.friction']
    creep = seen.findings.damping > seen.start.damping  # their friction is not all seen
    assert creep.all()
    np.testing.assert_allclose(written, 1.5 * seen.findings.friction, rtol=0.01)


def test_unknown_arm_is_measured_again_with_gains_twice_as_stiff_at_most_where_it_sticks():
    """The file of the arm has motors that are too light, and no friction."""
    given = {**GIVEN, 'robot.rotor_inertia': [0.05, 0.02]}
    first = blf.Commissioning(build(ControllerConfig, given), [POSTURE])
    friction = {'disturbance.coulomb': [1.0, 0.5], 'disturbance.stribeck': 0.5}
    arm = change(ARM, {**friction, 'truth.rotor_inertia': [0.6, 0.2]})
    motion, run = strongest(first, arm)
    shown = first.result([(run, motion.config)])
    hidden = np.isnan(shown.findings.inertia)
    assert hidden.any()
    used = first.better_known(motion, run).measured_with
    np.testing.assert_allclose(used.robot.coulomb, shown.findings.friction)
    stiffer = np.array(used.feedback.joint_damping) / shown.start.damping
    assert (stiffer >= 1.0).all()
    assert stiffer.max() > 1.5
    assert (stiffer[hidden] < 2.0 * (1.0 + 1e-9)).all()


def at_the_tool(**given):
    """Return the moving arm with a bound of 5 mm at the end of its second link."""
    moves = flatten(moving())
    own = {name: moves[name] for name in moves if name.startswith('reference.')}
    tool = (
        '<link name="tool" /><joint name="flange" type="fixed"><parent link="link2" />'
        '<child link="tool" /><origin xyz="1 0 0" /></joint></robot>'
    )
    values = {
        'robot.urdf': ROBOT['robot.urdf'].replace('</robot>', tool),
        'robot.tip': 'tool',
        'barrier.tool_bound': 0.005,
    }
    return {**GIVEN, **own, **values, **given}


def test_bound_at_the_tool_is_widened_as_those_of_the_joints_are():
    config = build(ControllerConfig, at_the_tool())
    motion = blf.Commissioning(config).motion(POSTURE)
    values = result_of(config, simulated.measured(motion, STUCK)).parameters()
    assert 'barrier.bound' not in values
    written = build(ControllerConfig, at_the_tool(**values))
    assert written.barrier.tool_bound > 0.005
    errors = expected_errors(written, settings_of_config(written))
    used = (errors.unmodelled + errors.pick_up) / written.barrier.bound
    assert 0.85 < used.max() < 0.96  # 1.1 times as wide, in two digits


def file_of_arm(folder):
    """Return a file of ARM in this folder."""
    urdf = folder / 'arm.urdf'
    urdf.write_text(ROBOT['robot.urdf'])
    config = folder / 'arm.yaml'
    config.write_text(f"""
/**:
  ros__parameters:
    robot: {{urdf: {urdf}, gravity: [0.0, 0.0, 0.0], rotor_inertia: {list(ROTORS)}, payload: 0.1}}
/**/sim_plant:
  ros__parameters:
    truth.rotor_inertia: {list(ROTORS)}
    joint.stiffness: {list(SPRINGS)}
    disturbance: {{constant: [0.0, 0.0], amplitude: [0.0, 0.0], viscous: {list(VISCOUS)}}}
    duration: 5.0
/**/blf_dsc_controller:
  ros__parameters:
    barrier.bound: [0.2, 0.2]
    disturbance.gain: [1.0, 1.0]
    limits.position_lower: [-3.0, -3.0]
    limits.position_upper: [3.0, 3.0]
""")
    return config


def test_bags_of_the_written_motions_commission_as_the_simulated_arm(
    tmp_path, capsys, monkeypatch
):
    config = file_of_arm(tmp_path)
    common = ['commission', '--config', str(config)]
    posture = ['--posture', '0.3', '1.1']
    motion = tmp_path / 'motion.yaml'
    # that of the commissioning is drawn, those of the run are not
    monkeypatch.setattr(figures, 'draw_panels', lambda path, *_, **__: path.touch())
    assert main([*common, *posture, '--write', str(motion)]) == 0
    assert 'the tool travels' in capsys.readouterr().out
    out = tmp_path / 'run'
    run = ['run', '--offline', '--config', str(tmp_path / 'motion_1.yaml')]
    assert main([*run, '--out', str(out)]) == 0
    capsys.readouterr()
    by_bag, by_arm = tmp_path / 'bag.yaml', tmp_path / 'arm_out.yaml'
    assert main([*common, str(out / 'bag'), '--out', str(by_bag)]) == 0
    told = capsys.readouterr().out
    assert 'the gains are limited near' in told
    # gains of the law in a file give way to those that were chosen, and the rest stays
    assert 'disturbance.gain' not in by_bag.read_text()
    assert load_loop(by_bag).controller.barrier.bound == (0.2, 0.2)
    assert load_loop(by_bag).plant.joint == load_loop(config).plant.joint
    assert main([*common, *posture, '--out', str(by_arm)]) == 0
    assert 'follows its own motion for 5 s' in capsys.readouterr().out
    assert by_bag.with_suffix('.png').read_bytes().startswith(b'\x89PNG')
    gains = [load_loop(each).controller.feedback for each in (by_bag, by_arm)]
    # the simulated one was measured with a payload, too
    np.testing.assert_allclose(
        gains[0].joint_damping, gains[1].joint_damping, rtol=0.35
    )
    assert main([*common, '--out', str(by_arm)]) == 1  # exists
    assert 'exists already' in capsys.readouterr().err


def coarse(resolution):
    """Return the arm with encoders of a resolution [rad], whose velocities are differences."""
    return change(
        ARM, {'sensor.resolution': resolution, 'sensor.velocity': 'differenced'}
    )


def test_the_second_motion_shows_a_margin_that_noise_had_hidden():
    commissioning = blf.Commissioning(CONFIG, [POSTURE], torque=0.01, travel=0.05)
    (weak,) = commissioning.motions
    runs = [simulated.measured(weak, coarse(3e-4))]
    runs.append(
        simulated.measured(commissioning.plan_repeat(weak, runs[0].run), coarse(3e-4))
    )
    found = [commissioning.result([each]) for each in runs]
    assert [each.has_margin for each in found] == [False, True]


def test_an_arm_that_nearly_oscillates_is_measured_with_half_of_its_gains():
    """Four times the gains of the others are too high; play and friction keep it within bounds."""
    stiff = found().start.scaled(4.0)
    given = {
        'feedback.joint_stiffness': tuple(stiff.stiffness.tolist()),
        'feedback.joint_damping': tuple(stiff.damping.tolist()),
    }
    loose = {'joint.backlash': [4e-4, 4e-4], 'disturbance.coulomb': [1.0, 0.5]}
    plant = change(ARM, loose)
    assert true_loop(stiff, found().loops.inertia).margin().value == 0.0  # unstable
    config = build(ControllerConfig, {**GIVEN, **given})
    commissioning = blf.Commissioning(config, [POSTURE])
    (first,) = commissioning.motions
    run = simulated.measured(first, plant)
    result = commissioning.result([run])
    with pytest.raises(BlfDscError, match=r'or the arm nearly oscillates .*\(their'):
        result.parameters()
    # friction and coarse encoders look alike, but for what the controller reports
    assert commissioning.plan_repeat(first, run.run).share == 1.0
    reported = Oscillation(FIRST_STAMP, 'joint2', 25.0, 8.0, 'it oscillates')
    again = commissioning.plan_repeat(first, replace(run.run, oscillations=(reported,)))
    assert (first.share, again.share) == (1.0, 0.5)
    repeated = commissioning.motion(POSTURE).config
    for each in (again.config, repeated):
        damping = settings_of_config(each).feedback.gain
        np.testing.assert_allclose(damping, 0.5 * stiff.damping)
    chosen = commissioning.result([simulated.measured(again, plant)])
    assert chosen.has_margin
    assert chosen.start.damping == pytest.approx(stiff.damping)


def test_a_posture_is_measured_twice_at_most_and_motion_that_is_hidden_is_an_error():
    commissioning = blf.Commissioning(CONFIG, [POSTURE], torque=0.01, travel=1e-5)
    (weak,) = commissioning.motions
    hidden = simulated.measured(weak, coarse(1e-4))
    again = commissioning.plan_repeat(weak, hidden[0])
    assert again.excitation.travel <= 1e-5
    still = simulated.measured(again, coarse(1e-4))
    assert commissioning.plan_repeat(again, still[0]) is None
    with pytest.raises(BlfDscError, match='positions do not show the motion'):
        commissioning.result([still])
