# SPDX-License-Identifier: Apache-2.0
"""A dead or stopped controller and a drive that holds the last torque: the watchdog takes over."""

from __future__ import annotations

import numpy as np
import pytest
from fault_table import MILLISECOND, Rig
from random_arm import CONFIG

from blf_dsc_controller import load_loop
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.factory.settings import settings_of_config
from blf_dsc_controller.nodes.watchdog_presence import WatchdogPresence
from blf_dsc_controller.supervision.guard import Guard
from blf_dsc_controller.supervision.model_torque import gravity_torque
from blf_dsc_controller.supervision.torque_watchdog import TorqueWatchdog
from sim_plant.plant import plant_of

TIMEOUT = 0.05  # s
START = 1_000_000_000  # ns
HOLDING = {'safety.torque': 'hold_gravity'}
AT_REST = HOLDING | {'reference.type': 'hold'}
ARM = {'disturbance.amplitude': [0.0, 0.0]}


class Watched(Rig):
    """A loop whose controller can die; its drive holds the last torque for ever."""

    def __init__(self, given, period=4):
        super().__init__(given, plant=ARM)
        self.line = TorqueWatchdog(self.config, TIMEOUT)
        self.period = period  # ms, of the watchdog
        self.dead = False
        self.taken = []  # torques of the watchdog

    def step(self, count=1):
        for _ in range(count):
            state = self.state()
            now = self.plant.sample * 1e-3
            if not self.dead:
                self.deliver(state.raw())
                self.line.take_torque(self.commands[-1], now)
            values = np.concatenate((state.q, state.dq, state.effort))
            self.line.take_state(state.stamp, values, now)
            if self.plant.sample % self.period == 0:
                torque = self.line.poll(now + 5e-4)  # between two states
                if torque is not None:
                    self.taken.append(torque.copy())
                    self.input.torque[:] = torque
            self.plant.step(self.input.torque)


@pytest.mark.parametrize('period', [1, 4])
@pytest.mark.parametrize(
    ('given', 'angle'), [(AT_REST, 0.01), (HOLDING, 0.15)], ids=['at rest', 'in motion']
)
def test_arm_of_a_dead_controller_comes_to_rest(given, angle, period):
    """The initial estimate is half the truth.

    Without a watchdog, the arm in motion goes on.
    """
    rig, alone = Watched(given, period), Watched(given)
    alone.line.poll = lambda _: None
    for each in (rig, alone):
        each.step(800)
        assert not each.taken
        assert (np.abs(each.state().dq).max() > 0.1) == (given is HOLDING)
        each.dead = True
    start = rig.state().q
    rig.step(3000)
    alone.step(1000)
    assert rig.line.active
    assert rig.line.silence == pytest.approx(TIMEOUT, abs=0.005)
    assert np.abs(rig.state().q - start).max() < angle
    assert np.abs(rig.state().dq).max() < 0.01
    assert (np.abs(alone.state().q - start).max() > 0.5) == (given is HOLDING)


@pytest.mark.parametrize(('preset', 'angle'), [('fr3', 0.2), ('ur5e_driver', 0.15)])
@pytest.mark.parametrize(
    'armed', [False, True], ids=['watching', 'restarted afterwards']
)
def test_named_arm_of_a_dead_controller_comes_to_rest(preset, angle, armed):
    """In motion.

    An FR3 brakes at jumps of 1 N m in a cycle, if its driver lets them pass.

    Which torque its drives hold, a restarted one cannot know: that is left to the
    driver.
    """
    loop = load_loop(CONFIG / f'{preset}.yaml')
    unlimited = {} if armed else {'actuator.rate_limit': 0.0}
    guard = Guard(loop.controller)
    plant = plant_of(change(loop.plant, unlimited))
    guard.starting.activate()
    line = TorqueWatchdog(loop.controller, TIMEOUT, armed=armed)
    T = loop.controller.sample_time
    n = len(loop.controller.joints)
    death = round(1.1 / T)
    for k in range(death + round(3.0 / T)):
        now, measurement = k * T, plant.measure().copy()
        if k == death:
            start = plant.truth()[-2 * n : -n].copy()
            assert np.abs(measurement[n : 2 * n]).max() > 0.3
        if k < death:
            torque = guard.update(
                START + k * loop.controller.sample_time_ns, measurement
            ).copy()
            if not armed:
                line.take_torque(torque, now)
        if k >= death or not armed:
            line.take_state(
                START + k * loop.controller.sample_time_ns, measurement, now
            )
            taken = line.poll(now)
            torque = torque if taken is None else taken.copy()
        plant.step(torque)
    assert line.takeovers == 1
    assert not plant.is_stopped
    # a count of 17 bits shows as 0.013 rad/s
    q, dq = plant.truth()[-2 * n :].reshape(2, n)
    assert np.abs(dq).max() < 0.01
    assert np.abs(q - start).max() < angle


