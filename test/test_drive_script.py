# SPDX-License-Identifier: Apache-2.0
"""`blf.Drive`: a script's motions, its errors, and what the arm does when either side ends.

The simulated arm waits for its torques: on a slow computer it is slow, and all else is the same.
"""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from command import COMPILED, wait_for
from recorded_run import messages_of

import blf_dsc_controller as blf
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.configuration.drive import DriveConfig
from blf_dsc_controller.configuration.nodes import PLANT
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.drive import loop_process, script_process
from blf_dsc_controller.drive.arguments import checked_overrides
from blf_dsc_controller.drive.driver import ReflexError, disagreements
from blf_dsc_controller.drive.loop_process import LoopProcess
from blf_dsc_controller.drive.script import Script, _far_beyond
from blf_dsc_controller.drive.simulated import SIMULATED, simulated
from blf_dsc_controller.errors import (
    DriveError,
    LoopEndedError,
    MissingExtraError,
    MotionFailedError,
    NotInTimeError,
)
from blf_dsc_controller.messages import script_link, topic_link
from blf_dsc_controller.messages.journal import EventType, decode
from blf_dsc_controller.messages.link import Link
from blf_dsc_controller.messages.topics import TARGETS
from blf_dsc_controller.run import SLIDING, TURNING
from blf_dsc_controller.supervision.guard import Guard

# rad: the bound of the preset, to which any error of the arm adds up
NEAR = 0.045
STEP = np.array([0.0, 0.1, 0.0, 0.3, 0.0, -0.2, 0.1])  # rad


def drive(record=None, **given):
    return blf.Drive('panda', given, robot='simulated', record=record)


def rests(arm):
    """The reference does."""
    before = arm.state
    wait_for(lambda: arm.state.time > before.time + 0.05)
    return np.array_equal(before.reference, arm.state.reference)


def test_command_controls_the_simulated_arm_too(tmp_path, capsys):
    out = tmp_path / 'bag'
    words = ['drive', '--robot', 'simulated', '--config', 'panda', '--duration', '0.5']
    assert main([*words, '--out', str(out)]) == 0
    assert re.search(r'states +\d{3,}, and 0 missed', capsys.readouterr().out)
    assert blf.verify(out).difference is None


def test_simulated_drives_stop_by_themselves_and_are_released_where_they_are():
    loop = blf.load_loop('fr3_direct')
    made = simulated(loop.plant)
    driver = made(SIMULATED, loop.controller, DriveConfig())
    driver.connect()
    driver.start()
    for torque in (np.zeros(7), np.full(7, 5.0)):  # 5 N m in 1 ms, of 1 N m allowed
        driver.read()
        driver.write(torque)
    with pytest.raises(ReflexError, match=r'actuator\.reflex_rate'):
        driver.read()
    before = driver.positions()
    driver.recover()
    driver.start()
    np.testing.assert_allclose(driver.read().q, before, atol=1e-4)


def test_simulated_drives_take_no_first_torque_for_a_jump():
    """They hold the arm between two runs, also where it needs 5 N m."""
    loop = blf.load_loop('fr3_direct')
    driver = simulated(loop.plant)(SIMULATED, loop.controller, DriveConfig())
    driver.connect()
    driver.start()
    for k in range(6):
        driver.write(np.full(7, float(k)))  # N m: 1000 N m/s
    driver.read()
    driver.finish()
    driver.start()
    driver.write(np.zeros(7))
    driver.read()
    driver.write(np.full(7, 5.0))
    with pytest.raises(ReflexError, match='faster than'):
        driver.read()


def test_simulated_brakes_leave_no_torque_of_an_earlier_run_to_the_next():
    """It would look like drives that hold the arm, and the law would refuse to start."""
    loop = blf.load_loop('ur5e')
    driver = simulated(loop.plant)(SIMULATED, loop.controller, DriveConfig())
    driver.connect()
    driver.start()
    for _ in range(6):
        driver.write(np.full(6, 5.0))  # N m
    assert (driver.read().effort > 1.0).all()
    driver.finish()
    driver.start()
    np.testing.assert_array_equal(driver.read().effort, np.zeros(6))


