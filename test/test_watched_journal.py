# SPDX-License-Identifier: Apache-2.0
"""What a journal tells the watchdog: parameters, and a silence that is meant."""

from __future__ import annotations

import pytest

from blf_dsc_controller.messages.journal import Event, EventType
from blf_dsc_controller.supervision.watched_journal import Meaning, WatchedJournal

FIRST, OTHER = {'safety.damping': 1.0}, {'safety.damping': 2.0}
CHANGE = {'torque.limit': 9.0}


def event(kind, number=0, commands=0, **content):
    return Event(number, kind, -1, commands, commands, content)


def configure(parameters):
    return event(EventType.CONFIGURE, parameters=parameters)


@pytest.fixture
def journal():
    """That of a controller in command."""
    journal = WatchedJournal()
    assert journal.take(configure(FIRST), is_engaged=False) is Meaning.BACK
    assert journal.parameters == FIRST
    return journal


@pytest.mark.parametrize(
    ('kind', 'content', 'meaning'),
    [
        (EventType.WITHDRAW, {'text': 'why'}, Meaning.SILENT),
        (EventType.RELEASE, {'resting': True}, Meaning.SILENT),
        (EventType.RELEASE, {'resting': False}, Meaning.LEFT),
        (EventType.RESET, {}, Meaning.BACK),
        (EventType.ACTIVATE, {}, Meaning.BACK),
        (EventType.DEACTIVATE, {}, Meaning.NOTHING),
        (EventType.STOP, {'reason': 'failed', 'text': 'why'}, Meaning.NOTHING),
    ],
)
def test_silence_is_meant_after_the_end_of_a_controller_that_has_commanded(
    journal, kind, content, meaning
):
    """One that has not commanded leaves the arm to whoever holds it."""
    is_end = meaning in (Meaning.SILENT, Meaning.LEFT)
    unused = journal.take(event(kind, 5, 0, **content), is_engaged=True)
    assert unused is (Meaning.NOTHING if is_end else meaning)
    used = journal.take(event(kind, 6, 100, **content), is_engaged=True)
    assert used is meaning


def test_parameters_of_a_second_controller_count_from_its_start_on(journal):
    assert journal.take(configure(OTHER), is_engaged=True) is Meaning.NOTHING
    activate = event(EventType.ACTIVATE, 1)
    assert journal.take(activate, is_engaged=True) is Meaning.NOTHING
    changed = event(EventType.PARAMETERS, 2, parameters=CHANGE)
    assert journal.take(changed, is_engaged=True) is Meaning.NOTHING
    assert journal.parameters == FIRST
    start = event(EventType.START, 3, resumed=False)
    assert journal.take(start, is_engaged=True) is Meaning.BACK
    assert journal.parameters == OTHER | CHANGE


@pytest.mark.parametrize('commands', [0, 100])
def test_change_of_parameters_leaves_the_others_as_they_are(journal, commands):
    changed = event(EventType.PARAMETERS, 1, commands, parameters=CHANGE)
    journal.take(changed, is_engaged=False)
    journal.adopt_next()
    assert journal.parameters == FIRST | CHANGE


def test_change_of_parameters_of_which_the_others_are_unknown_does_not_count():
    """Else they would be the defaults: those of another arm."""
    journal = WatchedJournal()
    journal.take(
        event(EventType.PARAMETERS, 7, 100, parameters=CHANGE), is_engaged=True
    )
    assert not journal.parameters


@pytest.mark.parametrize(
    ('number', 'commands'),
    [(1, 100), (7, 0)],
    ids=['it has commanded', 'another number'],
)
def test_events_of_the_controller_in_command_are_not_those_of_a_second_one(
    journal, number, commands
):
    journal.take(configure(OTHER), is_engaged=True)
    softer = {'safety.damping': 0.5}
    journal.take(
        event(EventType.PARAMETERS, number, commands, parameters=softer),
        is_engaged=True,
    )
    assert journal.parameters == softer
    journal.take(event(EventType.START, 1, resumed=False), is_engaged=True)
    assert journal.parameters == OTHER


def test_parameters_of_a_second_controller_that_ends_before_its_start_never_count(
    journal,
):
    journal.take(configure(OTHER), is_engaged=True)
    release = event(EventType.RELEASE, 1, resting=True)
    assert journal.take(release, is_engaged=True) is Meaning.NOTHING
    journal.adopt_next()
    assert journal.parameters == FIRST
