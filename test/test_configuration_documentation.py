# SPDX-License-Identifier: Apache-2.0
"""The documented tables of parameters and topics against the code they are made from."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from blf_dsc_controller.configuration.documentation import parameter_page
from blf_dsc_controller.configuration.nodes import known_names
from blf_dsc_controller.messages.documentation import topic_page
from blf_dsc_controller.messages.topics import TOPICS

COMMITTED = Path(__file__).parents[1] / 'doc' / 'parameters.md'


def test_the_committed_table_is_up_to_date():
    assert COMMITTED.read_text(encoding='utf-8') == parameter_page(), (
        'run: python -m blf_dsc_controller.configuration.documentation doc/parameters.md'
    )


def test_the_command_it_names_writes_it(tmp_path):
    page = tmp_path / 'parameters.md'
    module = 'blf_dsc_controller.configuration.documentation'
    subprocess.run([sys.executable, '-m', module, str(page)], check=True, cwd=COMMITTED.parents[1])
    assert page.read_text(encoding='utf-8') == parameter_page()


def test_every_parameter_has_a_row_of_eight_cells():
    rows = [row for row in parameter_page().splitlines() if row.startswith('| `')]
    assert {row.split('`')[1] for row in rows} == known_names()
    assert {row.replace('\\|', '').count('|') for row in rows} == {9}


def test_the_page_of_topics_is_up_to_date():
    assert (COMMITTED.parent / 'topics.md').read_text(encoding='utf-8') == topic_page(), (
        'run: python -m blf_dsc_controller.messages.documentation doc/topics.md'
    )
    for topic in TOPICS:
        assert f'| `{topic.relative}` |' in topic_page()
