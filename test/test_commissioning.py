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
from blf_dsc_controller.cli.commission import _lags as lags_of
from blf_dsc_controller.cli.commissioned_file import CommissionedFile
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.commissioning import files, simulated
from blf_dsc_controller.commissioning.choice import (
    LAGS,
    choose,
)
from blf_dsc_controller.commissioning.chosen import with_gains
from blf_dsc_controller.commissioning.commissioned import commissioned
from blf_dsc_controller.commissioning.commissioning import REPEATS
from blf_dsc_controller.commissioning.findings import findings_of
from blf_dsc_controller.commissioning.margin import Loops, RigidArm
from blf_dsc_controller.commissioning.motion import (
    excitation,
    lines_in,
)
from blf_dsc_controller.commissioning.page import sentences
from blf_dsc_controller.commissioning.planned import measuring_gains, plan
from blf_dsc_controller.commissioning.response import (
    Response,
    refined,
    response_of,
)
from blf_dsc_controller.commissioning.strength import MOST, shown_by
from blf_dsc_controller.configuration.nodes import PLANT, read
from blf_dsc_controller.configuration.schema import build, flatten
from blf_dsc_controller.factory.settings import settings_of_config
from blf_dsc_controller.reference.approach import reference_of
from blf_dsc_controller.reference.terms import sampled
from blf_dsc_controller.run import FIRST_STAMP, Oscillation, Stop
from blf_dsc_controller.supervision.expected_errors import expected_errors
from sim_plant.settings import true_rotors

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
    return plan(CONFIG, POSTURE[None])[0]


@cache
def sliding():
    """Return the motion around POSTURE that keeps joints sliding."""
    return plan(CONFIG, POSTURE[None], sliding=True)[0]


@cache
def found():
    """Return what the simulated arm shows, without friction but viscous."""
    return commissioned(CONFIG, [simulated.measured(planned(), ARM)])


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


@pytest.mark.parametrize('slides', [False, True])
@pytest.mark.parametrize('travel', [1e-4, 1e-3, 0.1])
def test_travel_is_what_is_permitted(travel, slides):
    made = excitation(CONFIG, POSTURE, 0.03, travel, sliding=slides)
    assert made.travel <= travel
    if slides and travel <= 1e-3:  # all of it is used
        assert made.travel > 0.95 * travel
    assert (made.speed <= 0.25 * np.array(CONFIG.limits.velocity)).all()


@pytest.mark.parametrize('slides', [False, True])
def test_a_joint_that_hardly_moves_the_tool_stays_within_its_limits(slides):
    """The last wrist of a YAM, 50 mrad from its limit, would swing by 97 mrad otherwise."""
    config = load_loop(share_folder() / 'config' / 'yam.yaml').controller
    posture = np.zeros(6)
    posture[1:3] = 1.2
    posture[5] = config.limits.position_upper[5] - 0.05
    (near,) = plan(config, posture[None], sliding=slides)
    times = np.linspace(0.0, near.excitation.period, 20_000)
    q = sampled(reference_of(near.config), times)[:, 0]
    assert (q >= config.limits.position_lower).all()
    # a fifth of the way is left for errors, and the last step of getting smaller is 5 % or less
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


def test_friction_is_not_taken_for_a_lag_of_the_drives():
    """Of an elastic arm with drives of 2.2 ms, whose friction is a spring with hysteresis.

    At 2 to 5 Hz it asks for more than the inertia does, and the fit there makes 19 ms of it.  The
    damping of the gears, which resonate at 26 Hz, takes 1 ms off at 8 to 40 Hz.
    """
    loop = true_loop(found().start, found().loops.inertia)
    timing = Timing(1e-3, delay=2, drive_lag=2.2e-3)
    (response,) = found().responses
    s = 2j * np.pi * response.frequency
    free = arm_response(loop.links, loop.joints, timing, s)[0]
    rubbed = np.linalg.inv(free) + (600.0 + 600.0j) * np.diag([1.0, 0.2])
    position = np.linalg.inv(rubbed)
    run, _ = simulated.measured(planned(), ARM)
    seen = findings_of([run], [response._replace(position=position)])
    assert seen.drive_lag == pytest.approx(4.7e-3, abs=1.5e-3)  # with half of a sample


def test_steps_of_the_encoders_are_found_and_told():
    """Of 12 bits, which the tones of 10 mrad pass many times."""
    step = 2.0 * np.pi / 4096
    run, config = simulated.measured(planned(), ARM)
    coarse = replace(run, position=step * np.rint(run.position / step))
    seen = commissioned(CONFIG, [(coarse, config)])
    np.testing.assert_allclose(seen.findings.resolution, step, rtol=1e-9)
    assert 'positions in steps of 1.5 mrad' in next(sentences(seen))
    assert 'steps' not in next(sentences(found()))


