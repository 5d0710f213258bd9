# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc commission --robot` through the loop of `drive`, on an elastic arm in lock-step."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import numpy as np
import pytest
from elastic_two_link import ARM, FAR, NEAR, shorten_motions, shorten_moves
from plant_driver import PlantDriver
from recorded_run import small_disk

import blf_dsc_controller as blf
from blf_dsc_controller import change
from blf_dsc_controller.arms.urdf import frames
from blf_dsc_controller.bags.content import read_content
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.commissioning import proof
from blf_dsc_controller.factory.gains import law_gains

pytestmark = pytest.mark.usefixtures('blank_pictures')
DRIVER = """
from math import inf
from plant_driver import PlantDriver
class DRIVER(PlantDriver):
    arm = {arm!r}
    facts = PlantDriver.facts._replace(joints={joints}, torque_limit=(inf,) * {joints})
"""


@pytest.fixture
def whole(tmp_path, monkeypatch):
    """Write the arm's parameter file, with a driver on this arm, and return its path."""
    monkeypatch.syspath_prepend(Path(__file__).parent)
    return written(tmp_path, joints=2)


@pytest.fixture
def arm(whole, monkeypatch):
    """Return that of an arm which is measured in less time."""
    shorten_motions(monkeypatch)
    shorten_moves(monkeypatch)
    return whole


def damping_of(config):
    """Return the damping (n,) [N m s/rad] of the law."""
    return np.array(law_gains(config).feedback)


def written(folder, joints):
    path, driver = folder / 'arm.yaml', folder / 'arm_driver.py'
    driver.write_text(DRIVER.format(arm=str(path), joints=joints))
    section = f'/**/drive:\n  ros__parameters:\n    driver: {driver}\n'
    path.write_text(ARM + section)
    return path


def commission(arm, address, *options, postures=(NEAR,)):
    """Run the command; return its exit code."""
    words = ['commission', '--config', str(arm), '--robot', address]
    for posture in postures:
        words += ['--posture', *map(str, posture)]
    return main([*words, '--out', str(arm.with_name('out.yaml')), *options])


def nothing_looks_whole(arm):
    return not (arm.with_name('out.yaml').exists() or arm.with_name('out.png').exists())


def gains_of(path):
    config = blf.load_loop(path).controller
    feedback = config.feedback
    assert len(config.commissioning.friction) == len(config.joints)
    return np.array([feedback.joint_stiffness, feedback.joint_damping])


def travel(bag):
    """Return how far the tool goes from where it began [m].

    Its reference travels 10 mm at most; the arm is softly held and exceeds it little.
    """
    run = blf.read_run(bag)
    chain = read_content(bag).controller_config().robot.chain(run.joints)
    tips = frames(chain, run.position)[-1][:, :3, 3]
    return np.linalg.norm(tips - tips[0], axis=1).max()


def test_robot_is_measured_posture_by_posture_and_its_bags_give_the_same(whole, capsys):
    """In the time that a real one is given, in which the arm stays where it is."""
    arm = whole
    assert commission(arm, 'plant', '--yes', postures=(NEAR, FAR)) == 0
    told = capsys.readouterr().out
    before, _, after = told.partition('0 of 2 postures measured')
    assert 'the tool travels 10 mm' in before
    assert 'torque.limit is 60, 30 N m' in before
    assert '2 of 2 postures measured' in after
    assert 'the gains are limited near' in after
    assert PlantDriver.last.calls == ['connect', *['start', 'finish'] * 4]
    bags = sorted(arm.with_name('out_bags').glob('posture_*'))
    assert len(bags) == 2
    for bag, posture in zip(bags, (NEAR, FAR), strict=True):
        run = blf.read_run(bag)
        # it began at rest where the move ended: no error, and no jump of the torque
        assert np.abs(run.error[0]).max() < 1e-6
        assert np.abs(run.torque[0]).max() < 0.01  # N m, of 60
        assert travel(bag) < 0.015
        np.testing.assert_allclose(run.position[0], posture, atol=0.01)
    assert blf.verify(bags[0]).difference is None
    again = arm.with_name('again.yaml')
    words = ['commission', *map(str, bags), '--config', str(arm), '--out', str(again)]
    assert main(words) == 0
    np.testing.assert_array_equal(gains_of(again), gains_of(arm.with_name('out.yaml')))