def test_simulated_robot_reports_motors_that_have_encoders():
    loop = blf.load_loop('panda', {PLANT: {'sensor.side': 'both'}})
    for plant, has in ((loop.plant, True), (blf.load_loop('panda').plant, False)):
        driver = simulated(plant)(SIMULATED, loop.controller, DriveConfig())
        driver.connect()
        driver.start()
        state = driver.read()
        assert (state.motors is not None) == has
        if has:
            np.testing.assert_allclose(state.motors[0], state.q, atol=0.01)  # rad
            assert (state.motors[0] != state.q).any()  # gravity twists them


def test_motions_arrive_and_the_bag_replays_bit_equal(tmp_path):
    with drive(tmp_path / 'bag') as arm:
        assert arm.state.phase == 'tracking'
        start = arm.state.q
        arm.move_to(start + STEP, speed=1.0)
        np.testing.assert_allclose(arm.state.q, start + STEP, atol=NEAR)
        assert rests(arm)
        arm.follow([(0.5, start + 0.5 * STEP), (1.0, start)])
        np.testing.assert_allclose(arm.state.q, start, atol=NEAR)
        for k in range(30):
            arm.stream(start + 0.01 * min(k, 10))
            time.sleep(1.0 / 30.0)
        wait_for(lambda: rests(arm))
        np.testing.assert_allclose(arm.state.q, start + 0.1, atol=NEAR)
        assert (np.abs(arm.state.error) < arm.state.bound).all()
    assert arm.ended == 'ended on request'
    assert blf.verify(tmp_path / 'bag').difference is None
    sent = messages_of(tmp_path / 'bag')[TARGETS.resolved]
    kinds = [decode(raw).type for raw in sent]
    assert kinds.count(EventType.TRAJECTORY) == 2
    assert kinds.count(EventType.TARGET) > 2  # the latest wins while one is planned


@pytest.mark.parametrize(
    ('positions', 'named'),
    [
        ([0.5, 0.05], ''),
        ([-3.0, 0.2], ''),  # past the limits: braked on the way there
        (
            [30.0, 0.05],
            'a is to be at 30 rad, and its limits are -2 to 1: not followed. If these are degr',
        ),
        (
            [0.5, -45.0],
            'b is to be at -45 m, and its limits are 0 to 0.1: not followed. If these are mm, ',
        ),
    ],
)
def test_only_what_may_be_degrees_is_no_target_of_a_stream(positions, named):
    limits = SimpleNamespace(position_lower=(-2.0, 0.0), position_upper=(1.0, 0.1))
    config = SimpleNamespace(joints=('a', 'b'), limits=limits, units=(TURNING, SLIDING))
    found = _far_beyond(np.array(positions), config)
    assert bool(found) == bool(named)
    assert named in found


def test_move_takes_as_long_in_either_direction_and_longer_at_a_part_of_the_speed():
    guard = Guard(blf.load_loop('recommended').controller)
    guard.controller.reference_at = lambda _: np.zeros((3, 2))
    script = SimpleNamespace(_guard=guard)

    def seconds(far, speed):
        wanted = {'positions': [far, 0.0], 'speed': speed}
        (point,) = Script._move(script, wanted).points
        assert point.positions == (far, 0.0)
        return point.time

    assert seconds(0.5, 0.2) == seconds(-0.5, 0.2) > 1.5 * seconds(0.5, 0.8) > 0.1


def test_next_loop_answers_no_stop_of_the_one_before():
    """Its time begins anew, and the stop has been an error there."""
    script = SimpleNamespace(_braking=[(0.5, 3)])
    Script.begin(script, loop=None)
    assert not script._braking


@pytest.mark.parametrize(
    ('given', 'message'),
    [
        ({'config': None}, 'config: got NoneType, but a parameter file or'),
        ({'config': DriveConfig()}, 'config: got DriveConfig.*overrides take values'),
        ({'robot': None}, "robot: got None, but its address is needed, or 'simulated'"),
        ({'robot': ' '}, "or 'simulated'"),
        ({'record': True}, 'record: got True, but a new folder is needed'),
        ({'overrides': ['a']}, "overrides: got list: give them by node .* {'drive'"),
        (
            {'overrides': {'controller': {'a': 1}}},
            "got 'controller', but the nodes of a",
        ),
        ({'overrides': {'barrier.bound': [0.1]}}, "got 'barrier.bound', but the nodes"),
        ({'overrides': {'drive': 'motor'}}, 'overrides: drive: got str: give them by'),
        (
            {'overrides': {'drive': {'feedback': {1}}}},
            'feedback: got set, but a number',
        ),
    ],
)
def test_what_no_drive_can_be_made_of_is_refused_in_one_line(
    given, message, monkeypatch
):
    def start(_wanted):
        raise AssertionError('a process was started')

    monkeypatch.setattr('blf_dsc_controller.drive.drive.LoopProcess', start)
    arguments = {'config': 'panda', 'robot': 'simulated', **given}
    with pytest.raises(DriveError, match=message) as raised:
        blf.Drive(**arguments)
    assert '\n' not in str(raised.value)


