# SPDX-License-Identifier: Apache-2.0
"""The sequence in which a load is declared, with drives and a law that only take notes."""

from __future__ import annotations

import pytest

from blf_dsc_controller.supervision.drive_load import DriveLoad
from blf_dsc_controller.supervision.load_declaration import (
    DeclarationError,
    LoadDeclaration,
)

EVERY = 20  # states, as `load_declaration` has it
STEPS = [DriveLoad(mass, (0.0, 0.0, 0.1)) for mass in (0.5, 1.0)]


class Law:
    """Wants two steps, and keeps what it took over."""

    def __init__(self):
        self.is_at_rest = False
        self.left, self.taken = list(STEPS), []

    def load_to_tell(self):
        return self.left.pop(0) if self.left else None

    def take_over(self, load):
        self.taken.append(load)


class Drives(LoadDeclaration):
    """Keep what they were told; a test says when it is in force, or what is wrong."""

    def __init__(self):
        super().__init__()
        self.told, self.accepts, self.error, self.is_there = [], False, '', True

    def can_declare(self):
        return self.is_there

    def declare(self, load):
        self.told.append(load)

    def is_in_force(self, load):
        assert load == self.told[-1]
        if self.error:
            raise DeclarationError(self.error)
        return self.accepts


@pytest.fixture(name='drives')
def drives_fixture():
    return Drives()


@pytest.fixture(name='law')
def law_fixture():
    return Law()


def follow(drives, law, states, *, in_motion=True):
    for _ in range(states):
        drives.follow(law, in_motion=in_motion)


def test_a_step_follows_twenty_states_after_the_one_before_is_in_force(drives, law):
    follow(drives, law, EVERY - 1)
    assert not drives.told
    follow(drives, law, 1)
    assert drives.told == STEPS[:1]
    follow(drives, law, 3 * EVERY)  # the drives take their time
    assert drives.told == STEPS[:1]
    assert not law.taken
    drives.accepts = True
    follow(drives, law, 1)
    assert law.taken == STEPS[:1]
    assert drives.in_force == STEPS[0]
    follow(drives, law, EVERY - 1)
    assert drives.told == STEPS[:1]
    follow(drives, law, 2)
    assert law.taken == drives.told == STEPS
    follow(drives, law, 3 * EVERY)  # there is nothing left to tell
    assert drives.told == STEPS


def test_drives_that_forbid_motion_are_told_at_rest(drives, law):
    follow(drives, law, 3 * EVERY, in_motion=False)
    assert not drives.told
    assert law.left == STEPS
    law.is_at_rest = True
    follow(drives, law, EVERY, in_motion=False)
    assert drives.told == STEPS[:1]


def test_drives_that_are_not_there_yet_are_told_once_they_are(drives, law):
    drives.is_there = False
    follow(drives, law, 3 * EVERY)
    assert law.left == STEPS
    drives.is_there = True
    follow(drives, law, 1)
    assert drives.told == STEPS[:1]


def test_after_a_refusal_nothing_is_declared_and_nothing_taken_over(drives, law):
    drives.error = 'too heavy'
    follow(drives, law, EVERY + 1)
    assert drives.problem == 'too heavy'
    drives.error, drives.accepts = '', True
    follow(drives, law, 3 * EVERY)
    assert drives.told == STEPS[:1]
    assert not law.taken
    assert drives.in_force is None