def test_chosen_gains_have_the_margin_of_the_true_loop_and_twice_of_them_do_not():
    choice = found().choice
    assert choice.margin.value >= 0.5
    inertia = found().loops.inertia
    true = true_loop(choice.gains, inertia).margin()
    assert true.value == pytest.approx(choice.margin.value, abs=0.1)
    twice = true_loop(choice.gains.scaled(2.0), inertia).margin()
    assert twice.value < 0.4


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
    stuck = commissioned(CONFIG, [(run, config)])
    assert stuck.has_margin
    assert true_loop(stuck.choice.gains, stuck.loops.inertia).margin().value == 0.0
    again = commissioning.plan_repeat(first, run)
    assert not first.excitation.sliding
    assert commissioning.motion(POSTURE).excitation.sliding  # from the start, by then
    run, _ = simulated.measured(again, rubbing)
    again = commissioning.plan_repeat(again, run)
    seen = commissioned(CONFIG, [simulated.measured(again, rubbing)])
    assert seen.has_margin
    gains = seen.choice.gains
    assert true_loop(gains, seen.loops.inertia).margin().value > 0.3


def test_noise_is_counted_against_the_margin():
    """The doubt covers what noise of 0.1 mrad makes of the singular values."""
    run, config = simulated.measured(planned(), ARM)
    random = np.random.default_rng(0)
    noisy = replace(
        run, position=run.position + random.normal(0.0, 1e-4, run.position.shape)
    )
    gains = found().start
    inertia = found().loops.inertia
    loops = [
        Loops([response_of(each, lines_in(config), 1e-3)], inertia, 1e-3)
        for each in (run, noisy)
    ]
    (true, none, _), (value, doubt, _) = (
        each.singular_values(gains)[0] for each in loops
    )
    assert np.median(doubt) > 3.0 * np.median(none)
    inside = np.abs(value - true) < doubt
    assert inside.mean() > 0.9


def lines_of(stiffness, noise):
    """Return a response (f, 2, 2) at lines of 10 to 20 Hz by its inverse, and its noise."""
    f = np.arange(10.0, 21.0)
    position = np.linalg.inv(stiffness(f))
    rows = noise * np.ones((f.size, 2))
    return Response(
        frequency=f,
        position=position,
        velocity=2j * np.pi * f[:, None, None] * position,
        position_noise=rows,
        velocity_noise=rows,
        columns=np.ones((f.size, 2)),
        shared=np.zeros((f.size, 2, 2), bool),
        posture=np.zeros(2),
        seen=np.ones(f.size, bool),
        speed=np.zeros(2),
        friction=np.zeros(2),
    )


def test_runs_show_responses_that_are_shared_where_noise_hides_the_asymmetry_of_gears():
    """It is 2 % of G at 5 Hz, and shows without noise."""
    run, config = simulated.measured(planned(), ARM)
    random = np.random.default_rng(0)
    noise = random.normal(0.0, 1e-3, run.position.shape)
    noisy = response_of(
        replace(run, position=run.position + noise), lines_in(config), 1e-3
    )
    low = noisy.frequency <= 12.0
    assert noisy.shared[low, 0, 1].any()
    assert not noisy.shared[~low].any()
    (exact,) = found().responses
    assert not exact.shared.any()


def largest_of(response):
    """Return the largest singular value of the responses that count [rad/(N m)]."""
    return np.linalg.norm(response.position[response.seen], 2, axis=(1, 2)).max()


def test_sharp_resonance_between_two_lines_is_seen():
    """Of 3000 N m/rad and 1 kg m^2 behind 15.4 Hz, damped by 0.5 %, and a stiff second joint."""

    def stiffness(f):
        s = 2j * np.pi * f
        w = 2.0 * np.pi * 15.4
        mode = s * s + 2.0 * 0.005 * w * s + w * w
        return np.stack([np.diag([each, 3e4]) for each in mode]).astype(complex)

    at_lines = lines_of(stiffness, 1e-9)
    assert largest_of(refined(at_lines)) > 3.0 * largest_of(at_lines)


