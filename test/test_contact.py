# SPDX-License-Identifier: Apache-2.0
"""Torque from outside, told from the model's errors, from a load, and what follows from it."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from paper_case import configured
from random_arm import PANDA
from scenario import Scenario

import blf_dsc_controller as blf
from blf_dsc_controller.analysis.metrics_table import format_table
from blf_dsc_controller.arms.urdf import frames
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.law.perception import CONTACT
from blf_dsc_controller.law.samples import sample_columns
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.journal import EventType
from blf_dsc_controller.run import FIRST_STAMP
from blf_dsc_controller.simulation.loop import (
    write_bag,
)
from blf_dsc_controller.supervision.supervisor import Reason
from blf_dsc_controller.tool.tip_wrench import TipWrench

# s
TOUCHED = 8.0
RELEASED = 9.0
END = 10.0
ON = {'contact.enabled': True}
PUSH = [20.0, 0.0, 0.0]  # N, horizontal
NOTHING = {'events.begin': [], 'events.duration': [], 'events.payload': []}


def pushed(force, begin=TOUCHED, end=RELEASED):
    return {
        'events.begin': [begin],
        'events.duration': [end - begin],
        'events.payload': [0.0],
        'events.force': force,
    }


def loop_of(events, **controller):
    plant = {'truth.mass_deviation': 0.3, 'sensor.incomplete_states': 0, **events}
    return configured('panda_rigid', END, ON | controller, plant)


def run_of(events, **controller):
    config = loop_of(events, **controller)
    return blf.simulate(config.controller, config.plant)


def columns(record):
    """Samples by name, and their times [s]."""
    samples = sample_columns(record.samples, record.controller.settings)
    return samples, record.stamps * 1e-9


def contacts(record):
    """Times of the contacts [s]."""
    return [
        (event.stamp - FIRST_STAMP) * 1e-9
        for event in record.journal.pending
        if event.type is EventType.CONTACT
    ]


@pytest.fixture(scope='module')
def free():
    return run_of(NOTHING)


@cache
def answered(reaction):
    """Return a run with a push, which goes on where it takes the law out of command."""
    end = END if reaction in ('stop', 'yield') else RELEASED
    return run_of(pushed(PUSH, end=end), **{'contact.reaction': reaction})


@pytest.fixture(scope='module')
def held():
    """A push that makes the arm hold."""
    return answered('hold')


@pytest.fixture(scope='module')
def held_bag(held, tmp_path_factory):
    path = tmp_path_factory.mktemp('held') / 'bag'
    write_bag(path, held)
    return path


def test_interval_covers_what_model_and_noise_leave(free):
    """95 % of a free motion, without being ten times as wide as it needs to be."""
    samples, t = columns(free)
    late = t > TOUCHED
    inside = np.abs(samples.external[late]) < samples.external_interval[late]
    assert inside.mean(axis=0).min() > 0.95
    rms = np.sqrt((samples.external[late] ** 2).mean(axis=0))
    assert (samples.external_interval[late].mean(axis=0) < 10.0 * rms).all()
    assert not contacts(free)


def test_no_torque_depends_on_it(free):
    without = run_of(NOTHING, **{'contact.enabled': False})
    assert without.run().contacts is None
    assert 'contacts' not in format_table(blf.measure(without.run()))
    np.testing.assert_array_equal(columns(free)[0].torque, columns(without)[0].torque)
    assert columns(without)[0].external.shape[1] == 0


def test_force_on_the_tip_is_found_in_the_joints_and_at_the_tip(held):
    """To 15 % of 20 N, 0.3 s after it began; the tip's axes are turned to the base's."""
    samples, t = columns(held)
    config = held.config
    k = int(np.argmin(np.abs(t - TOUCHED - 0.3)))
    q = samples.qr[k] + samples.xi1[k]
    tip = TipWrench(config.robot.chain(PANDA))
    needed = tip.jacobian(q)[:3].T @ (rotation(config, q).T @ PUSH)
    error = np.abs(samples.external[k] - needed)
    assert (error < samples.external_interval[k] + 0.15 * np.abs(needed)).all()
    wrench = tip.of(q, samples.external[k], samples.external_interval[k])
    force = rotation(config, q) @ wrench[:3]
    assert np.linalg.norm(force - PUSH) < 0.15 * 20.0


def rotation(config, q):
    return frames(config.robot.chain(PANDA), q)[-1][:3, :3]


def test_load_is_no_contact_but_learned():
    """2 kg are picked up at 7 s: 10 N m more, all of which a load explains."""
    event = {'events.begin': [7.0], 'events.duration': [10.0], 'events.payload': [2.0]}
    record = run_of(event, **{'contact.reaction': 'stop'})
    samples, t = columns(record)
    assert np.abs(samples.external[(t > 7.0) & (t < 7.2)]).max() > 8.0
    assert not contacts(record)
    assert samples.load[-1, 0] == pytest.approx(2.0, abs=0.05)
    alone = run_of(event, **{'contact.reaction': 'stop', 'contact.loads': False})
    assert contacts(alone)[0] == pytest.approx(7.02, abs=0.03)  # the same, unexpected


@pytest.mark.parametrize(('force', 'is_contact'), [(20.0, True), (-20.0, False)])
def test_empty_hand_that_is_pushed_up_has_no_load_that_explains_it(force, is_contact):
    """Down, it might be a load; none is lighter than nothing."""
    record = run_of(pushed([0.0, 0.0, force], end=END), **{'contact.reaction': 'stop'})
    assert bool(contacts(record)) is is_contact


@pytest.mark.parametrize('reaction', ['none', 'stop', 'hold', 'yield'])
def test_contact_is_found_and_answered_as_chosen(reaction):
    """20 N within 60 ms; after a stop nothing is commanded by the law."""
    record = answered(reaction)
    samples, t = columns(record)
    found = contacts(record)
    assert 0.0 < found[0] - TOUCHED < 0.06
    stops = [e for e in record.journal.pending if e.type is EventType.STOP]
    runs = ~np.isnan(samples.qr[:, 0])
    if reaction in ('none', 'hold'):
        assert runs.all()
        assert not stops
    else:
        assert stops[0].content['reason'] == Reason.CONTACT
        assert 'something touches the arm' in stops[0].content['text']
        assert not runs[t > found[0]].any()
    moves = np.abs(samples.dqr[(t > found[0] + 0.5) & runs]).max(initial=0.0)
    assert (moves > 0.0) == (reaction == 'none')


def test_contact_is_not_learned_where_something_reacts(held):
    """Nothing but d^3 changes from the detection on; without a reaction the model does."""
    samples, t = columns(held)
    (found, *_) = contacts(held)
    touched = (t > found + 2e-3) & (samples.contact[:, CONTACT] > 0.0)
    assert np.ptp(samples.estimate[touched], axis=0).max() == 0.0
    assert samples.changes[-1, 0] == 0.0
    assert columns(answered('none'))[0].changes[-1, 0] > 0.0


def test_contact_ends_and_learning_goes_on(held):
    samples, t = columns(held)
    on = t[samples.contact[:, CONTACT] > 0.0]
    assert RELEASED < on[-1] < RELEASED + 0.6
    assert np.ptp(samples.estimate[t > on[-1] + 0.5], axis=0).max() > 0.0


def test_arm_that_yields_gives_way_and_one_that_stops_resists():
    """For a second each, pushed by 20 N from the contact on."""
    way = []
    for reaction in ('stop', 'yield'):
        q = answered(reaction).measurements[:, :7]
        way.append(np.abs(q[-1] - q[round(1e3 * TOUCHED) + 200]).max())
    assert way[1] > 3.0 * way[0]


@pytest.mark.usefixtures('blank_pictures')
def test_run_and_its_bag_say_what_touched_the_arm(tmp_path, held, held_bag, free):
    """In table, page and export; the arm's estimates are shown as without contacts."""
    for run in (held.run(), blf.read_run(held_bag)):
        ((time, contact),) = run.timed_contacts
        assert TOUCHED < time < TOUCHED + 0.06
        assert contact.joint in PANDA
        assert abs(contact.torque) > contact.interval
        metrics = blf.measure(run)
        line = f'contacts    1: at {time:.3f} s {contact.torque:+.3g} N m on {contact.joint}'
        assert line in format_table(metrics)
        assert metrics.parameter_error.end < 0.01
    page, sheet = tmp_path / 'report.html', tmp_path / 'run.csv'
    assert main(['report', str(held_bag), '--out', str(page)]) == 0
    assert contact.text.split(':')[0] in page.read_text()
    assert main(['export', str(held_bag), '--out', str(sheet)]) == 0
    head = sheet.read_text().partition('\n')[0]
    assert f'external {contact.joint} [N m]' in head
    assert 'monitor contact [1]' in head
    assert 'contacts    0\n' in format_table(blf.measure(free.run())) + '\n'