def test_values_of_overrides_may_be_paths_and_arrays():
    given = {'bound': np.full(2, 0.5), 'few': (np.float32(0.5), True), 'at': Path('a')}
    found = checked_overrides({'drive': given})
    assert json.loads(json.dumps(found)) == found
    assert found == {'drive': {'bound': [0.5, 0.5], 'few': [0.5, True], 'at': 'a'}}


def test_load_is_declared_to_drives_that_compensate_and_no_torque_changes(tmp_path):
    """An arm that holds nothing: what the drives add, the command lacks."""
    with blf.Drive('fr3_direct', robot='simulated', record=tmp_path / 'bag') as arm:
        before = arm.state
        arm.load(1.0, (0.0, 0.0, 0.05))
        # N m: the weight of 1 kg about joint 2, an arm's length away
        wait_for(lambda: abs(arm.state.tau[1] - before.tau[1]) > 3.0)
        arm.load(0.0)
        wait_for(lambda: np.abs(arm.state.tau - before.tau).max() < 0.5)
        with pytest.raises(DriveError, match='got -1 kg'):
            arm.load(-1)
    verified = blf.verify(tmp_path / 'bag')
    assert verified.difference is None
    # rad: friction that holds the arm takes up the steps
    error = blf.read_run(tmp_path / 'bag').error
    assert np.nanmax(np.abs(error)) < 1e-3


# a Panda whose efforts are its commands
ECHO = {
    'actuator.loop_gain': 0.0,
    'actuator.loop_damping': 0.0,
    'joint.stiffness': [5e4] * 7,
}
DISTRUSTED = (
    r'the efforts are what is commanded.* the load observer is off.* A driver of `blf_dsc drive` '
    r'.*takes no other: with one, set disturbance\.observer_bandwidth to 0'
)


def test_section_that_no_node_reads_is_named(tmp_path, caplog):
    caplog.set_level('INFO')
    path = tmp_path / 'given.yaml'
    path.write_text(
        '/**/blf_dsc_controller:\n  ros__parameters: {sample_time: 0.001}\n'
        '/**/controller:\n  ros__parameters: {barrier: {bound: [0.1, 0.1]}}\n'
    )
    with blf.Drive(path, robot='simulated'):
        wait_for(lambda: 'reads the sections /**/controller (line ' in caplog.text)


def test_efforts_that_are_not_of_sensors_are_told_and_what_a_driver_takes(caplog):
    with drive(sim_plant=ECHO) as arm:
        arm.move_to(arm.state.q + STEP)
        wait_for(lambda: 'load observer is off' in caplog.text)
    assert re.search(DISTRUSTED, caplog.text)
    assert caplog.text.count('load observer is off') == 1
    loop = blf.load_loop('panda', {PLANT: ECHO})
    config = change(loop.controller, {'disturbance.observer_bandwidth': 0.0})
    assert not disagreements(simulated(loop.plant).facts, config)


def test_command_ends_with_what_is_wrong_with_the_efforts(tmp_path, capsys):
    preset = (blf.share_folder() / 'config/panda.yaml').read_text()
    for name in ('loop_gain', 'loop_damping'):
        preset = re.sub(f' {name}: .*', f' {name}: 0.0', preset)
    preset = re.sub(r' stiffness: \[1.4e.*', f' stiffness: {[5e4] * 7}', preset)
    (tmp_path / 'my.yaml').write_text(preset)
    words = ['--robot', 'simulated', '--config', f'{tmp_path / "my.yaml"}']
    assert main(['drive', *words, '--duration', '0.8']) == 0
    assert re.search('sensors +' + DISTRUSTED, capsys.readouterr().out)


