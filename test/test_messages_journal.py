# SPDX-License-Identifier: Apache-2.0
"""The journal: its schema, and messages on its topic that are no events."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

import blf_dsc_controller as blf
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import typestore
from blf_dsc_controller.messages.journal import (
    Event,
    EventType,
    decode,
)

EXAMPLES = yaml.safe_load(Path(__file__).with_name('journal_events.yaml').read_text())
POINT = EXAMPLES['trajectory']['points'][0]


def encoded(text):
    message = typestore().types[topics.JOURNAL.type](data=text)
    return bytes(typestore().serialize_cdr(message, topics.JOURNAL.type))


def event(kind='activate', content=None, **fields):
    """Return an event as JSON, with some fields replaced."""
    content = EXAMPLES[kind] if content is None else content
    given = Event(0, kind, -1, 0, 0, content)._asdict() | fields
    return json.dumps(given)


@pytest.mark.parametrize('kind', EventType)
def test_every_event_has_a_schema_and_is_read_back(kind):
    found = decode(encoded(event(kind.value)))
    assert found == Event(0, kind, -1, 0, 0, EXAMPLES[kind.value])
    assert found.type is kind


@pytest.mark.parametrize(
    ('text', 'reason'),
    [
        ('{', 'Expecting property name'),
        ('[' * 100_000, 'recursion'),
        ('[1]', 'it is no object with fields by name'),
        ('{"number": 0}', '`type` is missing, expected a text'),
        (event(number=-1), "`number` is '-1', expected a count"),
        (
            event(commands=2**63),
            "`commands` is '9223372036854775808', expected a count",
        ),
        (event(stamp=1.5), "`stamp` is '1.5', expected a stamp in ns, or -1"),
        (event(type='dance'), "the type 'dance' is none of configure, activate, "),
        (event(content=3), "`content` is '3', expected fields by name"),
        (event('stop', {'reason': 'x'}), '`text` is missing, expected a text'),
        (
            event('stop', {'reason': [], 'text': ''}),
            "`reason` is '\\[\\]', expected a text",
        ),
        (event('start', {'resumed': 0}), "`resumed` is '0', expected true or false"),
        (
            event('parameters', {'parameters': {'a': {}}}),
            '`parameters` is .*, expected parameters by name',
        ),
        *(
            (
                event('trajectory', EXAMPLES['trajectory'] | {'points': points}),
                '`points` is .*, expected a list of points of a trajectory',
            )
            for points in (3, [POINT | {'positions': [None]}], [POINT | {'colour': 1}])
        ),
        (
            event('trajectory', EXAMPLES['trajectory'] | {'at': float('nan')}),
            "`at` is 'nan', expected a finite number",
        ),
        (
            event('configure', {'parameters': {}, 'topics': ['a']}),
            '`topics` is .*, expected texts by name',
        ),
    ],
)
def test_what_is_no_event_is_named_in_one_line(text, reason):
    with pytest.raises(blf.BlfDscError, match=reason) as found:
        decode(encoded(text))
    assert '\n' not in str(found.value)


def test_fields_of_a_later_version_are_ignored():
    text = event('start', {'resumed': True, 'mood': 'good'}, colour='red')
    assert decode(encoded(text)).content['resumed'] is True