def test_mode_that_is_all_noise_makes_no_resonance_between_two_lines():
    """Its inverse turns round from line to line, so that the mean of two is nearly singular."""

    def stiffness(f):
        noise = 1e3 * f**2 * np.where(np.arange(f.size) % 2, -0.999, 1.0)
        clear = -((2.0 * np.pi * f) ** 2)
        return np.stack(
            [np.diag(each) for each in zip(clear, noise, strict=True)]
        ).astype(complex)

    at_lines = lines_of(
        stiffness, 1e-5
    )  # rad/(N m), as large as what is left of the mode
    assert largest_of(refined(at_lines)) < 1.01 * largest_of(at_lines)


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


def test_what_is_no_commissioning_is_refused():
    run, config = simulated.measured(planned(), ARM)
    with pytest.raises(BlfDscError, match='not the motion of a commissioning'):
        commissioned(CONFIG, [(run, CONFIG)])
    reversed_ = replace(run, joints=run.joints[::-1])
    with pytest.raises(BlfDscError, match='run is of the joints joint2, joint1, the'):
        commissioned(CONFIG, [(reversed_, config)])
    with pytest.raises(BlfDscError, match='bag_1 is of the joints joint2, joint1, the'):
        commissioned(CONFIG, [(reversed_, config)], names=['bag_1'])
    stopped = replace(run, stops=(Stop(int(run.stamp[7000]), 'fault', 'a push'),))
    with pytest.raises(BlfDscError, match='stopped 7 s after the start: a push'):
        commissioned(CONFIG, [(stopped, config)])
    every = np.arange(run.stamp.size) % 20 != 0
    lossy = replace(
        run,
        stamp=run.stamp[every],
        position=run.position[every],
        velocity=run.velocity[every],
        torque=run.torque[every],
    )
    with pytest.raises(BlfDscError, match=r'^second: .* joint states are missing'):
        blf.Commissioning(CONFIG).result(
            [(run, config), (lossy, config)], ['first', 'second']
        )
    with pytest.raises(BlfDscError, match=r'feedback\.inertia: got whole'):
        plan(
            build(ControllerConfig, {**ROBOT, 'feedback.inertia': 'whole'}),
            POSTURE[None],
        )
    with pytest.raises(BlfDscError, match=r'joint2 would be at 6\.25 rad'):
        plan(CONFIG, np.array([[0.0, 6.25]]))
    with pytest.raises(BlfDscError, match=r'robot\.urdf: got none'):
        plan(ControllerConfig(), POSTURE[None])


def test_no_gains_have_a_margin_if_noise_hides_the_response():
    (response,) = found().responses
    loud = response._replace(position_noise=1e4 * (response.position_noise + 1e-6))
    loops = found().loops._replace(responses=[loud])
    start = found().start
    choice = choose(loops, start, start.scaled, true_rigid_arm())
    assert choice.margin.value < 0.5
    assert (choice.factors < 0.1).all()
    assert not choice.by_inertia.any()


def linear_arm(*, motor_side):
    """Return the linear arm with encoders at links or motors, and what is seen of it."""
    (response,) = found().responses
    loop = true_loop(found().start, found().loops.inertia)
    loop = loop._replace(joints=loop.joints._replace(motor_side=motor_side))
    s = 2j * np.pi * response.frequency
    G = arm_response(loop.links, loop.joints, TIMING, s)[0]
    differenced = (1.0 - np.exp(-1e-3 * s))[:, None, None] / 1e-3 * G
    exact = response._replace(
        position=G,
        velocity=differenced,
        position_noise=0.0 * response.position_noise,
        velocity_noise=0.0 * response.velocity_noise,
    )
    return loop, found().loops._replace(responses=[exact])


def test_damping_lags_where_gains_gain_by_it_and_the_true_loop_has_the_margin():
    """Encoders beyond gears that give way, and heavy motors; 0.06 are between lines at 24 Hz."""
    loop, loops = linear_arm(motor_side=False)
    start = found().start
    given = loops, start, start.scaled, true_rigid_arm()
    choice, without = choose(*given), choose(*given, lags=())
    np.testing.assert_array_equal(choice.without_lag, without.factors)
    assert not without.gains.damping_lag.any()
    assert set(choice.gains.damping_lag) <= {0.0, *LAGS}
    raised = choice.factors / without.factors
    assert raised.min() >= 1.0
    assert raised.prod() > 2.0
    assert choice.margin.value >= 0.5
    of = linear(choice.gains, loops.inertia, 1)
    true = loop._replace(feedback=of).margin().value
    assert true == pytest.approx(choice.margin.value, abs=0.06)
    at_once = of._replace(damping_lag=0.0)
    assert loop._replace(feedback=at_once).margin().value < 0.85 * true


