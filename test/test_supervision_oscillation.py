# SPDX-License-Identifier: Apache-2.0
"""An arm that oscillates is named and stopped calmly; a healthy one is left alone."""

from __future__ import annotations

import re

import numpy as np
import pytest
import yaml
from nights import at_night
from scenario import Scenario

import blf_dsc_controller as blf
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.cli.run import STOPPED
from blf_dsc_controller.factory.controller import controller_of
from blf_dsc_controller.law.torque import RATE_CUT
from blf_dsc_controller.simulation.loop import write_bag
from blf_dsc_controller.supervision.stop_cause import saturation_of

LAW, PLANT = 'blf_dsc_controller', 'sim_plant'
NO_LOOP = {'actuator.loop_gain': 0.0, 'actuator.loop_damping': 0.0}
MOTOR = {'sensor.side': 'motor'}
BEFORE = 0.1  # s


def loop_of(preset, stiffness=1e4, gain=4.0, law=None, **plant):
    """Return the loop of a preset with gears of a stiffness [N m/rad], and times its gains."""
    n = len(blf.load_loop(preset).controller.joints)
    given = {'feedback.stiffness': gain, 'barrier.bound': [0.05] * n, **(law or {})}
    changes = {'joint.stiffness': [stiffness] * n, **plant}
    return blf.load_loop(preset, {PLANT: changes, LAW: given})


def shaken(loop):
    """Run a loop until 1.2 s after its stop.

    Return the arm, the number of samples until its stop, and the largest speed (k,) [rad/s] of
    links and motors after each.
    """
    arm = Scenario(loop)
    speeds = []

    def look():
        both = arm.plant.truth()[-arm.n :], arm.plant.motors[1]
        speeds.append(np.abs(both).max())
        return not arm.is_running

    stop = len(arm.run(3.0, until=look).t)
    assert not arm.is_running
    arm.run(1.2, until=lambda: look() and False)
    return arm, stop, np.array(speeds)


EVENTS = {
    'events.begin': [2.0, 5.0],  # s
    'events.duration': [2.5, 0.1],
    'events.force': [0.0, 0.0, 0.0, 30.0, 15.0, -20.0],  # N, of the push
}
FROM_URDF = ['panda', 'ur5e_driver', 'openarm']
FROM_URDF += at_night('ur5e', 'fr3', 'fr3_direct', 'widowx')


@pytest.mark.parametrize('preset', FROM_URDF)
def test_healthy_arm_that_lifts_its_payload_and_is_pushed_is_left_alone(preset):
    """Bounds of 0.2 rad, which neither lets it leave; light arms are pushed less."""
    controller = blf.load_loop(preset).controller
    payload = controller.robot.payload
    push = min(1.0, payload / 3.0) * np.array(EVENTS['events.force'])
    events = EVENTS | {'events.payload': [payload, 0.0], 'events.force': push.tolist()}
    law = {'barrier.bound': [0.2] * len(controller.joints)}
    loop = blf.load_loop(preset, {PLANT: {'duration': 6.0, **events}, LAW: law})
    assert blf.simulate(loop.controller, loop.plant).run().stops == ()


SHAKING = {
    'Panda, sensors at the link': ('panda', 1e4, 4.0, NO_LOOP),
    'Panda, sensors at the motor': ('panda', 1e4, 4.0, NO_LOOP | MOTOR),
    'Panda, soft gears': ('panda', 5e3, 4.0, {}),
    'UR5e': ('ur5e', 1e4, 2.0, {}),
    'UR5e at 500 Hz': ('ur5e_driver', 1e4, 2.0, {}),
    'FR3': ('fr3', 5e3, 2.5, {}),
}


@pytest.mark.parametrize('arm', SHAKING)
def test_arm_that_shakes_stops_calmly_and_says_what_it_did(arm):
    """Springs give back what they hold, and light links get it: 1.7 times at most.

    Without a calm stop, motors reach 5 to 20 rad/s and go on for seconds.
    """
    preset, stiffness, gain, plant = SHAKING[arm]
    meant = {'insist': ['feedback.stiffness']}
    arm, stop, speeds = shaken(loop_of(preset, stiffness, gain, meant, **plant))
    assert arm.reason in ('oscillation', 'error past the bound')
    assert arm.text.startswith("joint '")
    said = arm.text.partition(' Hz with')[0]
    assert ' oscillates at ' in said
    assert 'commission it (`blf_dsc commission`), or give ' in arm.text
    advised = re.search(r'give a feedback\.stiffness of (\S+) ', arm.text)
    assert 0.0 < float(advised[1]) <= 0.5 * gain
    before = speeds[max(0, stop - round(BEFORE / arm.T)) : stop].max()
    assert speeds[stop:].max() < 1.7 * before + 0.02
    assert speeds[stop + round(1.0 / arm.T) :].max() < 0.15


SOFT = {
    'ur5e': ([1e4] * 3 + [6.7e3] * 3, 1.0),
    'panda': ([5e3] * 7, 4.0),
}


def soft_arm(preset, folder):
    """Return the sections of an arm with soft gears, and a run of them for some time [s].

    It picks up 2 kg at 4 s and puts them down at 7 s.
    """
    stiffness, gain = SOFT[preset]
    path = blf.share_folder() / 'config' / f'{preset}.yaml'
    sections = yaml.safe_load(path.read_text())
    sections['/**']['ros__parameters']['robot']['urdf'] = str(path.with_suffix('.urdf'))
    arm = sections['/**/sim_plant']['ros__parameters']
    arm['joint'] = {'stiffness': stiffness}
    arm['events'] = {'begin': [4.0], 'duration': [3.0], 'payload': [2.0]}
    law = sections['/**/blf_dsc_controller']['ros__parameters']
    law['feedback']['stiffness'] = gain
    law['insist'] = ['feedback.stiffness']

    def run(seconds):
        (folder / 'my.yaml').write_text(yaml.safe_dump(sections))
        place = ['--config', f'{folder / "my.yaml"}', '--out', f'{folder / seconds}']
        return main(['run', '--offline', '--duration', seconds, *place])

    return sections, run


