# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc drive` on simulated Damiao motors, over their protocol, on a virtual CAN bus."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import threading
from contextlib import closing
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('can')

import can
import lockstep_damiao
from command import wait_for
from lockstep_damiao import LockstepArm, LockstepDriver, LockstepTicks
from markdown_it import MarkdownIt
from motor_arm import loop_of

import blf_dsc_controller as blf
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.configuration.drive import DriveConfig
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.drive import show_joints
from blf_dsc_controller.drive.can_bus import CanBus
from blf_dsc_controller.drive.damiao import DamiaoDriver
from blf_dsc_controller.drive.driver import DriverError
from blf_dsc_controller.drive.loop import DriveLoop, End
from blf_dsc_controller.motors import damiao
from blf_dsc_controller.motors.damiao import Status
from blf_dsc_controller.motors.frame import Frame, torque_alone

CONFIG = loop_of(0.004).controller
PRESET = {'motor_models': list(lockstep_damiao.MODELS)}


@pytest.fixture
def made(request, monkeypatch):
    """A connected driver, by the name of the test; its motors are gone afterwards."""
    drivers = []

    def make(arrange=None, at=None, config=CONFIG, **given):
        monkeypatch.setattr(LockstepDriver, 'arrange', arrange)
        monkeypatch.setattr(LockstepDriver, 'at', at or {})
        address = f'virtual:{request.node.name}{len(drivers)}'
        driver = LockstepDriver(
            address, config, build(DriveConfig, PRESET | {'feedback': 'motor'} | given)
        )
        drivers.append(driver)
        driver.connect()
        return driver

    yield make
    for driver in drivers:
        driver.close()


def run(driver, duration=1.0, **options):
    with blf.ArmController(CONFIG, **options) as controller:
        feedback = driver.config.feedback
        loop = DriveLoop(driver, controller, duration=duration, feedback=feedback)
        return loop.run()


def assert_holds(frame):
    """It is stiff and rests, within half a step of 22 mrad/s, and carries the arm."""
    assert (frame.stiffness > 0.0).all()
    assert (np.abs(frame.velocity) < 0.02).all()
    assert np.abs(frame.torque).max() > 1.0  # N m


def of_yam():
    """The preset as it is: 250 Hz, play of its gears, gains of its maker."""
    return Path('config/yam.yaml').read_text()


def of_page():
    """The file of the page: LeRobot's gains, and a posture to hold."""
    page = MarkdownIt().parse(Path('doc/motor_arms.md').read_text())
    texts = [block.content for block in page if block.info == 'yaml']
    (text,) = [text for text in texts if 'driver: damiao' in text]
    return text


@pytest.mark.parametrize(('text', 'motors'), [(of_page, 7), (of_yam, 6)])
def test_command_line_drives_the_motors_and_its_bag_replays(
    text, motors, tmp_path, capsys
):
    file = tmp_path / 'my.yaml'
    file.write_text(
        text().replace('driver: damiao', f'driver: {lockstep_damiao.__file__}')
    )
    bag = tmp_path / 'bag'
    robot = f'virtual:{text.__name__}'
    arguments = ['--robot', robot, '--config', str(file), '--out', str(bag)]
    assert main(['drive', *arguments, '--duration', '3']) == 0
    printed = capsys.readouterr()
    assert f'{motors} motors answer on {robot}' in printed.out + printed.err
    assert 'and 0 missed' in printed.out
    verified = blf.verify(bag)
    assert verified.difference is None
    recorded = blf.read_run(bag)
    late = recorded.error[400:700]  # on the reference, before the end
    assert np.abs(late).max() < 6e-3  # rad: with LeRobot's gains, friction takes 4 mrad


def test_at_the_end_the_motors_hold(made):
    driver = made(feedback='host')
    outcome = run(driver)
    assert outcome.end is End.DURATION
    before = driver.positions()
    driver.motors.arm.advance(driver.motors.frame, 2000)  # 1 s
    # rad: it rests as far as velocities in steps of 22 mrad/s show, and may creep on
    assert np.abs(driver.positions() - before).max() < 0.03
    assert set(driver.motors.status) == {Status.ENABLED}
    held = driver.motors.frame
    np.testing.assert_allclose(held.stiffness, 10.0 * held.damping, atol=0.2)  # steps
    np.testing.assert_allclose(held.velocity, 0.0, atol=0.03)
    assert (held.damping > 0.1).all()