def test_nothing_is_commanded_before_the_controller_or_while_states_stand_still():
    """Such as a plant in lock-step, which waits for a torque and repeats its state."""
    rig = Watched(HOLDING)
    state = rig.state()
    values = np.concatenate((state.q, state.dq, state.effort))
    for k in range(1000):
        if k == 500:
            rig.line.take_torque(np.ones(2), 0.5)
        rig.line.take_state(state.stamp + min(k, 499) * MILLISECOND, values, k * 1e-3)
        assert rig.line.poll(k * 1e-3) is None
    assert rig.line.leave() is None
    armed = TorqueWatchdog(rig.config, TIMEOUT, armed=True)
    for k in range(1000):
        armed.take_state(state.stamp, values, k * 1e-3)
        assert armed.poll(k * 1e-3) is None


def test_controller_that_is_back_takes_over_at_once_and_the_torque_fades_with_the_states():
    """After that it waits for a new controller."""
    rig = Watched(HOLDING)
    for takeovers in (1, 2):
        count = len(rig.taken)
        rig.dead = False
        rig.step(100)
        assert not rig.line.active
        assert len(rig.taken) == count
        rig.dead = True
        rig.step(200)
        assert rig.line.active
        assert rig.line.takeovers == takeovers
    assert rig.line.leave().all()
    now = rig.plant.sample * 1e-3
    polled = [rig.line.poll(now + k * 1e-3) for k in range(1000)]
    faded = [torque.copy() for torque in polled if torque is not None]
    assert not faded[-1].any()
    safety = rig.config.safety
    seconds = rig.config.sample_time + safety.state_timeout + safety.fade_time
    assert len(faded) * 1e-3 == pytest.approx(seconds, abs=0.005)
    assert not rig.line.active
    rig.step(200)
    assert not rig.line.active


def test_torque_is_finite_and_within_its_rate_from_what_the_controller_commanded():
    """Polled every 4 ms, by the rate of a sample of 1 ms.

    An unknown torque is not continued.
    """
    limited = AT_REST | {'torque.rate_limit': [300.0, 300.0]}
    rig, restarted = Watched(limited), Watched(limited)
    restarted.line = TorqueWatchdog(rig.config, TIMEOUT, armed=True)
    restarted.dead = True
    rig.step(100)
    last = np.array([20.0, np.nan])
    rig.line.take_torque(last, rig.plant.sample * 1e-3)
    rig.dead = True
    for each in (rig, restarted):
        each.step(100)
    steps = np.diff([np.nan_to_num(last), *rig.taken], axis=0)
    assert np.abs(steps).max() == pytest.approx(0.3)
    assert np.abs(restarted.taken[0]).min() > 1.0  # half of gravity


def test_restarted_one_holds_by_the_model_it_was_given_last():
    """A drive holds the arm by a torque that it does not know: none is observed."""
    config = Watched(AT_REST).config
    settings = settings_of_config(config)
    estimate = settings.initial_estimate
    other = {'learning.initial_estimate': tuple(2.0 * estimate[: settings.p])}
    line = TorqueWatchdog(change(config, other), TIMEOUT, armed=True)
    line.configure(config)
    q = np.array([0.3, -0.4])
    for k in range(100):
        line.take_state(START + k * MILLISECOND, np.append(q, np.zeros(4)), k * 1e-3)
        if (torque := line.poll(k * 1e-3)) is not None:
            break
    np.testing.assert_allclose(torque, gravity_torque(settings, estimate, q), atol=0.01)


