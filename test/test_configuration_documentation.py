# SPDX-License-Identifier: Apache-2.0
"""The documented tables of parameters and topics match the code."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from blf_dsc_controller.configuration.nodes import known_names, parameter_page
from blf_dsc_controller.messages import topics

COMMITTED = Path(__file__).parents[1] / 'doc' / 'parameters.md'


def test_parameter_page_is_up_to_date():
    assert COMMITTED.read_text(encoding='utf-8') == parameter_page(), (
        'run: python -m blf_dsc_controller.configuration.nodes doc/parameters.md'
    )


def test_command_writes_the_parameter_page(tmp_path):
    page = tmp_path / 'parameters.md'
    module = 'blf_dsc_controller.configuration.nodes'
    subprocess.run([sys.executable, '-m', module, str(page)], check=True, cwd=COMMITTED.parents[1])
    assert page.read_text(encoding='utf-8') == parameter_page()


def test_every_parameter_has_a_row_of_eight_cells():
    rows = [row for row in parameter_page().splitlines() if row.startswith('| `')]
    assert {row.split('`')[1] for row in rows} == known_names()
    assert {row.replace('\\|', '').count('|') for row in rows} == {9}


def test_topic_page_lists_every_topic_with_its_type():
    page = (COMMITTED.parent / 'topics.md').read_text(encoding='utf-8')
    for topic in vars(topics).values():
        if isinstance(topic, topics.Topic):
            name = topic.resolved if topic.name.startswith('/') else topic.relative
            assert f'| `{name}` | {topic.type.replace("/msg/", "/")} |' in page