def test_damping_does_not_lag_where_nothing_is_gained_by_it():
    """Encoders at the motors: gains are those of a choice that knows no lag."""
    _, loops = linear_arm(motor_side=True)
    start = found().start
    given = loops, start, start.scaled, true_rigid_arm()
    choice, without = choose(*given), choose(*given, lags=())
    assert not choice.gains.damping_lag.any()
    for mine, other in zip(choice.gains, without.gains, strict=True):
        np.testing.assert_array_equal(mine, other)
    assert choice.margin == without.margin


def test_chosen_lags_are_written_and_give_way_to_those_of_a_next_time():
    seen = found()
    lags = (0.005, 0.0)
    gains = seen.choice.gains._replace(damping_lag=np.array(lags))
    choice = seen.choice._replace(
        gains=gains, factors=np.array([1.5, 0.8]), without_lag=np.array([0.75, 0.64])
    )
    lagging = seen._replace(choice=choice)
    assert lagging.parameters()['feedback.joint_damping_lag'] == lags
    np.testing.assert_array_equal(
        settings_of_config(lagging.config).feedback.damping_lag, lags
    )
    none = choice._replace(gains=gains._replace(damping_lag=np.zeros(2)))
    written = seen._replace(choice=none)
    assert 'feedback.joint_damping_lag' not in written.parameters()
    again = written._replace(before=lagging.config)
    assert again.parameters()['feedback.joint_damping_lag'] == (0.0, 0.0)
    assert not again.config.feedback.joint_damping_lag[0]


def test_arm_whose_damping_lags_is_measured_as_any_other():
    """Its margin as measured is that with the lag; what is chosen does not depend on it."""
    late = change(CONFIG, {'feedback.joint_damping_lag': [0.003, 0.003]})
    (motion,) = plan(late, POSTURE[None])
    seen = commissioned(late, [simulated.measured(motion, ARM)])
    np.testing.assert_array_equal(seen.start.damping_lag, (0.003, 0.003))
    assert seen.choice.measured.value > 1.1 * found().choice.measured.value
    np.testing.assert_allclose(
        seen.choice.gains.damping, found().choice.gains.damping, rtol=0.11
    )


def test_motors_that_close_the_feedback_are_given_no_lag(tmp_path):
    """They damp at once, and refuse one."""
    assert lags_of(share_folder() / 'config' / 'yam.yaml') == ()
    assert lags_of(file_of_arm(tmp_path)) == LAGS


def true_rigid_arm():
    """Return the arm of the true inertias and delay, without springs and friction."""
    (links,) = true_loop(found().start, found().loops.inertia).links
    return RigidArm(np.diag(links) + ROTORS, TIMING)


def test_gains_are_none_that_the_inertia_alone_would_not_bear():
    """The joints answer a thousandth of what their inertias would: something damps them."""
    (response,) = found().responses
    stuck = response._replace(
        position=0.001 * response.position,
        velocity=0.001 * response.velocity,
        position_noise=0.0 * response.position_noise,
        velocity_noise=0.0 * response.velocity_noise,
    )
    loops = found().loops._replace(responses=[stuck])
    start = found().start
    rigid = true_rigid_arm()
    choice = choose(loops, start, start.scaled, rigid)
    assert choice.by_inertia.tolist() == [False, True]
    assert choice.factors[0] > 90.0  # 100 times those of the measurement are tried
    assert rigid.margin(choice.gains, loops.inertia) >= 0.5
    more = choice.gains.scaled(np.array([1.0, 1.5]))
    assert loops.margin(more).value >= 0.5  # nothing else would limit them
    assert rigid.margin(more, loops.inertia) < 0.5


def test_inertias_of_the_arm_are_those_that_were_measured():
    """Of motors five times as heavy as assumed; a load in one of the runs is no motor."""
    light = change(CONFIG, {'robot.rotor_inertia': [each / 5.0 for each in ROTORS]})
    config = build(
        ControllerConfig, {**GIVEN, 'robot.rotor_inertia': light.robot.rotor_inertia}
    )
    (motion,) = plan(config, POSTURE[None])
    runs = [simulated.measured(motion, ARM, payload) for payload in (0.0, 1.0)]
    result = commissioned(config, runs)
    settings = settings_of_config(result.config)
    (M,) = inertia_matrices(
        settings.model, settings.initial_estimate[: settings.p], POSTURE[None]
    )
    true = true_rigid_arm().inertias
    np.testing.assert_allclose(np.diag(M), true, rtol=0.1)  # as the inertias above
    assert result.findings.inertia[0] > 1.2 * true[0]  # 1 kg at 1 m and more
    # so are the errors to expect: with the assumed motors the loop would be another
    errors = expected_errors(result.config, settings)
    assert (errors.unmodelled < 0.1).all()
    written = build(ControllerConfig, {**GIVEN, **result.parameters()})
    assert written == result.config