@pytest.mark.parametrize(
    ('address', 'code', 'printed'),
    [
        ('interrupt@300', 130, 'move 1: ended on request. No gains were chosen'),
        ('interrupt@6000', 130, 'posture 1: ended on request. No gains were chosen'),
        ('late@6000', 5, 'posture 1: the controller stopped: the stamp of a joint'),
        ('reflex@6000', 5, 'posture 1: the robot stopped by itself: joint_reflex; it'),
        ('silent@300', 5, 'move 1: the connection was lost: no state for 1 s'),
        ('absent', 1, 'there is no robot: switch it on'),
    ],
)
def test_end_before_its_time_is_calm_and_writes_nothing_that_looks_whole(
    address, code, printed, arm, capsys
):
    """The move takes 2.5 s: state 6000 is in the motion, before its period is over."""
    assert commission(arm, address, '--yes') == code
    assert printed in capsys.readouterr().err
    assert nothing_looks_whole(arm)
    if code == 130:
        assert PlantDriver.last.calls[-1] == 'finish'
        assert PlantDriver.last.velocity < 0.01  # rad/s, at rest
    cut = arm.with_name('out_bags') / 'posture_1'
    if cut.exists():  # it is not taken for a whole one
        assert main(['commission', str(cut), '--config', str(arm)]) == 1


def test_lost_states_are_told_after_the_first_posture(arm, capsys):
    """Every 20th, which no check of the controller minds."""
    assert commission(arm, 'lossy@1', '--yes', postures=(NEAR, FAR)) == 1
    assert 'posture 1: ' in (told := capsys.readouterr().err)
    assert 'joint states are missing' in told
    assert PlantDriver.last.calls == ['connect', *['start', 'finish'] * 2]
    assert nothing_looks_whole(arm)


def test_full_disk_is_told_once(tmp_path, arm, capsys, caplog):
    """The move alone writes several megabytes."""
    with small_disk(tmp_path / 'disk', 1) as disk:
        assert commission(arm, 'plant', '--yes', '--record', str(disk / 'bags')) == 1
    (logged,) = caplog.messages
    assert 'move_1 cannot be written any further: No space left' in logged
    told = capsys.readouterr().err
    assert 'cannot be written' not in told.replace(logged, '')
    assert 'move 1: its bag is not whole' in told
    assert 'No gains were chosen or written; whole bags of 0 postures' in told
    assert nothing_looks_whole(arm)


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_nothing_moves_unless_somebody_agrees(arm, capsys, monkeypatch):
    monkeypatch.setattr(sys, 'stdin', io.StringIO('yes\n'))
    PlantDriver.last = None
    assert commission(arm, 'plant') == 1
    assert 'start it in a terminal, or give --yes' in capsys.readouterr().err
    assert PlantDriver.last is None
    monkeypatch.setattr(sys, 'stdin', Terminal('no\n'))
    assert commission(arm, 'plant') == 1
    printed = capsys.readouterr()
    assert 'the arm moves for' in printed.out
    assert 'nothing has moved' in printed.err
    assert PlantDriver.last.calls == ['connect']
    monkeypatch.setattr(sys, 'stdin', Terminal('yes\n'))
    assert commission(arm, 'interrupt@300') == 130


@pytest.mark.parametrize(
    ('options', 'postures', 'printed'),
    [
        (['--write', 'm.yaml'], (NEAR,), '--write measures nothing'),
        ([], ((0.3, 2.99),), 'joint2 would be at 2.99 rad, less than 0.05 rad from'),
        ([], ((0.3, 90.0),), 'rad; if this is in degrees, give 1.571'),
        ([], ((0.3, 4.0),), 'joint2 would be at 4 rad, beyond its limits'),
        ([], (NEAR, (0.3, 1.1, 0.0)), 'got 3 angles, but the arm has 2 joints'),
    ],
)
def test_what_cannot_be_measured_is_refused_before_anything_moves(
    options, postures, printed, arm, capsys
):
    PlantDriver.last = None
    assert commission(arm, 'plant', '--yes', *options, postures=postures) == 1
    assert printed in capsys.readouterr().err
    assert PlantDriver.last is None or PlantDriver.last.calls == ['connect']
    assert nothing_looks_whole(arm)


