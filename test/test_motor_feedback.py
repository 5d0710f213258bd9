# SPDX-License-Identifier: Apache-2.0
"""The law's feedback inside the motors' own PD: what is sent, and what it is good for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from motor_arm import ELASTIC, LEROBOT, RANGES, MotorDriver, loop_of
from nights import at_night

import blf_dsc_controller as blf
from blf_dsc_controller import Phase, load_loop
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.configuration.drive import DriveConfig
from blf_dsc_controller.configuration.motor_options import limits_of
from blf_dsc_controller.configuration.nodes import load, locate
from blf_dsc_controller.drive.loop import DriveLoop, End
from blf_dsc_controller.drive.motor_feedback import MotorFeedback
from blf_dsc_controller.motors import damiao
from blf_dsc_controller.motors.frame import (
    torque_alone,
)
from sim_plant.motors import MotorPlant

SLOW = 0.004  # s
IN_MOTORS = {'insist': ['feedback.stiffness']}  # no loop over the bus


def test_motion_by_hand_sends_motors_the_torque_that_a_bag_records(
    tmp_path, monkeypatch, capsys
):
    """The gains are soft enough for a host."""
    preset = (blf.share_folder() / 'config' / 'yam.yaml').read_text()
    soft = preset.replace('    feedback:\n', '    feedback:\n      stiffness: 0.12\n')
    monkeypatch.chdir(tmp_path)
    Path('my.yaml').write_text(
        soft.replace('yam.urdf', str(locate('yam').with_suffix('.urdf')))
    )
    words = [
        '--posture',
        '0',
        '1.047',
        '1.047',
        '0',
        '0',
        '0',
        '--write',
        'motion.yaml',
    ]
    assert main(['commission', '--config', 'my.yaml', *words]) == 0
    assert 'measures with torques over the bus' in capsys.readouterr().err
    assert load(Path('my.yaml'), 'drive', DriveConfig).feedback == 'motor'
    assert load(Path('motion_1.yaml'), 'drive', DriveConfig).feedback == 'host'


def run(loop, feedback, duration, dies_after=2.0, loses=0):
    """Run the law on motors; return controller, largest error late, travel once it is dead.

    Every `loses`-th frame is lost.
    """
    period = loop.controller.sample_time
    controller = blf.ArmController(blf.change(loop.controller, IN_MOTORS))
    plant = MotorPlant(loop.plant, RANGES)
    motor = MotorFeedback(controller, RANGES, loop.plant.actuator.delay * period)
    worst = 0.0
    for k in range(round(duration / period)):
        torque = controller.update(1.0 + k * period, *plant.measure())
        if torque is None or controller.phase is Phase.SAFE_STOP:
            break
        if k * period > 2.0:
            position = plant.plant.truth()[-14:-7]
            worst = max(worst, np.abs(position - controller.reference.q).max())
        frame = motor.frame(torque) if feedback == 'motor' else torque_alone(torque)
        if loses and k % loses == 0:
            plant.coast()
        else:
            plant.step(frame)
    died = plant.plant.truth()[-14:-7].copy()
    for _ in range(round(dies_after / period)):
        plant.coast()
    travel = np.abs(plant.plant.truth()[-14:-7] - died).max()
    return controller, worst, travel


def test_a_dead_host_leaves_an_arm_that_its_motors_hold():
    """The last frame stays: a constant torque lets the arm go, a PD brings it to rest."""
    loop = loop_of(SLOW)
    errors, travels = [], []
    for feedback in ('host', 'motor'):
        controller, worst, travel = run(loop, feedback, 4.0)
        assert controller.phase is Phase.TRACKING
        errors.append(worst)
        travels.append(travel)
    assert errors[1] < 1.2 * errors[0] < 1e-3  # rad: some 0.6 mrad while it learns
    assert travels[0] > 1.0  # rad: it falls
    assert travels[1] < 0.06  # rad: 0.6 rad/s at most, braked within 0.1 s


def test_motors_hold_elastic_gears_that_the_host_cannot_hold():
    """LeRobot's gains at 250 Hz: through the bus they oscillate, in the motors they do not."""
    loop = loop_of(SLOW, LEROBOT, ELASTIC)
    host, _, _ = run(loop, 'host', 1.0)
    assert host.phase is Phase.SAFE_STOP
    motor, worst, travel = run(loop, 'motor', 4.0)
    assert motor.phase is Phase.TRACKING
    assert worst < 4e-3  # rad: gears give way by 2 mrad between encoder and link
    assert travel < 0.06


