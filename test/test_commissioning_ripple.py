# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc commission --ripple`: the slow motion, what it shows, and what is left if it ends."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from elastic_two_link import ARM, NEAR, shorten_motions, shorten_moves
from plant_driver import PlantDriver

import blf_dsc_controller as blf
from blf_dsc_controller import change
from blf_dsc_controller.bags.content import read_content
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.commissioning import (
    postures,
    proof,
    ripple,
    simulated,
    slow_motion,
)
from blf_dsc_controller.commissioning.planned import FROM_LIMITS
from blf_dsc_controller.commissioning.ripple import ripples_in, to_learn
from blf_dsc_controller.reference.approach import reference_of
from blf_dsc_controller.reference.terms import sampled
from blf_dsc_controller.run import TURNING

DRIVER = """
from math import inf
from plant_driver import PlantDriver
class DRIVER(PlantDriver):
    arm = {arm!r}
    facts = PlantDriver.facts._replace(joints=2, torque_limit=(inf,) * 2)
"""
MOVES = """
    reference: {type: sinusoids, offset: [0.3, 1.1], amplitude: [0.3, 0.1, 0.3, 0.1],
                frequency: [1.6, 2.6], phase: [1.5, 0.0]}
"""
RIPPLE = (
    '    actuator: {torque_limit: [60.0, 30.0], ripple: 0.004, ripple_cycles: 40.0}\n'
)
SLOW = 15.0  # s
FILES = ('out', 'rippled')
"""Of the gains, and of these with the ripple."""
BAGS = ('proof/slow_motion', 'out_bags/posture_1')


def shorten(monkeypatch):
    """Let everything take less time than a robot is given: 34 s in place of 3 minutes."""
    shorten_motions(monkeypatch)
    shorten_moves(monkeypatch)
    monkeypatch.setattr(proof, '_SHORT', 0.5)
    monkeypatch.setattr(proof, '_LAST', 0.5)
    monkeypatch.setattr(postures, 'HOLD', 1.0)
    monkeypatch.setattr(postures, '_REST', 0.2)
    for module in (slow_motion, ripple):
        monkeypatch.setattr(module, 'SECONDS', SLOW)


def written(folder):
    """Write the file of a rigid arm with ripple, with a driver on it; return its path."""
    path, driver = folder / 'arm.yaml', folder / 'arm_driver.py'
    driver.write_text(DRIVER.format(arm=str(path)))
    text = ARM.replace('    joint.stiffness: [3.0e+3, 1.5e+3]\n', RIPPLE)
    drive = f'/**/drive:\n  ros__parameters: {{driver: {driver}, settle_time: 0.5}}\n'
    path.write_text(text.rstrip() + MOVES + drive)
    return path


def commission(arm, *options, out='out.yaml'):
    """Run the command; return its exit code."""
    words = ['commission', '--config', str(arm), '--out', str(arm.with_name(out))]
    return main([*words, *options])


def at(posture):
    return ['--posture', *map(str, posture)]