def test_stop_damps_no_more_than_the_gains_with_the_margin():
    chosen = found().config
    assert (np.array(chosen.safety.damping) <= chosen.feedback.joint_damping).all()


def test_loop_of_ones_own_has_the_same_motions_and_gains():
    commissioning = blf.Commissioning(CONFIG, [POSTURE, (0.8, 0.5)])
    motion, other = commissioning.motions
    assert motion.config == planned().config
    np.testing.assert_array_equal(other.posture, (0.8, 0.5))
    result = commissioning.result([simulated.measured(motion, ARM)])
    expected = found().parameters()
    assert result.parameters() == expected
    assert result.config.feedback.joint_damping == expected['feedback.joint_damping']
    # as from a file: the law's own gains follow from those of the joints
    written = build(ControllerConfig, {**GIVEN, **result.parameters()})
    assert result.config == written
    assert written.disturbance.gain != CONFIG.disturbance.gain


def test_gains_of_the_law_in_a_file_give_way_to_those_that_were_chosen(tmp_path):
    """What else the file gives stays."""
    file = tmp_path / 'arm.yaml'
    file.write_text(
        '/**/blf_dsc_controller:\n  ros__parameters:\n'
        '    disturbance.gain: [1.0, 1.0]\n    barrier: {bound: [0.3, 0.3]}\n'
    )
    wide = change(CONFIG, {'barrier.bound': [0.3, 0.3]})
    sections = files.of_commissioned(read(file), found()._replace(before=wide))
    given = sections['/**/blf_dsc_controller']
    assert 'disturbance.gain' not in given
    assert given['feedback.joint_damping'] == found().config.feedback.joint_damping
    assert given['barrier.bound'] == [0.3, 0.3]


def test_simulated_arm_keeps_its_drives_whatever_is_measured_of_them(tmp_path):
    """By default they are those that the file assumes, and the measured ones would replace them."""
    source = tmp_path / 'arm.yaml'
    source.write_text(
        '/**:\n  ros__parameters:\n'
        '    robot: {urdf: two_link.urdf, gravity: [0.0, 0.0, 0.0]}\n'
        '/**/sim_plant:\n  ros__parameters:\n    truth: {rotor_factor: 1.3}\n'
    )
    out = tmp_path / 'out.yaml'
    file = CommissionedFile(
        out, source, 'arm', '', is_simulated=True, ripple_follows=True
    )
    file.write(found(), file.content(found()))
    before, after = load_loop(source), load_loop(out)
    np.testing.assert_allclose(true_rotors(after.plant), true_rotors(before.plant))
    measured_ones = list(after.controller.robot.rotor_inertia)
    assert measured_ones != pytest.approx(true_rotors(after.plant).tolist(), rel=0.1)


def test_gains_without_the_margin_are_no_parameters():
    """No loop has a modulus margin above 1: its gain vanishes at high frequencies."""
    run = simulated.measured(planned(), ARM)
    result = blf.Commissioning(CONFIG, margin=1.1).result([run])
    assert not result.has_margin
    assert any('NO GAINS HAVE THE MARGIN of 1.1' in each for each in sentences(result))
    with pytest.raises(BlfDscError, match=r'no gains have the modulus margin of 1\.1'):
        result.parameters()


def test_bound_is_wide_enough_for_what_the_gains_allow_and_never_narrowed():
    # of the second, more digits than those of a bound that is widened
    tight = change(CONFIG, {'barrier.bound': [5e-4, 0.3049]})
    run, config = simulated.measured(planned(), ARM)
    result = commissioned(tight, [(run, config)])
    bound = result.parameters()['barrier.bound']
    errors = expected_errors(result.config, settings_of_config(result.config))
    needed = np.maximum(errors.unmodelled, errors.pick_up)
    assert needed[0] > 5e-4
    assert bound[0] == pytest.approx(1.1 * needed[0], rel=0.05)  # two digits
    assert bound[1] == 0.3049
    assert any('joint1' in each and 'widened' in each for each in sentences(result))
    assert (
        'barrier.bound'
        not in commissioned(
            change(CONFIG, {'barrier.bound': [0.3, 0.3]}),
            [(run, config)],
        ).parameters()
    )


