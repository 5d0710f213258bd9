# SPDX-License-Identifier: Apache-2.0
"""An arm that oscillates is named, softened and stopped calmly; a healthy one is left alone."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import pytest

from blf_dsc_controller.bags.reader import read_run
from blf_dsc_controller.configuration.nodes import CONTROLLER, PLANT, load_loop
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.factory.controller import controller_of
from blf_dsc_controller.law.torque import RATE_CUT
from blf_dsc_controller.replay.verify import verify
from blf_dsc_controller.run import FIRST_STAMP
from blf_dsc_controller.simulation.loop import simulate, write_bag
from blf_dsc_controller.supervision import calming
from blf_dsc_controller.supervision.calming import Calming
from blf_dsc_controller.supervision.guard import Guard
from blf_dsc_controller.supervision.stop_cause import StopCause
from blf_dsc_controller.supervision.supervisor import Phase
from sim_plant.plant import plant_of

STIFF = {'feedback.inertia': 'whole', 'feedback.joint_stiffness': None}
STIFF |= {'feedback.joint_damping': None}
NO_LOOP = {'actuator.loop_gain': 0.0, 'actuator.loop_damping': 0.0}
MOTOR = {'sensor.side': 'motor'}
BEFORE = 0.1  # s


def loop_of(preset, stiffness=None, reaction='soften', seconds=1.0, law=None, **plant):
    """Return the loop of a preset; with a stiffness [N m/rad], under gains for rigid gears."""
    n = len(load_loop(preset).controller.joints)
    changes = {'duration': seconds, **plant}
    given = {'safety.oscillation': reaction, **(law or {})}
    if stiffness is not None:
        changes |= {'joint.stiffness': [stiffness] * n}
        given |= STIFF | {'barrier.bound': [0.05] * n}
    return load_loop(preset, {PLANT: changes, CONTROLLER: given})


class Stopped(NamedTuple):
    """A run of an arm until 1.2 s after its stop."""

    guard: Guard
    stop: int  # sample
    period: float  # s
    speed: np.ndarray  # (k, 2, n) rad/s, of links and motors
    torque: np.ndarray  # (k, n) N m


def stopped(loop):
    """Run a loop until 1.2 s after its stop."""
    plant = plant_of(loop.plant)
    guard = Guard(loop.controller, lambda: 0, lambda: 0)
    guard.starting.activate()
    period = loop.plant.sample_time_ns
    n = len(loop.controller.joints)
    speed, torque, stop = [], [], -1
    while stop < 0 or (len(speed) - stop) * period < 1.2e9:
        at = FIRST_STAMP + len(speed) * period
        torque.append(guard.update(at, plant.measure()).copy())
        speed.append((plant.truth()[-n:].copy(), plant.motors[1].copy()))
        if stop < 0 and guard.supervisor.phase is Phase.SAFE_STOP:
            stop = len(speed) - 1
        assert stop >= 0 or len(speed) * period < 3e9
        plant.step(torque[-1])
    return Stopped(guard, stop, 1e-9 * period, np.array(speed), np.array(torque))


EVENTS = {
    'events.begin': [2.0, 5.0],  # s
    'events.duration': [2.5, 0.1],
    'events.force': [0.0, 0.0, 0.0, 30.0, 15.0, -20.0],  # N, of the push
}
FROM_URDF = ('panda', 'ur5e', 'ur5e_driver', 'fr3', 'fr3_direct', 'openarm', 'widowx')


@pytest.mark.parametrize('preset', [*FROM_URDF, 'panda_rigid', 'ur5e_rigid'])
def test_healthy_arm_that_lifts_its_payload_and_is_pushed_is_left_alone(preset):
    """Bounds of 0.2 rad, which neither lets it leave; light arms are pushed less."""
    payload = load_loop(preset).controller.robot.payload
    push = min(1.0, payload / 3.0) * np.array(EVENTS['events.force'])
    events = EVENTS | {'events.payload': [payload, 0.0], 'events.force': push.tolist()}
    n = len(load_loop(preset).controller.joints)
    law = {'barrier.bound': [0.2] * n}
    loop = loop_of(preset, seconds=6.0, law=law, **events)
    assert loop.controller.safety.oscillation == 'soften'
    record = simulate(loop.controller, loop.plant)
    assert record.run().stops == ()
    assert record.run().oscillations == ()


@pytest.mark.parametrize('preset', ['recommended', 'paper', 'noisy', 'two_tone'])
def test_healthy_two_links_are_not_warned_of(preset):
    loop = load_loop(preset, {PLANT: {'duration': 10.0}})
    assert loop.controller.safety.oscillation == 'warn'
    assert simulate(loop.controller, loop.plant).run().oscillations == ()


@lru_cache
def softened():
    """Return the record of a Panda whose gains are too high for its gears until softened."""
    loop = loop_of('panda', 3e4, seconds=2.0)
    return simulate(loop.controller, loop.plant)


def test_feedback_is_softened_until_the_arm_is_calm_and_names_joint_and_frequency():
    """Halved once. The rigid-gear gains have 38 N m at 31 Hz within 0.1 s; later it follows."""
    run = softened().run()
    (found,) = run.oscillations
    assert run.stops == ()
    assert found.joint == 'panda_joint2'
    assert found.share == 0.5
    assert found.text == (
        f"joint 'panda_joint2' oscillates at {found.frequency:.2g} Hz with "
        f'+-{found.torque:.2g} N m: its feedback is softened, to 0.5 of its rates'
    )
    k = round(1e-9 * found.stamp / 1e-3)
    # zero crossings of the torque less its mean in the 60 ms before, two a period
    torque = run.torque[k - 60 : k, 1] - run.torque[k - 60 : k, 1].mean()
    crossings = np.flatnonzero(np.diff(np.sign(torque)))
    frequency = 0.5 / (1e-3 * np.diff(crossings).mean())
    assert found.frequency == pytest.approx(frequency, rel=0.1)
    late = run.torque[1000:, 1]
    ripple = late - np.convolve(late, np.ones(33) / 33, 'same')
    # a sixtieth of the limit of 87 N m, with the noise of the drives
    assert np.abs(ripple[50:-50]).max() < 1.5
    assert np.abs(run.error[1000:]).max() < 0.02


def test_oscillation_above_100_hz_has_no_exponent():
    shaking = calming.Shaking('joint1', 194.0, 118.0, 'N m')
    assert shaking.text == "joint 'joint1' oscillates at 190 Hz with +-120 N m"


def test_run_with_softer_gains_replays_and_its_bag_has_the_oscillation(tmp_path):
    record = softened()
    write_bag(tmp_path / 'bag', record)
    result = verify(tmp_path / 'bag')
    assert (result.difference, result.remarks) == (None, ())
    recorded, run = read_run(tmp_path / 'bag'), record.run()
    assert recorded.timed_oscillations[0][0] == run.timed_oscillations[0][0]
    (found,), (told,) = recorded.oscillations, run.oscillations
    assert found._replace(stamp=told.stamp) == told


SHAKING = {
    'Panda, sensors at the link': ('panda', 3e4, NO_LOOP),
    'Panda, sensors at the motor': ('panda', 1e4, NO_LOOP | MOTOR),
    'Panda, soft gears': ('panda', 5e3, {}),
    'UR5e': ('ur5e', 1e4, {}),
    'UR5e at 500 Hz': ('ur5e_driver', 1e4, {}),
    'FR3': ('fr3', 5e3, {}),
}


@pytest.mark.parametrize(
    ('arm', 'reaction'),
    [*((arm, 'stop') for arm in SHAKING), ('Panda, sensors at the link', 'soften')],
)
def test_arm_that_shakes_stops_calmly_and_says_what_it_did(arm, reaction):
    """Springs give back what they hold, and light links get it: 1.7 times at most.

    Without a calm stop, motors reach 5 to 20 rad/s and go on for seconds.
    """
    preset, stiffness, plant = SHAKING[arm]
    run = stopped(loop_of(preset, stiffness, reaction, 3.0, **plant))
    supervisor = run.guard.supervisor
    assert supervisor.reason.value in ('oscillation', 'error past the bound')
    assert supervisor.text.startswith("joint '")
    said = supervisor.text.partition(' Hz with')[0]
    assert ' oscillates at ' in said
    assert 'give a feedback.stiffness of 0.' in supervisor.text
    largest = np.abs(run.speed).max(axis=(1, 2))
    first = max(0, run.stop - round(BEFORE / run.period))
    before = largest[first : run.stop + 1].max()
    assert largest[run.stop + 1 :].max() < 1.7 * before + 0.02
    assert largest[run.stop + round(1.0 / run.period) :].max() < 0.15


def test_stop_of_a_softened_arm_names_the_oscillation_before_it():
    """A push of 60 N takes the softened Panda past its bound, 0.8 s after it was calmed."""
    push = {
        'events.begin': [1.0],  # s
        'events.duration': [0.5],
        'events.force': [0.0, 0.0, -60.0],
    }
    law = {'barrier.bound': [0.01] * 7, 'safety.oscillation': 'soften'}
    loop = loop_of('panda', 3e4, seconds=1.5, **push)
    loop = loop._replace(controller=change(loop.controller, law))
    run = simulate(loop.controller, loop.plant, after_stop=0.0).run()
    found = run.oscillations[-1]
    (stop,) = run.stops
    assert stop.reason == 'error past the bound'
    assert stop.stamp > found.stamp + 0.5e9  # ns
    said = found.text.partition(':')[0].replace('oscillates', 'has oscillated')
    softened_to = f'the feedback has been softened to {found.share:g} of its rates'
    assert stop.text.startswith(f'{said}, so that {softened_to}: ')
    assert f'give a feedback.stiffness of {found.share:g}, and a wider' in stop.text
    assert 'past its bound of 0.01 rad' in stop.text


def test_arm_that_stops_in_want_of_torque_is_said_to_be_at_its_limit():
    """9 N m, where gravity alone takes 9.7: it leaves 2 mrad in 0.02 s, ten times that later."""
    law = {'torque.limit': [9.0, 3.2], 'barrier.bound': [0.02, 0.02]}
    loop = load_loop('recommended', {PLANT: {'duration': 1.0}, CONTROLLER: law})
    (stop,) = simulate(loop.controller, loop.plant).run().stops
    said = "joint 'joint1' has demanded more than its torque limit of 9 N m for 0."
    assert stop.reason == 'error past the bound'
    assert stop.text.startswith(said)
    assert 'follow a slower reference' in stop.text


def test_rate_limit_that_delays_the_torque_is_named():
    config = load_loop('recommended').controller
    law = controller_of(config)
    cause = StopCause(config, law, Calming(config, law))
    assert cause.text(0.0) == ''
    cause.take_limited(1)
    law.signals.saturation.cuts[:] = 0.0, RATE_CUT
    assert cause.text(0.1).startswith(
        "joint 'joint2' has demanded more than its torque"
    )
    assert 'torque.rate_limit delays what it gets' in cause.text(0.1)


def test_chatter_of_coarse_encoders_is_not_taken_for_brakes():
    """0.38 mrad, of Damiao's frames: a differenced velocity comes in steps of 0.38 rad/s."""
    coarse = {'sensor.velocity': 'differenced', 'duration': 3.0}
    loop = load_loop('openarm', {PLANT: coarse})
    assert simulate(loop.controller, loop.plant).run().stops == ()


@pytest.mark.parametrize('preset', ['panda', 'panda_rigid'])
def test_rates_are_softened_by_the_share_and_stiffnesses_by_its_square(preset):
    """`panda` has gains of joints and a load observer, `panda_rigid` a damping rate."""
    before = controller_of(load_loop(preset).controller).settings
    after = calming.softened(before, 0.5)
    pairs = {
        0.5: (
            lambda of: of.robust_gain,
            lambda of: of.surface.gain,
            lambda of: of.surface.mu,
            lambda of: of.feedback.gain,
            lambda of: of.feedback.robust_gain,
            lambda of: of.feedback.damping_rate,
            lambda of: of.observer.observer_bandwidth,
        ),
        0.25: (
            lambda of: of.barrier.weight,
            lambda of: of.barrier.slope_limit,
            lambda of: of.disturbance.gain,
        ),
    }
    for share, fields in pairs.items():
        for field in fields:
            np.testing.assert_allclose(field(after), share * np.array(field(before)))
    assert np.all(before.surface.gain > 0.0)
    assert np.all(before.disturbance.gain > 0.0)