def test_arm_that_comes_to_rest_too_near_its_limits_is_told_with_its_posture(
    arm, capsys
):
    """Softly held, it ends 12 mrad beyond a posture that is as near to them as it may be."""
    assert commission(arm, 'plant', '--yes', postures=((0.3, 2.9499),)) == 1
    told = capsys.readouterr().err
    assert 'posture 1: posture: joint2 would be at 2.96' in told
    assert 'less than 0.05 rad from its limits' in told
    assert PlantDriver.last.calls[-1] == 'finish'


def test_another_robot_is_refused(arm, capsys):
    written(arm.parent, joints=7)
    assert commission(arm, 'plant', '--yes') == 1
    assert 'joints: got 2, but the robot has 7' in capsys.readouterr().err


@pytest.mark.parametrize('robot', [[], ['--robot', 'plant', '--yes']])
def test_bag_of_another_arm_is_refused_before_anything_moves(robot, arm, capsys):
    bag = arm.with_name('other')
    with blf.ArmController('panda_rigid', record=bag) as controller:
        for k in range(3):
            controller.update(1e-3 * k, [0.0] * 7, [0.0] * 7)
    theirs = ', '.join(controller.config.joints)
    PlantDriver.last = None
    out = arm.with_name('out.yaml')
    words = ['commission', str(bag), '--config', str(arm), '--out', str(out), *robot]
    assert main(words) == 1
    found = capsys.readouterr()
    told = f'{bag} is of the joints {theirs}, the configuration of joint1, joint2: '
    assert told in found.err
    assert 'choosing' not in found.err + found.out
    assert PlantDriver.last is None
    assert nothing_looks_whole(arm)


PUSHED = """
    pushed = 0.0
    def positions(self):
        self.pushed += 0.01
        return super().positions() + np.array([0.0, self.pushed])
"""


def test_arm_that_moves_is_not_measured(arm, capsys):
    driver = arm.with_name('arm_driver.py')
    driver.write_text(f'import numpy as np\n{driver.read_text()}{PUSHED}')
    assert commission(arm, 'plant', '--yes') == 1
    assert 'joint2 moves by +0.01 rad in 0.2 s' in capsys.readouterr().err
    assert PlantDriver.last.calls == ['connect']


def test_softly_held_arm_that_sticks_slides_and_ends_where_it_began(arm):
    """Its soft damping would let it drift on, if the run ended in the middle of a swing."""
    friction = '{coulomb: [1.0, 0.5], stribeck: 0.5, '
    arm.write_text(
        arm.read_text().replace('disturbance: {', f'disturbance: {friction}')
    )
    assert commission(arm, 'plant', '--yes') == 0
    folder = arm.with_name('out_bags')
    assert {bag.name for bag in folder.iterdir()} == {
        *('move_1', 'weak_posture_1', 'again_weak_posture_1', 'posture_1')
    }
    run = blf.read_run(folder / 'posture_1')
    assert travel(folder / 'posture_1') < 0.015  # as without friction
    assert np.abs(run.velocity[-1]).max() < 0.01  # rad/s, at rest


def test_arm_of_which_little_is_known_is_measured_anew_and_its_bag_gives_the_same(
    arm, capsys
):
    """Its motors are ten times as heavy as in its file, which has no friction."""
    text = arm.read_text()
    text = text.replace(
        'rotor_inertia: [0.3, 0.1], pay', 'rotor_inertia: [0.02, 0.01], pay'
    )
    text = text.replace('disturbance: {', 'disturbance: {coulomb: [0.05, 0.03], ')
    text = text.replace('bound: [0.2, 0.2]', 'bound: [0.9, 0.9]')
    arm.write_text(text)
    assert commission(arm, 'plant', '--yes', postures=(NEAR, FAR)) == 0
    told = capsys.readouterr().out
    assert 'posture 1 is measured anew, up to 2 times' in told
    assert 'N m is written as robot.coulomb' in told
    folder = arm.with_name('out_bags')
    names = {bag.name for bag in folder.iterdir()}
    assert {'soft_posture_1', 'posture_1', 'posture_2'} <= names
    soft, first, second = (
        read_content(folder / name).controller_config()
        for name in ('soft_posture_1', 'posture_1', 'posture_2')
    )
    assert soft.robot.coulomb == ()
    assert first.robot.coulomb == second.robot.coulomb != ()
    assert (damping_of(first) >= damping_of(soft)).all()
    out, again = arm.with_name('out.yaml'), arm.with_name('again.yaml')
    bags = [str(folder / name) for name in ('posture_1', 'posture_2')]
    assert main(['commission', *bags, '--config', str(arm), '--out', str(again)]) == 0
    measured, recomputed = (blf.load_loop(each).controller for each in (out, again))
    assert recomputed == measured
    assert measured.robot.coulomb != ()