def test_at_the_end_the_motors_are_disabled_where_that_is_wanted(made):
    driver = made(at_end='release')
    run(driver, 0.3)
    driver.start()
    driver.read()  # which says if one is not enabled again
    driver.finish()
    wait_for(lambda: set(driver.motors.status) == {Status.DISABLED})


def fail(joint, status):
    """A motor that stops, before a run or within one."""

    def happen(of):
        getattr(of, 'motors', of).status[joint] = status

    return happen


@pytest.mark.parametrize(
    ('status', 'text'),
    [
        (Status.HOT_ROTOR, r'its winding is too hot: let it cool.*winding 30 deg C'),
        (Status.DISABLED, 'it is not enabled: another program has disabled it'),
    ],
)
def test_a_motor_that_stops_ends_the_run_and_the_others_hold(made, status, text):
    driver = made(at={100: fail(6, status)})
    outcome = run(driver)
    assert outcome.end is End.REFLEX
    assert outcome.states in (99, 100)  # the last frame may have been answered already
    assert 'motor 0x07 of openarm_left_joint7 has stopped' in outcome.text
    assert re.search(text, outcome.text)
    assert_holds(Frame(*np.array(driver.motors.frame)[:, :6]))


def test_lost_answers_are_bridged_and_a_silent_motor_ends_the_run(made, monkeypatch):
    def mute(driver):
        monkeypatch.setattr(LockstepTicks, 'answers', 0.2)
        driver.motors.mute = {2}

    def unmute(driver):
        driver.motors.mute = set()
        monkeypatch.setattr(LockstepTicks, 'answers', lockstep_damiao.PATIENCE)

    driver = made(at={100: mute, 104: unmute, 150: mute})
    read, states = driver.read, []
    monkeypatch.setattr(driver, 'read', lambda: states.append(read()) or states[-1])
    outcome = run(driver)
    # the answer of state 100 may be there already
    for before, bridged in pairwise(states[100:103]):
        assert bridged.dq[2] == before.dq[2] != 0.0
        assert bridged.q[2] == before.q[2] + 0.004 * before.dq[2]
    assert outcome.end is End.LOST
    assert outcome.states in (
        159,
        160,
    )  # the frame before may have been answered already
    assert (
        'motor 0x03 of openarm_left_joint3 has not answered 11 frames' in outcome.text
    )
    unmute(driver)
    for _ in range(3):  # they have got the frames before
        driver.positions()
    assert_holds(driver.motors.frame)
    driver.start()
    assert not driver._missed.any()  # what was lost before counts no more


def test_last_frame_holds_with_the_whole_torque_of_the_one_before(made):
    driver = made()
    driver.start()
    q = driver.read().q
    one = np.ones(7)
    driver.write_frame(Frame(q + 0.05, 0.0 * one, 40.0 * one, one, 0.5 * one))
    driver.finish()
    for _ in range(3):  # answers to both frames, and then they have got the last
        driver.positions()
    # N m: 40 N m/rad times 0.05 rad, and 0.5; velocities have steps of 22 mrad/s
    np.testing.assert_allclose(driver.motors.frame.torque, 2.5, atol=0.1)


def send_from_elsewhere(driver, identifier=0, data=b'', **given):
    """Send a frame on the bus of a driver."""
    channel = driver.address.partition(':')[2]
    with can.Bus(interface='virtual', channel=channel) as bus:
        bus.send(
            can.Message(
                arbitration_id=identifier, data=data, is_extended_id=False, **given
            )
        )


def test_another_client_on_the_bus_ends_the_run_and_the_motors_hold(made):
    def interfere(driver):
        send_from_elsewhere(driver, 2, damiao.ENABLE)
        for joint in range(7):
            data = damiao.request_data(joint + 1, damiao.REFRESH)
            send_from_elsewhere(driver, damiao.TO_ALL, data)

    driver = made(at={100: interfere}, feedback='host')
    with pytest.raises(
        DriverError, match=r'another program commands these motors.*0x002'
    ):
        run(driver)
    wait_for(lambda: driver.motors.frame.stiffness.min() > 0.0)
    assert_holds(driver.motors.frame)


