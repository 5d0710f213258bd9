# SPDX-License-Identifier: Apache-2.0
"""`python -m benchmark`: every table has one command, one line, and options that parse."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from benchmark.__main__ import main, parser_of
from benchmark.studies import load_study
from benchmark.tables import TABLES, module_of

ROOT = Path(__file__).resolve().parents[1]
NO_TABLES = {'__main__', 'null_node'}  # programs of their own


def functions(path):
    """Names of the functions of a module."""
    tree = ast.parse(path.read_text(encoding='utf-8'))
    return {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


def test_every_module_that_makes_a_table_is_listed_with_one_line(capsys):
    made = {
        f'benchmark.{path.stem}'
        for path in (ROOT / 'benchmark').glob('*.py')
        if 'main' in functions(path) and path.stem not in NO_TABLES
    }
    assert made == {module_of(name) for name in TABLES}
    assert main([]) == 0
    lines = capsys.readouterr().out.splitlines()
    for name, about in TABLES.items():
        (line,) = (each for each in lines if each.split()[:1] == [name])
        assert line.endswith(about)
        assert len(line) <= 88


@pytest.mark.parametrize('name', TABLES)
def test_help_of_a_table_says_how_it_is_called(name):
    text = parser_of(name).format_help()
    assert text.count(f'python -m benchmark {name}') >= 2  # the usage, and an example


STUDIES = sorted(path.stem for path in (ROOT / 'benchmark/studies').glob('*.yaml'))


@pytest.mark.parametrize('name', STUDIES)
def test_every_study_of_the_tables_loads_and_varies(name):
    """From any folder, also those that are based on the file beside them."""
    study = load_study(name)
    assert study.settings.pairs
    assert len(study.variations) > 10


def test_error_of_a_table_is_one_line_and_an_exit_code(tmp_path):
    run = subprocess.run(
        [sys.executable, '-m', 'benchmark', 'paper', '--out', str(tmp_path)],
        check=False,
        capture_output=True,
        text=True,
        cwd=ROOT,
    )
    assert run.returncode == 1
    assert run.stderr == (
        f'benchmark paper: {tmp_path} exists already and is not overwritten: '
        'choose another --out\n'
    )