def test_a_stop_of_the_controller_is_an_error_and_can_be_recovered():
    """80 N m for 0.1 s, against 600 N m/rad and a bound of 49 mrad.

    In a motion of ten seconds, which has begun by then.
    """
    push = {
        'events.begin': [3.0],
        'events.duration': [0.1],
        'events.payload': [0.0],
        'events.torque': [0.0, 80.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    }
    with drive(sim_plant=push) as arm:
        start = arm.state.q
        with pytest.raises(LoopEndedError, match=r'the controller stopped: .*recover'):
            arm.move_to(start + STEP, speed=0.02)
        assert 'the controller stopped' in arm.ended
        with pytest.raises(LoopEndedError, match='the controller stopped'):
            arm.stream(start)
        arm.recover()
        arm.move_to(start, speed=0.5)
        np.testing.assert_allclose(arm.state.q, start, atol=NEAR)


def test_a_script_is_told_that_the_arm_runs_once_the_law_has_its_first_sample():
    """A start may be refused, or wait for states, for long."""
    beside, told = Script.__new__(Script), []
    reference = SimpleNamespace(time=0.0)
    guard = SimpleNamespace(has_sample=False, reference=reference)
    link = SimpleNamespace(flush=lambda: False, put=lambda kind, _: told.append(kind))
    beside._guard, beside._link, beside._told = guard, link, 0.0
    beside._controller = SimpleNamespace(joints=('joint1',))
    beside._goals = SimpleNamespace(watch=lambda _: None)
    beside._loop = beside._loading = None
    beside._braking, beside._tells_running = [], True
    beside._tell_changes()
    assert told == []
    guard.has_sample = True
    for _ in range(3):
        beside._tell_changes()
    assert told == [script_link.RUNNING]


def test_second_signal_ends_the_loop_at_once():
    """The first one brakes the arm before the loop is asked to end."""
    script, requests = Script.__new__(Script), []
    script._asked = 0
    script._loop = SimpleNamespace(request_end=lambda: requests.append('end'))
    script.request_close()
    assert not requests
    script.request_close()
    assert len(requests) == 2  # at a second request, the loop ends at once


@pytest.fixture
def silent(monkeypatch):
    """A loop that runs and whose process tells nothing, and the clock [s] of its script."""
    clock = SimpleNamespace(now=0.0, monotonic=lambda: clock.now)
    monkeypatch.setattr(loop_process, 'time', clock)
    loop = LoopProcess.__new__(LoopProcess)
    loop._owner, loop._closed = os.getpid(), False
    loop._news = threading.Condition()
    loop._link = SimpleNamespace(put=lambda *_: None, flush=lambda: True)
    loop._forget()
    tell(loop, script_link.RUNNING, ['joint1'])
    return loop, clock


def tell(loop, kind, content):
    loop._take(kind, topic_link.encode(content))


def test_loop_that_says_nothing_for_a_minute_is_an_error(silent):
    """Else a script would wait for ever for one that hangs."""
    loop, clock = silent
    clock.now = 59.0
    tell(loop, topic_link.LOG, {'level': 'info', 'text': 'a word'})
    clock.now = 118.0
    loop.check()
    clock.now = 120.0
    with pytest.raises(LoopEndedError, match='nothing for 61 s: look at the arm'):
        loop.check()


@pytest.mark.parametrize('says', [True, False])
def test_loop_that_ends_is_waited_for_as_long_as_it_says_something(
    silent, caplog, says
):
    """A minute at most after its last word; then it is killed."""
    loop, clock = silent
    clock.now = 300.0  # nobody has asked meanwhile

    def poll():
        clock.now += 10.0
        if says:
            tell(loop, topic_link.LOG, {'level': 'info', 'text': 'it brakes'})
        return 0 if clock.now > 400.0 else None

    loop._process = SimpleNamespace(poll=poll)
    loop._close_softly()
    assert ('the loop does not end: silent for 60 s' in caplog.text) != says
    assert clock.now == (410.0 if says else 380.0)  # a look each 10 s


def test_a_block_does_not_end_silently_with_an_arm_that_has_stopped():
    push = {'events.begin': [0.2], 'events.force': [0.0, 0.0, 500.0]}
    given = {'sim_plant': push | {'events.duration': [0.1], 'events.payload': [0.0]}}
    arm = blf.Drive('panda', given, robot='simulated')
    with pytest.raises(LoopEndedError, match='the controller stopped'), arm:
        wait_for(lambda: arm.ended)


def test_a_drive_that_was_closed_says_so():
    with drive() as arm:
        start = arm.state.q
    orders = (
        lambda: arm.state,
        lambda: arm.is_moving,
        lambda: arm.move_to(start),
        arm.stop,
    )
    for order in orders:
        with pytest.raises(
            LoopEndedError, match=r'this Drive was closed.*make another'
        ):
            order()
    arm.wait()
    arm.close()


def test_a_process_that_is_killed_is_an_error_and_another_can_be_started(tmp_path):
    with drive(tmp_path / 'bag') as arm:
        os.kill(arm._loop.pid, signal.SIGKILL)
        with pytest.raises(
            LoopEndedError, match=r'ended by signal 9, without .* recover\(\) starts'
        ):
            arm.move_to(arm.state.q)
        arm.recover()
        assert rests(arm)
    assert blf.verify(tmp_path / 'bag_2').difference is None


@pytest.mark.parametrize(
    ('config', 'robot', 'message'),
    [
        ('pando', 'simulated', 'pando does not exist, did you mean panda'),
        (
            'ur5e',
            '192.0.2.1',
            'ur5e.yaml, for the driver franka:\n  - joints: got 6, but the robot has 7',
        ),
    ],
)
def test_a_start_that_fails_says_why(config, robot, message):
    if robot != 'simulated':
        pytest.importorskip('pylibfranka')
    with pytest.raises(DriveError) as raised:
        blf.Drive(config, robot=robot)
    assert message in str(raised.value)


def test_a_mistake_that_nobody_foresaw_is_told_to_the_script(monkeypatch):
    """Before its process ends with the traceback."""

    def fail(*_):
        raise ZeroDivisionError('a mistake')

    ours, theirs = socket.socketpair()
    monkeypatch.setattr(script_process, '_awaited', fail)
    monkeypatch.setattr(sys, 'argv', ['script_process', str(theirs.detach())])
    with pytest.raises(ZeroDivisionError):
        script_process.main()
    link = Link(ours)
    ((kind, content),) = link.messages()
    link.close()
    assert kind == script_link.FAILED
    assert 'ZeroDivisionError: a mistake' in topic_link.decode(content)


# Without a function or a guard, as in a notebook.
SCRIPT = """
import os, signal, sys, time
import blf_dsc_controller as blf
arm = blf.Drive('panda', robot='simulated', record=sys.argv[2])
q = arm.state.q + 0.5
{}
print('moving', flush=True)
{}
"""
# Ends once the arm is seen to move, however slow the computer is.
MOVES = """
start = arm.state.q
arm.move_to(q, speed=1.0, wait=False)
while abs(arm.state.q - start).max() < 0.01: time.sleep(0.01)
"""
# Its fork holds the link to the loop, and ends once the bag is whole.
FORKED = """
if not os.fork():
    os.close(1), os.close(2)
    for _ in range(2500):
        if os.path.exists(sys.argv[2] + '/metadata.yaml'): break
        time.sleep(0.1)
    os._exit(0)
os.kill(os.getpid(), signal.SIGKILL)
"""
# As a service or a container that is stopped gets it, in all of its processes.
TERMINATED = 'os.kill(arm._loop.pid, signal.SIGTERM); arm.wait()'
STREAMS = """
start = arm.state.q
while abs(arm.state.q - start).max() < 0.01:
    arm.stream(start + 0.05)
    time.sleep(0.01)
"""


@pytest.mark.parametrize(
    ('begin', 'end', 'code', 'said'),
    [
        (MOVES, '', 0, ''),
        (MOVES, 'raise RuntimeError("a mistake")', 1, 'a mistake'),
        (MOVES, FORKED, -9, ''),
        (MOVES, TERMINATED, 1, 'pre-empted by the end of the script'),
        (STREAMS, 'os._exit(3)', 3, ''),
        (
            MOVES,
            'with arm: os.kill(os.getpid(), signal.SIGINT); arm.wait()',
            -2,
            'KeyboardInterrupt',
        ),
    ],
)
def test_a_script_that_ends_in_any_way_leaves_an_arm_at_rest(
    begin, end, code, said, tmp_path
):
    script = tmp_path / 'script.py'
    script.write_text(SCRIPT.format(begin, end))
    ended = subprocess.run(
        [sys.executable, script, 'x', tmp_path / 'bag'],
        capture_output=True,
        text=True,
        timeout=COMPILED,
        check=False,
    )
    assert ended.returncode == code, ended.stderr
    assert said in ended.stderr
    wait_for((tmp_path / 'bag' / 'metadata.yaml').exists)
    verified = blf.verify(tmp_path / 'bag')
    assert verified.difference is None
    events = {event.type: event.content for event in verified.events}
    assert EventType.BRAKE in events
    assert events[EventType.RELEASE]['resting']
    run = blf.read_run(tmp_path / 'bag')
    # rad in 1 ms: it moved, also on a slow computer
    assert np.nanmax(np.abs(np.diff(run.reference, axis=0))) > 1e-6
    assert np.abs(run.velocity[-1]).max() < 0.02  # rad/s


# Of one arm, last: it moves in real time until the end of the file.


@pytest.fixture(scope='module')
def arm():
    with drive() as found:
        yield found


def test_what_cannot_be_done_is_refused_with_the_reason_and_the_arm_holds(arm):
    before = arm.state.reference
    with pytest.raises(DriveError, match='7 finite values are needed'):
        arm.move_to([0.0, 1.0])
    with pytest.raises(DriveError, match='7 finite values are needed'):
        arm.stream([np.nan] * 7)
    with pytest.raises(DriveError, match='speed: got 1'):
        arm.move_to(before, speed=1.5)
    for wrong in ('home', [[0.1, 0.2], [0.3]], {'elbow': 0.1}):
        with pytest.raises(DriveError, match='7 finite values are needed'):
            arm.move_to(wrong)
    for wrong in ([1.0, 2.0], [('now', [0.1] * 7)], 1.0):
        with pytest.raises(DriveError, match='must be a time and positions'):
            arm.follow(wrong)
    with pytest.raises(DriveError, match='where a list of numbers belongs'):
        arm.follow([[1.0, *before]])  # a row of a table
    with pytest.raises(DriveError, match='points: got none'):
        arm.follow([])
    with pytest.raises(DriveError, match='the last one is at 0 s'):
        arm.follow([(0.0, before + 0.1)])
    with pytest.raises(MotionFailedError, match=r"panda_joint\d' at .* rad, past"):
        arm.move_to(before + 9.0)
    with pytest.raises(MotionFailedError, match='elbow'):
        arm.follow([(1.0, [0.0])], ['elbow'])
    np.testing.assert_array_equal(arm.state.reference, before)
    assert not arm.is_moving


def test_arguments_that_are_none_are_refused_before_the_arm_moves(arm):
    before = arm.state.reference
    there = before + 0.1
    for wrong in (0.0, 1.5, np.nan, 'fast', [0.1] * 7, None):
        with pytest.raises(DriveError, match=r'speed: got .* above 0, up to 1'):
            arm.move_to(there, speed=wrong)
    for wrong in (-1.0, np.nan, '5', [1.0]):
        for order in (
            arm.move_to,
            lambda q, timeout: arm.follow([(1.0, q)], timeout=timeout),
        ):
            with pytest.raises(DriveError, match=r'timeout: got .* or None: for ever'):
                order(there, timeout=wrong)
        with pytest.raises(DriveError, match='timeout: got'):
            arm.stop(timeout=wrong)
    for wrong in ('panda_joint1', 1, [1, 2]):
        with pytest.raises(DriveError, match=r'joints: got .*, but a list of names'):
            arm.follow([(1.0, there)], wrong)
    for wrong in (
        ('2 kg',),
        (1.0, 0.1),
        (1.0, 'tip'),
        (np.nan,),
        (1.0, [0.0, np.inf, 0.0]),
    ):
        with pytest.raises(DriveError, match=r'load: got .* three coordinates'):
            arm.load(*wrong)
    np.testing.assert_array_equal(arm.state.reference, before)
    assert not arm.is_moving


def test_degrees_are_refused_with_the_hint_that_they_may_be_some(arm):
    degrees = [0.0, -45.0, 0.0, -135.0, 0.0, 90.0, 45.0]
    with pytest.raises(
        MotionFailedError, match=r'past its limit .*give np\.deg2rad of them'
    ):
        arm.move_to(degrees)
    with pytest.raises(MotionFailedError, match='past its limit') as raised:
        arm.move_to([9.0] * 7)
    assert 'deg2rad' not in str(raised.value)


def test_stream_without_ruckig_says_what_to_install(arm, monkeypatch):
    monkeypatch.setitem(sys.modules, 'ruckig', None)
    with pytest.raises(MissingExtraError, match=r'needs ruckig.*pip install .*streams'):
        arm.stream(arm.state.reference)


def test_streamed_degrees_are_not_followed_and_said_once(arm, caplog):
    before = arm.state.reference
    for _ in range(5):
        arm.stream(np.rad2deg(before))
    wait_for(lambda: 'degrees' in caplog.text)
    assert rests(arm)
    np.testing.assert_array_equal(arm.state.reference, before)
    assert re.search(
        r'panda_joint\d is to be at .* its limits are .*deg2rad', caplog.text
    )
    assert caplog.text.count('deg2rad') == 1
    assert not arm.ended


def test_a_pose_that_is_none_is_refused(arm):
    for wrong in ('home', [0.1, [0.2], 0.3], arm.pose):
        with pytest.raises(
            DriveError, match=r'position: got .* such as pose\.position'
        ):
            arm.move_to_pose(wrong)
    with pytest.raises(DriveError, match=r'rotation: got str.* such as pose\.rotation'):
        arm.move_to_pose(arm.pose.position, 'down')


def test_a_motion_is_waited_for_stopped_and_given_up(arm):
    start = arm.state.q
    arm.move_to(start + STEP, speed=0.02, wait=False)
    assert arm.is_moving  # for ten seconds
    arm.stop()
    assert rests(arm)
    with pytest.raises(MotionFailedError, match=r'pre-empted by stop\(\)|was stopped'):
        arm.wait()
    arm.move_to(start + STEP, speed=0.02, wait=False)
    with pytest.raises(NotInTimeError, match=r'after 0.1 s: the arm has braked'):
        arm.wait(timeout=0.1)
    assert rests(arm)
    arm.move_to(start + STEP, speed=0.02, wait=False)
    arm.move_to(start, speed=1.0)
    np.testing.assert_allclose(arm.state.q, start, atol=NEAR)


def test_ctrl_c_in_a_motion_brakes_the_arm_also_where_no_block_ends(arm):
    """As in a notebook, whose kernel goes on.

    A terminal sends Ctrl-C to all processes of its group: the loop is in none of them.
    """
    assert os.getsid(arm._loop.pid) != os.getsid(0)
    start = arm.state.q

    def interrupt():
        wait_for(lambda: arm.is_moving)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt).start()
    with pytest.raises(KeyboardInterrupt):
        arm.move_to(start + STEP, speed=0.02)
    wait_for(lambda: rests(arm))
    assert np.abs(arm.state.reference - start - STEP).max() > 0.1
    assert not arm.is_moving
    assert arm.state.phase == 'tracking'