def block_in(told):
    """Return the block to paste in what a command has told."""
    (block,) = re.findall(r'^/\*\*/blf_dsc_controller:\n(?: .*\n)+', told, re.MULTILINE)
    return yaml.safe_load(block).popitem()[1]['ros__parameters']


@pytest.mark.usefixtures('blank_pictures')
@pytest.mark.parametrize('preset', SOFT)
def test_block_that_is_printed_after_a_stop_holds_a_pick_up(preset, tmp_path, capsys):
    """It is pasted in place of what the file has; `report` prints the same one."""
    sections, run = soft_arm(preset, tmp_path)
    assert run('3') == STOPPED
    block = block_in(capsys.readouterr().out)
    drawn = ['--png', f'{tmp_path / "drawn"}']
    main(['report', f'{tmp_path / "3" / "bag"}', *drawn])
    assert block_in(capsys.readouterr().out) == block
    law = sections['/**/blf_dsc_controller']['ros__parameters']
    for name, value in block.items():
        group, _, parameter = name.partition('.')
        law[group][parameter] = value
    assert run('9') == 0
    assert 'held by every joint' in capsys.readouterr().out


@pytest.mark.usefixtures('blank_pictures')
def test_arm_whose_softer_gains_bear_no_payload_is_said_to_need_commissioning(
    tmp_path, capsys
):
    """140 kg: bounds would be wider than a quarter turn."""
    sections, run = soft_arm('ur5e', tmp_path)
    sections['/**']['ros__parameters']['robot']['payload'] = 140.0
    run('3')
    told = capsys.readouterr().out
    assert 'no bounds were found for a feedback.stiffness of 0.' in told
    assert 'with a robot.payload of 140 kg: commission the arm' in told
    assert '/**/blf_dsc_controller' not in told


def test_oscillation_that_is_warned_of_stops_the_arm_once_it_is_violent(tmp_path):
    """Joint 6 begins; another then has a fifth of its torque limit."""
    warn = {'safety.oscillation': 'warn'}
    loop = loop_of('panda', gain=2.0, law=warn, duration=1.0)
    record = blf.simulate(loop.controller, loop.plant)
    run = record.run()
    (found,), (stop,) = run.oscillations, run.stops
    assert found.text == (
        f"joint '{found.joint}' oscillates at {found.frequency:.2g} Hz with "
        f'+-{found.torque:.2g} N m'
    )
    # zero crossings of the torque less its mean in the 60 ms before, two a period
    i, k = run.joints.index(found.joint), round(found.stamp * 1e-6)
    torque = run.torque[k - 60 : k, i] - run.torque[k - 60 : k, i].mean()
    crossings = np.flatnonzero(np.diff(np.sign(torque)))
    frequency = 0.5 / (1e-3 * np.diff(crossings).mean())
    assert found.frequency == pytest.approx(frequency, rel=0.1)
    assert stop.reason == 'oscillation'
    assert stop.stamp > found.stamp
    joint, amplitude = stop.text.split("'")[1], stop.text.split('+-')[1].split()[0]
    i = run.joints.index(joint)
    part = float(amplitude) / loop.controller.torque.limit[i]
    assert 0.19 < part < 0.4
    write_bag(tmp_path / 'bag', record)
    result = blf.verify(tmp_path / 'bag')
    assert (result.difference, result.remarks) == (None, ())
    recorded = blf.read_run(tmp_path / 'bag')
    assert recorded.timed_oscillations[0][0] == run.timed_oscillations[0][0]
    assert recorded.oscillations[0]._replace(stamp=found.stamp) == found


def test_arm_that_stops_in_want_of_torque_is_said_to_be_at_its_limit():
    """9 N m, where gravity alone takes 9.7: it leaves 2 mrad in 0.02 s, ten times that later."""
    law = {'torque.limit': [9.0, 3.2], 'barrier.bound': [0.02, 0.02]}
    loop = blf.load_loop('recommended', {PLANT: {'duration': 1.0}, LAW: law})
    (stop,) = blf.simulate(loop.controller, loop.plant).run().stops
    said = "joint 'joint1' has demanded more than its torque limit of 9 N m for 0."
    assert stop.reason == 'error past the bound'
    assert stop.text.startswith(said)
    assert 'follow a slower reference' in stop.text


def test_rate_limit_that_delays_the_torque_is_named():
    config = blf.load_loop('recommended').controller
    law = controller_of(config)
    assert saturation_of(law, config, 1, 0.0) == ''
    law.signals.saturation.cuts[:] = 0.0, RATE_CUT
    text = saturation_of(law, config, 1, 0.1)
    assert text.startswith("joint 'joint2' has demanded more than its torque")
    assert 'torque.rate_limit delays what it gets' in text


def test_chatter_of_coarse_encoders_is_not_taken_for_brakes():
    """0.38 mrad, of Damiao's frames: a differenced velocity comes in steps of 0.38 rad/s."""
    coarse = {'sensor.velocity': 'differenced', 'duration': 3.0}
    loop = blf.load_loop('openarm', {PLANT: coarse})
    assert blf.simulate(loop.controller, loop.plant).run().stops == ()