def test_answer_that_comes_too_late_is_none_to_the_next_frame(made):
    """Else the loop would be a period behind this motor from then on."""
    driver = made()
    driver.start()
    before = driver.read()
    late = damiao.StateCodes(7, Status.ENABLED, 0, 2048, 2048, 30, 30)  # at -12.5 rad
    send_from_elsewhere(driver, 0x17, damiao.state_data(late))
    driver.write_frame(torque_alone(np.zeros(7)))
    np.testing.assert_allclose(driver.read().q, before.q, atol=0.01)  # rad, in 4 ms
    send_from_elsewhere(driver, 0x17, damiao.state_data(late))
    np.testing.assert_allclose(driver.positions(), before.q, atol=0.01)


def test_an_error_frame_ends_the_run_and_the_motors_hold(made, monkeypatch):
    """It may tell of a disturbance that is over: a host's last torque would move the arm.

    It comes while the answer of a motor is waited for.
    """
    monkeypatch.setattr(LockstepTicks, 'answers', 0.2)

    def mute(driver):
        driver.motors.mute.add(6)

    def break_bus(driver):
        send_from_elsewhere(driver, is_error_frame=True)

    driver = made(at={99: mute, 100: break_bus}, feedback='host')
    outcome = run(driver)
    assert outcome.end is End.LOST
    assert 'the CAN bus reports an error, or is off' in outcome.text
    wait_for(lambda: driver.motors.frame.stiffness.min() > 0.0)
    assert_holds(driver.motors.frame)


@pytest.mark.parametrize(
    ('arrange', 'given', 'text'),
    [
        (
            lambda motors: motors.modes.__setitem__(3, 2),
            {},
            'motor 0x04 of openarm_left_joint4 is in mode 2, but frames need mode 1',
        ),
        (lambda motors: motors.mute.add(1), {}, 'motor 0x02 .*: no answer on virtual'),
        (fail(0, Status.OVER_VOLTAGE), {}, 'has stopped: its voltage is too high'),
        (None, {'motor_ids': [1, 2]}, 'got 2 and 2, but the arm has 7 joints'),
    ],
)
def test_motors_that_cannot_be_driven_are_named(
    made, arrange, given, text, monkeypatch
):
    monkeypatch.setattr(LockstepDriver, 'patience', 2.0)
    with pytest.raises(DriverError, match=text):
        made(arrange, **given)


TURNED = {
    'motor_directions': [1, -1, 1, -1, -1, 1, -1],
    'motor_offsets': [0.3, -0.2, 0.0, 1.0, -0.7, 0.05, 2.0],  # rad
}


def test_motors_that_turn_the_other_way_from_another_zero_get_and_send_theirs(made):
    """Frames for motors at d q + o, to half a step, and their answers as damiao-motor has them."""
    theirs = pytest.importorskip('damiao_motor.core.motor').DaMiaoMotor
    driver = made(can_fd=True, **TURNED)
    d, o = np.array(TURNED['motor_directions']), np.array(TURNED['motor_offsets'])
    np.testing.assert_allclose(driver.ranges.position.most, 12.5 - d * o)
    q, dq, torque = np.random.default_rng(4).uniform(-0.9, 0.9, (3, 7))
    driver.start()
    with can.Bus(interface='virtual', channel=driver.address.partition(':')[2]) as spy:
        driver.write_frame(Frame(q, dq, np.full(7, 100.0), np.ones(7), torque))
        seen = [spy.recv(lockstep_damiao.PATIENCE) for _ in range(14)]
        state = driver.read()
    assert all(each.is_fd for each in seen if each.arbitration_id <= 7)
    data = {each.arbitration_id: bytes(each.data) for each in seen}
    for i, model in enumerate(driver.config.motor_models):
        ranges = damiao.ranges_of([damiao.MODELS[model]])
        codes = damiao.codes_of_command(data[i + 1])
        at_motor = (d[i] * q[i] + o[i], d[i] * dq[i], 100.0, 1.0, d[i] * torque[i])
        for field, code, wanted in zip(ranges, codes, at_motor, strict=True):
            assert abs(field.values([code]) - wanted) <= 0.5 * field.step + 1e-12
        motor = theirs(i + 1, 0x11 + i, None, motor_type=model)
        found = motor.decode_sensor_feedback(data[0x11 + i])
        assert state.q[i] == pytest.approx(d[i] * (found['pos'] - o[i]), abs=1e-12)
        assert state.dq[i] == pytest.approx(d[i] * found['vel'], abs=1e-12)
        assert state.effort[i] == pytest.approx(d[i] * found['torq'], abs=1e-12)


