# SPDX-License-Identifier: Apache-2.0
"""A line of `blf_dsc doctor`."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple


class Level(str, Enum):
    """How much a finding matters."""

    __str__ = str.__str__

    OK = 'ok'
    NOTE = 'note'  # something does not work, or not well
    PROBLEM = 'PROBLEM'  # nothing works, or not what was asked about


class Finding(NamedTuple):
    """What was found about a subject, and what to do."""

    level: Level
    subject: str
    text: str
    remedy: str = ''


def ok(subject: str, text: str) -> Finding:
    """Return a finding that asks for nothing."""
    return Finding(Level.OK, subject, text)


def note(subject: str, text: str, remedy: str) -> Finding:
    """Return a finding with what would be better."""
    return Finding(Level.NOTE, subject, text, remedy)


def problem(subject: str, text: str, remedy: str = '') -> Finding:
    """Return a finding that must be corrected first."""
    return Finding(Level.PROBLEM, subject, text, remedy)