@pytest.mark.parametrize('physics', ['mujoco', *at_night('own')])
def test_yam_of_the_preset_takes_up_its_rated_payload_with_the_gains_of_its_maker(
    physics,
):
    """20 s, 1 kg at 8 s: doc/motor_arms.md.  Play of 15 minutes of arc, frames of 0.38 mrad."""
    if physics == 'mujoco':
        pytest.importorskip('mujoco', reason='needs MuJoCo: pip install mujoco')
    config = load(locate('yam'), 'drive', DriveConfig)
    assert config.feedback == 'motor'
    events = {'begin': [8.0], 'duration': [0.0], 'payload': [1.0]}
    given = {f'events.{name}': value for name, value in events.items()}
    loop = load_loop(
        'yam', {'sim_plant': {'physics': physics, 'duration': 0.0} | given}
    )
    ranges = damiao.ranges_of(limits_of(config, 6))
    plant = MotorPlant(loop.plant, ranges, rate=2000.0)
    controller = blf.ArmController(blf.change(loop.controller, IN_MOTORS))
    motor = MotorFeedback(controller, ranges, SLOW)
    of_motors, of_links = np.zeros((2, 5000, 6))
    for k in range(5000):
        measured = plant.measure()
        torque = controller.update(1.0 + k * SLOW, *measured)
        assert controller.phase is not Phase.SAFE_STOP, controller.reason
        reference = controller.reference.q
        of_motors[k] = np.abs(measured[0] - reference)
        of_links[k] = np.abs(plant.plant.truth()[-12:-6] - reference)
        plant.step(motor.frame(torque))
    assert controller.phase is Phase.TRACKING
    assert of_motors[1000:2000].max() < 4e-3
    assert (
        of_links[1000:2000].max() < 8e-3
    )  # gears: half a play, and what they give way
    assert 0.15 < of_motors[2000:].max() < 0.25  # joint 4: 2 N m on 10 N m/rad
    assert of_motors[4000:].max() < 6e-3
    assert controller.load.mass == pytest.approx(1.0, abs=0.02)


def test_lost_frames_cost_motors_less_than_the_host():
    """Every third: the motors go on with the gains and the reference that they have."""
    loop = loop_of(SLOW, LEROBOT)
    controller, error, _ = run(loop, 'motor', 4.0, loses=3)
    assert controller.phase is Phase.TRACKING
    assert error < 1e-3  # rad
    controller, _, _ = run(loop, 'host', 4.0, loses=3)
    assert controller.phase is Phase.SAFE_STOP
    assert ' oscillates at ' in controller.reason


def test_the_loop_sends_frames_whose_sum_is_in_the_bag_which_replays(tmp_path):
    loop = loop_of(SLOW)
    driver = MotorDriver('here', loop.controller, DriveConfig())
    driver.plant = MotorPlant(loop.plant, RANGES)
    driver.connect()
    with blf.ArmController(loop.controller, record=tmp_path / 'bag') as controller:
        outcome = DriveLoop(driver, controller, duration=1.0, feedback='motor').run()
    assert outcome.end is End.DURATION
    verified = blf.verify(tmp_path / 'bag')
    assert verified.difference is None
    recorded = blf.read_run(tmp_path / 'bag').torque
    tracking = 250
    for torque, (frame, q, dq) in zip(
        recorded[:tracking], driver.sent[:tracking], strict=True
    ):
        assert (frame.stiffness > 0.0).all()
        # the reference moves on by 1.5 periods: kp and kd times at most 6 mrad, 0.1 rad/s
        off = np.abs(frame.torque_at(q, dq) - torque)
        assert off.max() < 4.0
    stopping = driver.sent[-1][0]
    assert (stopping.stiffness == 0.0).all()
    assert (stopping.damping > 0.0).all()
    assert np.abs(driver.plant.measure()[1]).max() < 0.03  # rad/s: at rest, to a step


@pytest.mark.parametrize('kind', ['zero', 'damping'])
def test_frames_of_a_stop_damp_unless_its_torque_is_zero(kind):
    config = blf.change(loop_of(SLOW).controller, {'safety.torque': kind})
    controller = blf.ArmController(config)
    q, dq = np.array(config.reference.offset), np.full(7, 0.2)
    controller.update(1.0, q, dq)
    torque = controller.fail('by hand')
    frame = MotorFeedback(controller, RANGES, 0.0).frame(torque)
    assert (frame.stiffness == 0.0).all()
    assert (frame.damping > 0.0).all() == (kind == 'damping')
    if kind == 'zero':
        np.testing.assert_allclose(frame.torque_at(q, dq), torque, atol=0.02)