PROVEN = """
    feedback:
      joint_stiffness: [K1, K2]
      joint_damping: [D1, D2]
      joint_damping_lag: [0.003, 0.0]
    reference: {type: sinusoids, offset: [0.3, 1.1], amplitude: [0.1, 0.1], frequency: [2.0],
                phase: [0.0]}
"""
# N m/rad and N m s/rad: about what commissioning chooses for this arm
CHOSEN = {'K1': '25.0', 'K2': '8.5', 'D1': '6.0', 'D2': '1.5'}


def prove(arm, address, gains, *options):
    text = PROVEN
    for name, value in gains.items():
        text = text.replace(name, value)
    own = '/**/blf_dsc_controller:\n  ros__parameters:\n'
    arm.write_text(arm.read_text().replace(own, own + text.strip('\n') + '\n'))
    words = ['commission', '--prove', '--config', str(arm), '--robot', address]
    return main([*words, '--yes', '--record', str(arm.with_name('proof')), *options])


def test_gains_are_proven_in_three_steps_and_errors_compared(arm, capsys, monkeypatch):
    """Each takes less time than a robot is given; the reference repeats itself after 3.2 s."""
    monkeypatch.setattr(proof, '_SHORT', 1.0)
    monkeypatch.setattr(proof, '_LAST', 4.0)
    assert prove(arm, 'plant', CHOSEN) == 0
    told = capsys.readouterr().out
    said = [
        '50% of the gains: calm',
        '75% of the gains: calm',
        '100% of the gains: calm',
    ]
    assert [told.find(each) > 0 for each in said] == [True] * 3
    assert PlantDriver.last.calls == ['connect', *['start', 'finish'] * 6]
    folder = arm.with_name('proof')
    written = blf.load_loop(arm).controller
    for share in (50, 75, 100):
        proven = read_content(folder / f'{share}_of_the_gains').controller_config()
        assert proven.feedback.joint_damping_lag == (0.003, 0.0)
        expected = 0.01 * share * damping_of(written)
        np.testing.assert_allclose(damping_of(proven), expected, rtol=1e-9)
    calm = {'safety.oscillation': 'stop'}
    assert proven == change(written, calm)  # all of what was written, but for the check
    # the table: the largest error of each joint, as its bag has it, beside one to expect
    run = blf.read_run(folder / '100_of_the_gains')
    for name, error in zip(
        run.joints, np.nanmax(np.abs(run.error), axis=0), strict=True
    ):
        (row,) = [line.split() for line in told.splitlines() if line.startswith(name)]
        assert float(row[1]) == pytest.approx(1e3 * error, rel=0.05)  # two digits
        assert float(row[2]) > 0.0


@pytest.mark.parametrize(
    ('address', 'factor', 'code', 'printed'),
    [
        ('plant', '5', 5, ['way with 50% of the gains: the controller', 'oscillates']),
        (
            'interrupt@300',
            '',
            130,
            ['way with 50% of the gains: ended on request', 'no share of the gains'],
        ),
    ],
)
def test_gains_that_are_not_proven_are_told(
    address, factor, code, printed, arm, capsys
):
    """With tens of times the stiffness and damping of the arm; or ended by somebody."""
    gains = {name: factor + value for name, value in CHOSEN.items()}
    assert prove(arm, address, gains) == code
    told = capsys.readouterr().err
    for each in (*printed, 'The gains are not proven'):
        assert each in told
