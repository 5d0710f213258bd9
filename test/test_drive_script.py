# SPDX-License-Identifier: Apache-2.0
"""`blf.Drive`: a script's motions, its errors, and what the arm does when either side ends.

The simulated arm waits for its torques: on a slow computer it is slow, and all else is the same.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from command import COMPILED, wait_for

import blf_dsc_controller as blf
from blf_dsc_controller.bags.content import read_content
from blf_dsc_controller.drive import loop_process

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
    for order in (lambda: arm.state, lambda: arm.move_to(start), arm.stop):
        with pytest.raises(
            blf.LoopEndedError, match=r'this Drive was closed.*make another'
        ):
            order()
    verified = blf.verify(tmp_path / 'bag')
    assert verified.difference is None
    assert verified.motions > 2 + 2  # the latest target wins while one is planned


def test_load_is_declared_to_drives_that_compensate_and_no_torque_changes(tmp_path):
    """An arm that holds nothing: what the drives add, the command lacks."""
    with blf.Drive('fr3_direct', robot='simulated', record=tmp_path / 'bag') as arm:
        before = arm.state
        arm.load(1.0, (0.0, 0.0, 0.05))
        # N m: the weight of 1 kg about joint 2, an arm's length away
        wait_for(lambda: abs(arm.state.tau[1] - before.tau[1]) > 3.0)
        arm.load(0.0)
        wait_for(lambda: np.abs(arm.state.tau - before.tau).max() < 0.5)
        with pytest.raises(blf.DriveError, match='got -1 kg'):
            arm.load(-1)
    verified = blf.verify(tmp_path / 'bag')
    assert verified.difference is None
    # rad: friction that holds the arm takes up the steps
    error = blf.read_run(tmp_path / 'bag').error
    assert np.nanmax(np.abs(error)) < 1e-3


def test_load_that_the_script_knows_is_carried_at_once(tmp_path):
    """The arm holds nothing: it is lifted, until its torque sensors show that."""
    with blf.Drive('fr3_direct', robot='simulated', record=tmp_path / 'bag') as arm:
        arm.expect_load(1.0, (0.0, 0.0, 0.05), interval=0.1)
        with pytest.raises(blf.DriveError, match='none has been weighed'):
            arm.expect_load(remember=True)
        with pytest.raises(blf.DriveError, match='but robot'):
            arm.expect_load(500.0)
        with pytest.raises(blf.DriveError, match="interval: got 'soon'"):
            arm.expect_load(1.0, interval='soon')
        arm.expect_load(0.0)
    assert blf.verify(tmp_path / 'bag').difference is None
    events = [event for _, event in read_content(tmp_path / 'bag').events]
    said = [each.content for each in events if each.type == 'expected load']
    assert [each['mass'] for each in said] == [1.0, 0.0]


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
        with pytest.raises(
            blf.LoopEndedError, match=r'the controller stopped: .*recover'
        ):
            arm.move_to(start + STEP, speed=0.02)
        assert 'the controller stopped' in arm.ended
        with pytest.raises(blf.LoopEndedError, match='the controller stopped'):
            arm.stream(start)
        arm.recover()
        arm.move_to(start, speed=0.5)
        np.testing.assert_allclose(arm.state.q, start, atol=NEAR)


def test_a_loop_that_hangs_or_is_killed_is_an_error_and_another_can_be_started(
    tmp_path, monkeypatch
):
    with drive(tmp_path / 'bag') as arm:
        os.kill(arm._loop.pid, signal.SIGSTOP)
        monkeypatch.setattr(loop_process, '_SILENCE', 0.5)  # s; else ten
        with pytest.raises(
            blf.LoopEndedError, match=r'said nothing for .* look at the arm'
        ):
            arm.move_to(arm.state.q)
        monkeypatch.undo()
        os.kill(arm._loop.pid, signal.SIGKILL)
        with pytest.raises(
            blf.LoopEndedError,
            match=r'ended by signal 9, without .* recover\(\) starts',
        ):
            arm.move_to(arm.state.q)
        arm.recover()
        assert rests(arm)
    assert blf.verify(tmp_path / 'bag_2').difference is None


def test_a_start_that_fails_says_why():
    with pytest.raises(blf.DriveError, match='does not exist, did you mean panda'):
        blf.Drive('pando', robot='simulated')


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
        (STREAMS, FORKED, -9, ''),
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
    assert 'brake' in events
    assert events['release']['resting']
    run = blf.read_run(tmp_path / 'bag')
    # rad in 1 ms: it moved, also on a slow computer
    assert np.nanmax(np.abs(np.diff(run.reference, axis=0))) > 1e-6
    assert np.abs(run.velocity[-1]).max() < 0.02  # rad/s


# Of one arm, last: it moves in real time until the end of the file.


@pytest.fixture(scope='module')
def arm():
    with drive() as found:
        yield found


def test_a_motion_begins_at_a_time_of_the_wall_clock(arm):
    apart, start = 600.0, arm.state.reference
    arm.follow([(1.0, start + 0.01)], begin=time.time() + apart, wait=False)
    before = arm.state.time
    wait_for(lambda: arm.state.time > before + 1.5)
    np.testing.assert_array_equal(arm.state.reference, start)
    assert arm.is_moving
    arm.follow([(apart + 3.0, start + 0.01)], begin=time.time() - apart, timeout=60.0)
    np.testing.assert_allclose(arm.state.reference, start + 0.01, atol=1e-9)
    for given in ('soon', np.nan, 0.0, time.time_ns()):
        with pytest.raises(blf.DriveError, match=r'begin: .*a time of the wall clock'):
            arm.follow([(1.0, start)], begin=given)


def test_an_exception_beside_one_arm_brakes_the_others(arm):
    start = arm.state.reference
    arm.follow([(200.0, start + STEP)], wait=False)

    def fails():
        with drive():
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fails()
    with pytest.raises(blf.MotionFailedError):
        arm.wait(timeout=60.0)
    assert np.abs(arm.state.reference - start).max() < 0.5 * STEP.max()


def test_stream_without_ruckig_says_what_to_install(arm, monkeypatch):
    monkeypatch.setitem(sys.modules, 'ruckig', None)
    with pytest.raises(
        blf.MissingExtraError, match=r'needs ruckig.*pip install .*streams'
    ):
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


def test_a_motion_is_waited_for_stopped_and_given_up(arm):
    start = arm.state.q
    arm.move_to(start + STEP, speed=0.02, wait=False)
    assert arm.is_moving  # for ten seconds
    arm.stop()
    assert rests(arm)
    with pytest.raises(
        blf.MotionFailedError, match=r'pre-empted by stop\(\)|was stopped'
    ):
        arm.wait()
    arm.move_to(start + STEP, speed=0.02, wait=False)
    with pytest.raises(blf.NotInTimeError, match=r'after 0.1 s: the arm has braked'):
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
        except blf.DriveError as error:
            os._exit(42 if 'a fork of it: command the arm there' in str(error) else 1)
        os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 42
    arm.stop()
    assert arm.state.phase == 'tracking'