def test_it_says_whether_it_watches_and_whether_anybody_commands():
    """It watches once it has seen a torque and knows where the arm is."""
    rig = Watched(HOLDING)
    line = rig.line
    assert not line.is_engaged(0.0)
    rig.dead = True
    rig.step(100)
    assert not line.watches
    assert not line.is_engaged(0.1)
    rig.dead = False
    rig.step(10)
    now = rig.plant.sample * 1e-3
    assert line.watches
    assert line.is_engaged(now)
    assert not line.is_engaged(now + 2.0 * TIMEOUT)
    assert line.stand_down()
    assert not line.watches
    assert not line.is_engaged(now)
    rig.step(1)  # a torque that was on its way
    assert not line.watches
    line.stand_by()
    assert not line.watches
    rig.step(10)
    assert line.watches
    now = rig.plant.sample * 1e-3
    for k in range(1000):  # the states stop, too
        assert line.poll(now + k * 1e-3) is None
    assert not line.watches
    rig.dead = True
    rig.step(10)
    line.take_torque(np.zeros(2), rig.plant.sample * 1e-3)
    rig.step(100)
    assert line.active
    assert line.watches
    assert line.is_engaged(rig.plant.sample * 1e-3)
    armed = Watched(HOLDING)
    armed.line = TorqueWatchdog(armed.config, TIMEOUT, armed=True)
    armed.dead = True
    armed.step(10)
    assert not armed.line.watches
    armed.step(100)
    assert armed.line.active
    assert armed.line.watches


def test_it_does_not_stand_down_while_it_commands():
    rig = Watched(HOLDING)
    rig.step(100)
    rig.dead = True
    rig.step(100)
    assert not rig.line.stand_down()
    assert rig.line.active
    rig.line.stand_by()  # a reset of the silent controller
    assert rig.line.active
    rig.step(100)
    assert rig.line.takeovers == 1


def test_silence_after_a_controller_stood_down_is_meant_although_it_left_a_torque():
    """The torque that it leaves behind may come after the event that says so."""
    rig = Watched(HOLDING)
    rig.step(100)
    assert rig.line.stand_down()
    rig.step(1)
    rig.dead = True
    rig.step(200)
    assert not rig.taken
    rig.line.stand_by()
    rig.dead = False
    rig.step(1)
    rig.dead = True
    rig.step(200)
    assert rig.line.active


@pytest.mark.parametrize('repeats', [False, True])
def test_after_a_long_silence_of_the_states_it_waits_for_the_controller(repeats):
    """Nobody expects a torque any more, as after a restart of the driver.

    A state that `repeats`, with its stamp, is silence too.
    """
    rig = Watched(HOLDING)
    rig.step(100)
    rig.dead = True
    state = rig.state()
    values = np.concatenate((state.q, state.dq, state.effort))
    for now in np.arange(0.1, 2.2, 1e-3) if repeats else ():
        rig.line.take_state(state.stamp - MILLISECOND, values, now)
        assert rig.line.poll(now) is None
    for k in range(200):  # from 2.1 s later on
        now = 2.2 + k * 1e-3
        rig.line.take_state(START + round(now * 1e9), values, now)
        assert rig.line.poll(now) is None


def test_load_that_another_model_lacked_is_forgotten_with_it():
    rig = Watched(HOLDING)
    rig.step(800)
    rig.dead = True
    rig.step(800)
    load = rig.line._safe.load
    assert np.abs(load).max() > 1.0  # N m: half of gravity
    rig.line.configure(change(rig.config, {'safety.damping': (3.0, 3.0)}))
    assert load.any()
    rig.line.configure(change(rig.config, {'robot.gravity': (0.0, -4.9, 0.0)}))
    assert not load.any()


@pytest.mark.parametrize('expected', [False, True])
def test_watchdog_is_missed_once_it_was_seen_or_after_ten_looks_if_promised(expected):
    presence = WatchdogPresence(expected=expected)
    reports = [presence.look(there=False) for _ in range(12)]
    assert reports == [expected and k == 10 for k in range(12)]
    assert ('is missing' in presence.problem) is expected
    assert not presence.look(there=True)
    assert presence.problem == ''
    assert [presence.look(there=False) for _ in range(2)] == [True, False]
    assert 'is missing' in presence.problem