@pytest.fixture(scope='module')
def whole(tmp_path_factory):
    """Commission a robot with ripple, and prove its gains; return its file and what was said."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.syspath_prepend(Path(__file__).parent)
        shorten(monkeypatch)
        arm = written(tmp_path_factory.mktemp('ripple'))
        told = []
        monkeypatch.setattr(
            'builtins.print', lambda *words, **_: told.append(' '.join(map(str, words)))
        )
        assert commission(arm, '--robot', 'plant', '--yes', *at(NEAR)) == 0
        told.clear()
        assert prove(arm, 'plant', 'proof') == 0
        calls = PlantDriver.last.calls
    return SimpleNamespace(arm=arm, told='\n'.join(told), calls=calls)


def prove(arm, robot, folder):
    """Prove the gains that were chosen, and look for ripple; return the exit code."""
    gains = arm.with_name('out.yaml')
    record = ('--record', str(arm.with_name(folder)))
    options = ('--prove', '--ripple', '--robot', robot, '--yes', *record)
    return commission(gains, *options, out='rippled.yaml')


@pytest.fixture
def arm(tmp_path, monkeypatch):
    """Return the file of an arm that was not commissioned."""
    monkeypatch.syspath_prepend(Path(__file__).parent)
    shorten(monkeypatch)
    return written(tmp_path)


pytestmark = pytest.mark.usefixtures('blank_pictures')


def test_gains_are_proven_and_the_ripple_added_to_their_file(whole):
    """Once somebody has looked at them; the rest of the file stays."""
    parts = (
        *('slow motion, for 16 s: joint1 -0.', '100% of the gains: calm'),
        *('error  expected', 'slow motion, for', 'is written as learning.ripple'),
    )
    at_part = 0
    for part in parts:
        at_part = whole.told.index(part, at_part)
    assert whole.calls == ['connect', *['start', 'finish'] * 8]
    gains, rippled = (whole.arm.with_name(f'{name}.yaml') for name in FILES)
    before, after = (blf.load_loop(each).controller for each in (gains, rippled))
    (cycles,) = after.learning.ripple_cycles
    assert cycles == pytest.approx(40.0, abs=0.5)
    assert change(before, {'learning.ripple_cycles': [cycles]}) == after
    # the table and how sure it is, in the console and in the file
    comment = rippled.read_text().partition('/**:')[0]
    assert comment.startswith(gains.read_text().partition('/**:')[0])
    for text in (whole.told.replace('\n', ' '), comment.replace('\n# ', ' ')):
        assert re.search(r'joint2 +0\.1\d+ \+- 0\.0\d+ N m at (39\.|40)', text)
        assert f'is written as learning.ripple_cycles: [{cycles:g}], by' in text
        assert 'the motion of 2 of 2 joints (joint1, joint2)' in text


def test_bags_give_the_same_and_replay(whole, monkeypatch):
    shorten(monkeypatch)
    bags = [whole.arm.parent / name for name in BAGS]
    assert commission(whole.arm, *map(str, bags), out='again.yaml') == 0
    proven, again = (
        blf.load_loop(whole.arm.with_name(f'{name}.yaml')).controller
        for name in ('rippled', 'again')
    )
    assert again == proven
    assert blf.verify(bags[0]).difference is None
    # it is the motion of a loop of one's own
    found = blf.Commissioning(whole.arm).result([bags[1]])
    assert read_content(bags[0]).controller_config() == found.slow_motion.config


def test_ctrl_c_in_the_slow_motion_keeps_the_gains(whole, capsys, monkeypatch):
    """State 9000 is in it; the arm comes to rest."""
    shorten(monkeypatch)
    monkeypatch.setattr(proof, 'SHARES', (1.0,))
    monkeypatch.syspath_prepend(whole.arm.parent)
    gains, rippled = (whole.arm.with_name(f'{name}.yaml') for name in FILES)
    rippled.rename(whole.arm.with_name('kept.yaml'))
    assert prove(whole.arm, 'interrupt@9000', 'ended') == 130
    assert not rippled.exists()
    whole.arm.with_name('kept.yaml').rename(rippled)
    told = capsys.readouterr().err
    assert 'slow motion: ended on request. The gains are proven; bags are' in told
    assert f'Torque ripple was not measured; {gains} has all else' in told
    assert PlantDriver.last.calls[-1] == 'finish'
    assert PlantDriver.last.velocity < 0.01  # rad/s


@pytest.mark.parametrize(
    ('given', 'told'),
    [
        (['--write', 'm.yaml'], 'and --write measures nothing: leave out'),
        (['--robot', 'plant', '--prove'], 'feedback.joint_stiffness is empty: prove'),
        (['--robot', 'plant'], 'then give --prove --ripple with the file that is'),
        (['bag'], '--ripple makes a motion, and its bag needs no option'),
    ],
)
def test_ripple_that_cannot_be_found_so_is_refused(given, told, arm, capsys):
    assert commission(arm, '--ripple', *given) == 1
    assert told in capsys.readouterr().err


@pytest.mark.parametrize('robot', [[], ['--robot', 'plant', '--yes', '--prove']])
def test_reference_without_tones_is_refused_before_anything_moves(robot, arm, capsys):
    arm.write_text(arm.read_text().replace('{type: sinusoids', '{type: hold'))
    PlantDriver.last = None
    assert commission(arm, '--ripple', *robot, *at(NEAR)) == 1
    assert 'reference.type: got hold, but torque ripple' in capsys.readouterr().err
    assert PlantDriver.last is None
    assert not arm.with_name('out.yaml').exists()


@cache
def ur5e(*, has_ripple):
    """Return what the slow motion shows of a simulated UR5e with its chosen gains."""
    loop = blf.load_loop('ur5e_commissioned')
    controller = change(loop.controller, {'learning.ripple_cycles': []})
    if not has_ripple:  # half a minute shows as well that there is none
        with pytest.MonkeyPatch.context() as monkeypatch:
            for module in (slow_motion, ripple):
                monkeypatch.setattr(module, 'SECONDS', 30.0)
            return shown_by(controller, change(loop.plant, {'actuator.ripple': 0.0}))
    return shown_by(controller, loop.plant)


def shown_by(controller, plant):
    motion = slow_motion.slow_motion(controller)
    return ripples_in([simulated.slow_run(motion, plant)])


@pytest.mark.nightly
def test_ripple_of_a_ur5e_is_found_in_all_joints_and_none_where_there_is_none():
    """Of 30 periods, and 0.8 % of 150 and 28 N m."""
    found = ur5e(has_ripple=True)
    (listed,) = to_learn(found)
    assert listed.cycles == pytest.approx(30.0, abs=0.3)
    assert abs(listed.cycles - 30.0) < 4.0 * listed.deviation + 0.05
    assert sorted(listed.joints) == [0, 1, 2, 3, 4, 5]
    assert not any(each.repeats for each in found)
    amplitudes = [each.found[0].amplitude for each in found]
    np.testing.assert_allclose(amplitudes, [1.2] * 3 + [0.224] * 3, rtol=0.2)
    assert to_learn(none := ur5e(has_ripple=False)) == ()
    assert all(each.is_known and not each.repeats for each in none)


def range_of(config, seconds=60.0):
    q = sampled(reference_of(config), np.arange(0.0, seconds, 0.01))[:, 0]
    return q.min(axis=0), q.max(axis=0)


@pytest.mark.parametrize('preset', ['ur5e', 'fr3'])
def test_joints_keep_away_from_near_limits_in_the_slow_motion(preset):
    """Tones without a period add up to more than those of the reference do."""
    config = blf.load_loop(preset).controller
    free = slow_motion.slow_motion(config)
    np.testing.assert_allclose(free.ranges, range_of(free.config), atol=2e-3)
    lower, upper = range_of(config)
    beyond = np.maximum(lower - free.ranges[0], free.ranges[1] - upper)
    assert beyond.max() > 0.1  # rad
    near = change(
        config,
        {
            'limits.position_lower': (lower - 0.01).tolist(),
            'limits.position_upper': (upper + 0.06).tolist(),
        },
    )
    kept = slow_motion.slow_motion(near)
    assert (kept.ranges[0] > lower - 1e-3).all()
    assert (kept.ranges[1] < upper + 0.06 - FROM_LIMITS[TURNING] + 1e-3).all()
    assert kept.config.reference.frequency == free.config.reference.frequency
    assert slow_motion.is_slow_motion(kept.config, near)
    assert not slow_motion.is_slow_motion(free.config, near)
    assert not slow_motion.is_slow_motion(config, config)