@cache
def rubbing():
    """Return a commissioning of an arm with friction of which its file knows nothing."""
    commissioning = blf.Commissioning(moving(), [POSTURE])
    (motion,) = commissioning.motions
    run, _ = simulated.measured(motion, STUCK)
    for _ in range(REPEATS):
        motion = commissioning.plan_repeat(motion, run)
        run, config = simulated.measured(motion, STUCK)
    return commissioning.result([(run, config)])


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
    written = seen.parameters()['commissioning.friction']
    creep = seen.findings.damping > seen.start.damping  # their friction is not all seen
    assert creep.all()
    np.testing.assert_allclose(written, 1.5 * seen.findings.friction, rtol=0.01)


def test_inertia_that_fits_with_the_longest_lag_alone_is_not_believed():
    """Of 1.8 + 1.5 kg m^2 the fit made 0.8, with the 30 ms that are tried at most.

    What the file assumes stays, so does its `robot.lag`, and the bound counts what may be missing.
    """
    seen = rubbing()
    assert seen.findings.unfit.tolist() == [[True, False]]
    assert np.isnan(seen.findings.inertia[0])
    assert np.isnan(seen.findings.drive_lag)  # nor is one seen at higher frequencies
    assert seen.parameters()['robot.lag'] == CONFIG.robot.lag
    assert seen.unseen[0] > STUCK.truth.rotor_inertia[0] - ROTORS[0]


HIDDEN = {'inertia': np.array([np.nan, 1.0])}
DOUBTS = [  # changes of findings and of the choice, and what is said of them
    ({}, {}, ''),
    (HIDDEN, {}, 'friction hides the inertia of joint1: '),
    (HIDDEN | {'unfit': np.array([[True, False]])}, {}, 'would fit best with a lag'),
    ({'damping': np.full(2, 1e3)}, {}, 'friction damps joint1, joint2 more than the'),
    ({'friction': np.full(2, 9.0)}, {}, 'more friction than robot.coulomb: joint1'),
    ({}, {'by_inertia': np.array([True, False])}, 'joint1: limited by inertia'),
    ({}, {'factors': np.array([2.0, 6.0])}, 'joint2 gets 6 times the gains it was'),
]


@pytest.mark.parametrize(('findings', 'choice', 'words'), DOUBTS)
def test_what_is_not_sure_is_said_and_nothing_else(findings, choice, words):
    seen = found()
    seen = seen._replace(
        findings=seen.findings._replace(**findings),
        choice=seen.choice._replace(**choice),
    )
    told = '\n'.join(sentences(seen))
    said = {each for _, _, each in DOUBTS if each and each in told}
    assert said == ({words} if words else set())


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


@cache
def at_once():
    """Return what the simulated arm shows, with gains for damping that does not lag."""
    return commissioned(CONFIG, [simulated.measured(planned(), ARM)], lags=())


def stiff(before, friction=None):
    """Return the commissioning of an arm that bears twenty times the gains, for a file."""
    seen = at_once()
    choice = seen.choice._replace(gains=seen.choice.gains.scaled(20.0))
    friction = seen.friction if friction is None else np.array(friction)
    return seen._replace(before=before, choice=choice, friction=friction)


@cache
def better_known():
    """Return a commissioning, its first motion and run, the one anew, and its last ones.

    The file of the arm has motors that are too light, and no friction.
    """
    first = blf.Commissioning(
        build(ControllerConfig, {**GIVEN, 'robot.rotor_inertia': [0.05, 0.02]}),
        [POSTURE],
    )
    friction = {'disturbance.coulomb': [1.0, 0.5], 'disturbance.stribeck': 0.5}
    arm = change(ARM, {**friction, 'truth.rotor_inertia': [0.6, 0.2]})
    soft = strongest(first, arm)
    second = first.better_known(*soft)
    return first, soft, second, strongest(second, arm)


def strongest(commissioning, arm):
    """Return the last motion that measures a simulated arm, and its run."""
    motion = commissioning.motion(POSTURE)
    run, _ = simulated.measured(motion, arm)
    while again := commissioning.plan_repeat(motion, run):
        motion = again
        run, _ = simulated.measured(motion, arm)
    return motion, run


def result_of(commissioning, motion, run):
    return commissioning.result([(run, motion.config)])


