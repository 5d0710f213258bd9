# SPDX-License-Identifier: Apache-2.0
"""Every figure that README claims is in one row of doc/evidence.md, with where it comes from."""

from __future__ import annotations

import re
from collections import Counter
from itertools import pairwise
from pathlib import Path

import pytest
from markdown_it import MarkdownIt

ROOT = Path(__file__).resolve().parents[1]
MEASURED = '', 'How it compares', 'Limitations'
"""Sections of README whose figures were measured; the first is before any heading."""
WORDS = [
    'none',
    'one',
    'two',
    'three',
    'four',
    'five',
    'six',
    'seven',
    'eight',
    'nine',
    'ten',
]
NUMBER = re.compile(
    rf'(?<![\w.])(\d+(?:,\d{{3}})*(?:\.\d+)?|{"|".join(WORDS)})(?![\w])'
)
COLUMNS = ['claim', 'figures', 'arms and plants', 'command', 'commit, date']


def blocks(path):
    """Yield the section, and the text of each paragraph, item and row of a table."""
    tokens = MarkdownIt('commonmark').enable('table').parse(path.read_text())
    section, row = '', None
    for before, token in pairwise(tokens):
        if token.type == 'tr_open':
            row = []
        elif token.type == 'tr_close':
            yield section, ' | '.join(row)
            row = None
        elif token.type == 'inline':
            if before.type == 'heading_open':
                section = token.content if before.tag == 'h2' else section
            elif row is None:
                yield section, token.content
            else:
                row.append(token.content)


def numbers(text):
    """Return how often each number is in a text, also as a word; code and links do not count."""
    text = re.sub(r'`[^`]*`|\]\([^)]*\)|ROS 2', ' ', text)
    found = NUMBER.findall(text.lower())
    return Counter(
        str(WORDS.index(n)) if n in WORDS else n.replace(',', '') for n in found
    )


CLAIMS = [
    text
    for section, text in blocks(ROOT / 'README.md')
    if section in MEASURED and numbers(text)
]
ROWS = [
    text
    for _, text in blocks(ROOT / 'doc' / 'evidence.md')
    if text.count(' | ') == len(COLUMNS) - 1
]


@pytest.mark.parametrize('claim', CLAIMS)
def test_figures_of_readme_are_those_of_one_row_of_the_evidence(claim):
    missing = [numbers(claim) - numbers(' '.join(row.split(' | ')[:2])) for row in ROWS]
    assert not all(missing), f'no row has all figures of README: {claim}'


def test_rows_say_commit_and_date():
    heads = [row for row in ROWS if row == ' | '.join(COLUMNS)]
    for row in ROWS:
        if row not in heads:
            assert re.fullmatch(
                r'[0-9a-f]{8}, \d{4}-\d\d-\d\d', row.rpartition(' | ')[2]
            ), row
    assert len(ROWS) > 50