def test_replay_repeats_it_bit_for_bit(held_bag):
    result = blf.verify(held_bag)
    assert result.difference is None
    assert not result.is_partial
    assert EventType.CONTACT in [event.type for event in result.events]
    compared = {each.topic: each.values for each in result.comparisons}
    assert compared[topics.EXTERNAL_TORQUE.resolved] > 14 * 700
    assert topics.EXTERNAL_WRENCH.resolved in result.not_compared
    names = blf.read_run(held_bag).monitor.names
    assert set(topics.CONTACT) <= set(names)


def test_tare_at_rest_is_zero_there_replays_and_is_forgotten(tmp_path):
    """Refused in motion and during a contact; a push of 20 N is found all the same."""
    loop = loop_of(
        pushed(PUSH, 9.5, 10.0),
        **{'contact.reaction': 'hold', 'contact.loads': False},
    )
    arm = Scenario(loop, record=tmp_path / 'bag')
    with arm.controller as controller:
        guard = controller.guard
        law = guard.controller
        with pytest.raises(blf.TareError, match='the law is not in command'):
            controller.tare()
        arm.run(8.0)
        with pytest.raises(
            blf.TareError, match=r'the arm moves, .* hold it still for 0.2 s'
        ):
            controller.tare()
        assert not controller.is_tared
        guard.motions.brake()
        arm.run(1.0)
        before = law.sample.external_interval.copy()
        controller.tare()
        arm.run(0.3)
        assert controller.is_tared
        assert (law.sample.external_interval < 0.7 * before).all()
        assert (np.abs(law.sample.external) < law.sample.external_interval).all()
        assert not guard.findings.contacts.count
        arm.run(0.3)
        assert guard.findings.contacts.count == 1
        with pytest.raises(
            blf.TareError, match=r'something touches the arm: .* clear it first'
        ):
            controller.tare()
        law.state.change.changes[0] += 1.0  # as if it had picked up a load
        law.perceive(1e-3)
        assert not controller.is_tared
        law.state.change.changes[0] -= 1.0
    result = blf.verify(tmp_path / 'bag')
    assert result.difference is None
    assert not result.is_partial
    assert [event.type for event in result.events].count(EventType.TARE) == 1


def test_tare_without_external_torque_says_what_to_set():
    loop = loop_of(NOTHING, **{'contact.enabled': False})
    with (
        blf.ArmController(loop.controller) as controller,
        pytest.raises(blf.TareError, match=r'set contact\.enabled'),
    ):
        controller.tare()