def test_unknown_arm_is_measured_again_with_better_gains_and_its_friction():
    first, soft, second, _ = better_known()
    without_lag = blf.Commissioning(
        first.config, [POSTURE], lags=()
    )  # as measured anew
    shown = result_of(without_lag, *soft)
    hidden = np.isnan(shown.findings.inertia)
    assert hidden.any()
    assert not hidden.all()
    used, before = second.measured_with, first.measured_with
    np.testing.assert_allclose(used.robot.coulomb, shown.findings.friction)
    for name in ('stiffness', 'damping'):
        gains = np.array(getattr(used.feedback, f'joint_{name}'))
        start = getattr(shown.start, name)
        bears = np.array(shown.parameters_but_bounds()[f'feedback.joint_{name}'])
        # of a joint that sticks, not more than twice of what it was measured with
        most = np.where(hidden, 2.0 * start, np.inf)
        expected = np.maximum(np.minimum(0.5 * bears, most), start)
        np.testing.assert_allclose(gains, expected)
    assert before == first.config
    assert used.robot.lag == shown.parameters()['robot.lag']
    assert second.anew_left == first.anew_left - 1
    assert second.motion(POSTURE).excitation.sliding  # as the last motion


def test_arm_that_is_better_known_shows_more_and_its_friction_is_written():
    first, soft, _, better = better_known()
    before, after = result_of(first, *soft), result_of(first, *better)
    hidden = [int(np.isnan(e.findings.inertia).sum()) for e in (before, after)]
    assert hidden[1] < hidden[0]
    values = after.parameters()
    assert 'robot.coulomb' not in before.parameters_but_bounds()
    share = np.array(values['robot.coulomb']) / [1.0, 0.5]
    assert (share > 0.8).all()
    assert (share < 2.0).all()  # half as much more near rest
    given = {**GIVEN, 'robot.rotor_inertia': [0.05, 0.02]}
    assert build(ControllerConfig, {**given, **values}) == after.config


def test_arm_that_is_known_enough_is_not_measured_again():
    """Its inertias are seen and it bears little more; or its gains are given, whatever it hides."""
    run = simulated.measured(planned(), ARM)
    calm = blf.Commissioning(CONFIG, [POSTURE])
    assert calm.better_known(planned(), run.run) is None
    _, soft, second, _ = better_known()
    gains = {
        f'feedback.joint_{name}': getattr(
            second.measured_with.feedback, f'joint_{name}'
        )
        for name in ('stiffness', 'damping')
    }
    given = blf.Commissioning(build(ControllerConfig, {**GIVEN, **gains}), [POSTURE])
    assert given.better_known(*soft) is None
    second.anew_left, times = 0, second.anew_left
    assert second.better_known(*soft) is None
    second.anew_left = times
    assert second.better_known(*soft) is not None


def test_bound_at_the_tool_is_widened_as_those_of_the_joints_are():
    """By friction of which the file knows nothing, and shared out by the same errors."""
    config = build(ControllerConfig, at_the_tool())
    bounds = []
    for friction in (None, (3.0, 1.5), (3.0, 6.0)):
        seen = stiff(config, friction)
        values = seen.parameters()
        assert 'barrier.bound' not in values
        written = build(ControllerConfig, at_the_tool(**values))
        assert written == seen.config
        bounds.append(written.barrier)
        errors = expected_errors(written, settings_of_config(written))
        used = (errors.unmodelled + errors.pick_up) / written.barrier.bound
        assert 0.85 < used.max() < 0.96  # 1.1 times as wide, in two digits
        told = (
            'barrier.tool_bound is widened for these errors: '
            f'{written.barrier.tool_bound:g} m instead of 0.005'
        )
        assert any(told in each for each in sentences(seen))
    wide, rubbed, second = bounds
    assert 0.005 < wide.tool_bound < rubbed.tool_bound
    shares = [each.bound[1] / each.bound[0] for each in (rubbed, second)]
    assert shares[1] > 1.5 * shares[0]  # the second joint rubs four times as much


def test_bound_at_the_tool_that_cannot_be_widened_is_refused():
    """A tenth of the reach bounds nothing; nor is a bound of joints overruled beside it."""
    config = build(ControllerConfig, at_the_tool())
    with pytest.raises(
        BlfDscError, match=r'barrier\.tool_bound: .* m, which bounds nothi'
    ):
        stiff(config, (30.0, 15.0)).parameters()
    both = at_the_tool(**{'barrier.bound': (0.001, 0.001)})
    with pytest.raises(BlfDscError, match=r'drop barrier\.bound, which then follows'):
        stiff(build(ControllerConfig, both)).parameters()


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