def test_two_motors_with_one_identifier_are_named(made):
    others = []

    def double(motors):
        bus = can.Bus(interface='virtual', channel=motors._bus.channel_info.split()[-1])
        plant = loop_of(0.004).plant
        others.append(LockstepArm(bus, plant, lockstep_damiao.LIMITS))
        thread = threading.Thread(target=others[0].serve_in_lockstep, daemon=True)
        thread.start()

    with pytest.raises(DriverError, match='answers twice: two motors on virtual'):
        made(double)
    others[0]._bus.shutdown()


def test_motors_that_bear_less_than_the_torque_limit_are_named(made, monkeypatch):
    weak = [damiao.MODELS['4310']] * 7
    monkeypatch.setattr(lockstep_damiao, 'LIMITS', weak)
    with pytest.raises(
        DriverError, match=r'got 40 N m .*joint1, whose frames hold 10 N m'
    ):
        made()


def test_a_bus_that_cannot_be_opened_says_how_to_give_one():
    with pytest.raises(DriverError, match='give a channel such as can0'):
        CanBus('nowhere_like_this', (), fd=False)


def test_motors_in_a_process_of_their_own_answer():
    """`python -m sim_plant.damiao` on a bus between processes; no motion, which takes time."""
    bus = 'udp_multicast:239.74.163.9'
    pytest.importorskip('msgpack')
    try:
        CanBus(bus, (), fd=False).close()
    except DriverError as error:
        pytest.skip(f'{error}')
    command = [sys.executable, '-u', '-m', 'sim_plant.damiao', '--bus', bus]
    environment = os.environ | {'PYTHONPATH': os.pathsep.join(filter(None, sys.path))}
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, env=environment
    )
    try:
        assert '7 motors on' in process.stdout.readline()
        with closing(DamiaoDriver(bus, CONFIG, DriveConfig())) as driver:
            assert driver.connect() == [f'7 motors answer on {bus}']
            positions = driver.positions()
        wanted = loop_of(0.004).plant.initial.position
        np.testing.assert_allclose(positions, wanted, atol=4e-3)  # rad: gears give way
    finally:
        process.kill()
        process.wait()


def test_joints_are_shown_without_a_torque_and_a_turn_too_much_is_told(
    tmp_path, capsys
):
    """As a motor may read after its power was off."""
    file = tmp_path / 'my.yaml'
    offsets = 'motor_offsets: [0.0, 0.0, 0.0, 0.0, 6.2831853, 0.0]'
    driver = f'driver: {lockstep_damiao.__file__}\n    {offsets}'
    file.write_text(of_yam().replace('driver: damiao', driver))
    arguments = ['--robot', 'virtual:joints', '--config', str(file), '--period', '0']
    with can.Bus(interface='virtual', channel='joints') as spy:
        assert show_joints.main(arguments) == 0
        senders = {each.arbitration_id for each in iter(lambda: spy.recv(0.0), None)}
    assert senders == {damiao.TO_ALL, *range(0x11, 0x17)}  # questions and answers
    printed = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in printed] == [f'joint{i}' for i in range(1, 7)]
    config = blf.load_loop('yam').controller
    chain = config.robot.chain(config.joints)
    told = list(show_joints.lines(chain, [0.1, -5.3, 1.1, 0.1, 6.2, 0.0]))
    assert told[0].endswith('0.100 of -2.62 to 3.14 rad')
    assert 'outside: +6.283 rad, a turn, would be within' in told[1]
    assert 'outside: -6.283 rad, a turn, would be within' in told[4]