def test_a_fork_of_the_script_neither_commands_nor_closes_the_arm(arm):
    """It would wait for ever, since the thread that listens is not there."""
    child = os.fork()
    if not child:
        arm.close()
        try:
            arm.stop()
        except DriveError as error:
            os._exit(42 if 'a fork of it: command the arm there' in str(error) else 1)
        os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 42
    arm.stop()
    assert arm.state.phase == 'tracking'


def test_settings_that_other_packages_have_are_refused(arm):
    """`robot.relative_dynamics_factor = 0.05` would leave the arm ten times as fast."""
    for name in ('relative_dynamics_factor', 'speed'):
        with pytest.raises(DriveError, match=rf'{name}: .*move_to\(q, speed=0\.1\)'):
            setattr(arm, name, 0.05)


def test_a_long_trajectory_is_read_beside_the_loop(arm):
    """9000 points, 4 MB: reading them takes tens of milliseconds."""
    start = arm.state.reference
    times = np.arange(1, 9001) / 5000.0
    wave = 0.05 * np.sin(np.pi * times / times[-1]) ** 2
    arm.follow([(t, start + w) for t, w in zip(times, wave, strict=True)])
    np.testing.assert_allclose(arm.state.reference, start, atol=1e-6)


def test_tare_is_refused_with_the_reason_and_the_arm_holds(arm):
    """The preset computes no external torque."""
    with pytest.raises(MotionFailedError, match=r'set contact\.enabled'):
        arm.tare()
    assert not arm.ended


def test_load_is_not_declared_to_drives_that_add_nothing(arm):
    with pytest.raises(MotionFailedError, match='drive_compensates: got none'):
        arm.load(1.0)


def test_two_threads_that_move_one_arm_both_return(arm):
    """The result of a motion is kept while another begins: nobody waits for ever."""
    start = arm.state.q
    arm.move_to(start, speed=1.0)
    first = arm._number
    for _ in range(2):
        arm.move_to(start, speed=1.0)
    arm._await_result(first, timeout=1.0)