def test_load_that_was_not_measured_is_told_at_the_end_and_in_the_file(
    tmp_path, capsys, monkeypatch
):
    """It was said in passing, before the table, and the file did not say it."""
    measured = simulated.measured

    def dropped(planned, plant, payload=0.0):
        if payload:
            raise BlfDscError('the simulated arm stopped: it fell')
        return measured(planned, plant)

    monkeypatch.setattr(simulated, 'measured', dropped)
    monkeypatch.setattr(figures, 'draw_panels', lambda path, *_, **__: path.touch())
    out = tmp_path / 'out.yaml'
    given = ['--config', str(file_of_arm(tmp_path)), '--posture', '0.3', '1.1']
    assert main(['commission', *given, '--out', str(out)]) == 0
    before, _, summary = capsys.readouterr().out.partition('commissioned on')
    comment = out.read_text().partition('/**:')[0].replace('# ', '')
    for told in (before, summary, comment):
        assert 'posture 1 with 0.1 kg: not measured: the simulated arm stopped' in told


def test_proof_has_the_largest_error_of_its_whole_run_or_the_reason_of_a_stop():
    loop = load_loop('recommended', {PLANT: {'duration': 0.5}})
    error = simulate(loop.controller, loop.plant).run().error
    proof = simulated.proof(loop)
    np.testing.assert_array_equal(proof.error, np.abs(error).max(axis=0))
    assert proof == (0.5, proof.error, '', [])
    slow = change(loop.controller, {'safety.velocity_limit': 0.02})
    assert 'velocity_limit' in simulated.proof(loop._replace(controller=slow)).stop


def test_a_posture_that_noise_hides_is_measured_again_with_more_torque():
    """Encoders of 0.05 mrad, whose velocities are differences."""
    commissioning = blf.Commissioning(CONFIG, [POSTURE], torque=0.01, travel=0.05)
    (weak,) = commissioning.motions
    clear = simulated.measured(weak, ARM)
    assert shown_by(*clear).factor == 1.0
    assert commissioning.plan_repeat(weak, clear[0]) is None
    run = simulated.measured(weak, coarse(5e-5))
    factor = shown_by(*run).factor
    assert 2.0 < factor < MOST
    again = commissioning.plan_repeat(weak, run.run)
    # the next posture begins with it
    assert commissioning.motion(POSTURE).torque == again.torque == factor * 0.01
    shares = again.excitation.amplitude / weak.excitation.amplitude
    np.testing.assert_allclose(shares[:, :-2], factor, rtol=1e-9)
    assert shown_by(*simulated.measured(again, coarse(5e-5))).factor == 1.0


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
    stiff = measuring_gains(CONFIG).scaled(4.0)
    given = {
        'feedback.joint_stiffness': tuple(stiff.stiffness.tolist()),
        'feedback.joint_damping': tuple(stiff.damping.tolist()),
    }
    loose = {'joint.backlash': [4e-4, 4e-4], 'disturbance.coulomb': [1.0, 0.5]}
    plant = change(ARM, loose)
    assert true_loop(stiff, found().loops.inertia).margin().value == 0.0  # unstable
    commissioning = blf.Commissioning(with_gains(CONFIG, given), [POSTURE])
    (first,) = commissioning.motions
    run = simulated.measured(first, plant)
    result = commissioning.result([run])
    with pytest.raises(BlfDscError, match=r'or the arm nearly oscillates .*\(their'):
        result.parameters()
    assert any('a smaller feedback.stiffness' in each for each in sentences(result))
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
    assert shown_by(*hidden).factor == MOST
    again = commissioning.plan_repeat(weak, hidden[0])
    assert again.excitation.travel <= 1e-5
    still = simulated.measured(again, coarse(1e-4))
    assert commissioning.plan_repeat(again, still[0]) is None
    with pytest.raises(BlfDscError, match='positions do not show the motion'):
        commissioning.result([still])


def test_light_wrists_may_be_shaken_past_their_limit_of_acceleration():
    """OpenArm's are: its preset limits them to 4 rad/s^2, and the tones need 15."""
    config = load_loop('openarm').controller
    motions = blf.Commissioning(config, [config.reference.offset]).motions
    limit = np.array(config.limits.acceleration)
    assert (motions[0].excitation.acceleration > limit).any()
    times = np.linspace(0.0, motions[0].duration, 5000)
    reached = np.abs(sampled(reference_of(motions[0].config), times)[:, 2])
    assert (reached <= motions[0].config.limits.acceleration).all()


def test_response_of_a_free_arm_is_exact_between_the_lines():
    """It is 1 / (M s^2), whose M does not depend on the frequency."""
    M = np.array([[2.0, 0.3], [0.3, 0.5]])

    def stiffness(f):
        return (2j * np.pi * f)[:, None, None] ** 2 * M

    fine = refined(lines_of(stiffness, 1e-9))
    expected = np.linalg.inv(stiffness(fine.frequency))
    np.testing.assert_allclose(fine.position, expected, rtol=1e-9)
