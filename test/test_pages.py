# SPDX-License-Identifier: Apache-2.0
"""README and doc/: files load, commands exist, and at night code runs and the site is whole.

In `make test`, code of pages and examples is compiled, and what it imports must exist.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import functools
import importlib
import importlib.util
import io
import re
import shlex
import subprocess
import sys
import textwrap
from itertools import pairwise
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from markdown_it import MarkdownIt

from benchmark.__main__ import parser_of as table_parser
from benchmark.tables import TABLES
from blf_dsc_controller import load_study
from blf_dsc_controller.cli.parser import make_parser
from blf_dsc_controller.configuration.nodes import NODES, known_names, load, read

ROOT = Path(__file__).resolve().parents[1]
DOC = ROOT / 'doc'
OUTSIDE = ('README.md', 'CONTRIBUTING.md')
PAGES = [*(ROOT / name for name in OUTSIDE), *sorted((ROOT / 'doc').glob('*.md'))]
OWN = 'blf_dsc_controller', 'sim_plant'
SAVED = re.compile(r'Save this as\s`(\w+\.py)`')
MAKEFILE = (ROOT / 'Makefile').read_text()
LAUNCH = (ROOT / 'launch/closed_loop.launch.py').read_text()
SETUP = (ROOT / 'setup.cfg').read_text()
ROS2_CONTROL_NODES = {'controller_manager', 'effort_controller'}
# Other programs that the pages may call; they are not checked.
FOREIGN = (
    'cd colcon coverage docker export git pre-commit pytest rosdoc2 rviz2 source sudo tar '
    'xacro'
)


@functools.cache
def tokens(page):
    return MarkdownIt('commonmark').parse(page.read_text())


def fences(page, language):
    return [
        item.content
        for item in tokens(page)
        if item.type == 'fence' and item.info == language
    ]


def each_page(pages):
    return pytest.mark.parametrize(
        'page', pages, ids=lambda page: page.relative_to(ROOT).as_posix()
    )


def home_page():
    """Return the program of the home page."""
    text = (DOC / 'index.rst').read_text()
    (block,) = re.findall(r'code-block:: python\n\n((?: {3}.*\n|\n)+)', text)
    return textwrap.dedent(block)


PROGRAMS = {
    'index.rst': home_page(),
    **{path.name: path.read_text() for path in (ROOT / 'examples').glob('*.py')},
    **{page.name: '\n'.join(fences(page, 'python')) for page in PAGES},
}


@pytest.mark.parametrize('name', [name for name in PROGRAMS if PROGRAMS[name]])
def test_code_compiles_and_has_only_names_that_exist(name):
    """Of the package; each name after the module under which it is imported."""
    modules = {}
    for node in ast.walk(ast.parse(PROGRAMS[name])):
        if isinstance(node, ast.Import):
            found = {each.asname or each.name: each.name for each in node.names}
            modules |= {k: v for k, v in found.items() if v.startswith(OWN)}
        elif isinstance(node, ast.ImportFrom) and node.module.startswith(OWN):
            assert all(exists(node.module, each.name) for each in node.names)
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            module = modules.get(node.value.id)
            assert not module or exists(module, node.attr)


def exists(module, name):
    """Whether a module has a name, also that of a module in it."""
    has_name = hasattr(importlib.import_module(module), name)
    return has_name or importlib.util.find_spec(f'{module}.{name}') is not None


@pytest.mark.nightly
@each_page([page for page in PAGES if fences(page, 'python')])
def test_python_blocks_run_and_print_the_output_shown_below_them(
    page, tmp_path, monkeypatch
):
    """The blocks of a page are run as one program, in a folder with the page's YAML file.

    Those below "Save this as `name.py`" are saved in this folder instead, to be
    imported.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    for text in fences(page, 'yaml'):
        Path('my.yaml').write_text(text)
    program = {'__name__': page.stem}
    blocks, saved = blocks_of(page)
    for index, (block, below) in enumerate(pairwise([*blocks, None])):
        if index in saved:
            Path(saved[index]).write_text(block.content)
        elif block.info == 'python':
            printed = io.StringIO()
            with contextlib.redirect_stdout(printed):
                exec(compile(block.content, page, 'exec'), program)  # noqa: S102 - our own pages
            if below and below.info == 'text':
                assert printed.getvalue() == below.content


@pytest.mark.nightly
@pytest.mark.usefixtures('blank_pictures')
def test_python_of_the_home_page_keeps_the_bound(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    program = {}
    exec(home_page(), program)  # noqa: S102 - our own pages
    assert program['metrics'].max_error_ratio < 1.0
    assert Path('pictures/change.png').is_file()


@each_page(sorted(DOC.glob('*.md')))
def test_no_paragraph_of_a_page_is_long(page):
    """At most 90 words, as CONTRIBUTING.md says; tables and equations do not count."""
    for before, token in pairwise(tokens(page)):
        if before.type == 'paragraph_open' and '\n| ---' not in token.content:
            assert len(token.content.split()) <= 90, token.content


def blocks_of(page):
    """Return the blocks of a page, and the names of those that are saved as Python files."""
    blocks, saved = [], {}
    for before, token in pairwise(tokens(page)):
        if token.type == 'fence':
            blocks.append(token)
        elif before.type == 'paragraph_open' and (name := SAVED.search(token.content)):
            saved[len(blocks)] = name[1]
    return blocks, saved


@each_page([page for page in PAGES if fences(page, 'yaml')])
def test_parameter_files_of_a_page_load(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    blocks, saved = blocks_of(page)
    for index, name in saved.items():
        Path(name).write_text(blocks[index].content)
    urdf = (ROOT / 'config/ur5e.urdf').as_posix()
    for text in fences(page, 'yaml'):
        file = Path('my.yaml')
        for placeholder in ('/path/to/my.urdf', 'topic://robot_description'):
            text = text.replace(placeholder, urdf)  # noqa: PLW2901
        file.write_text(text)
        found = {section.pattern.rpartition('/')[2] for section in read(file)}
        sections = found - ROS2_CONTROL_NODES
        assert sections <= {'**', 'monte_carlo', *NODES}
        if 'monte_carlo' in sections:
            load_study(file)
        else:
            for node in NODES if '**' in sections else sections:
                load(file, node, NODES[node])


def lines(page):
    """Lines with commands of a page: those of its `sh` blocks and of its indented blocks."""
    for token in tokens(page):
        if token.type == 'code_block' or (token.type == 'fence' and token.info == 'sh'):
            yield from token.content.replace('\\\n', ' ').splitlines()


def commands(line):
    """Words of each command of a line, without redirections and environment variables."""
    words = []
    line = re.sub(r'>\s*\S+', '', line)
    for word in [*shlex.split(line, comments=True), '&&']:
        if word in ('&&', '&', '|'):
            yield words
            words = []
        elif words or '=' not in word:  # not an environment variable
            words.append(word)


@each_page([page for page in PAGES if any(lines(page))])
def test_commands_of_a_page_exist_with_their_options(page):
    for line in lines(page):
        for words in commands(line):
            if words:
                check(words)


def check(words):
    """Check that a command exists, that its options parse, and that its parameters are known."""
    match [words[0].rpartition('/')[2], *words[1:]]:
        case ['make', *rest]:
            for word in rest:
                name, is_variable, _ = word.partition('=')
                wanted = re.escape(f'$({name})') if is_variable else f'^{name}:'
                assert re.search(wanted, MAKEFILE, re.MULTILINE), words
        case ['blf_dsc', *rest] | ['python', '-m', 'blf_dsc_controller', *rest]:
            parse([word for word in rest if word[0] != '['])
        case ['python', '-m', module, *rest]:
            check_module(module, rest)
        case ['python', file, *rest]:
            assert (ROOT / file).is_file()
            check_parameters(rest)
        case ['ros2', *rest]:
            check_ros2(rest)
        case ['pip', *rest]:
            extras = re.findall(r'blf_dsc_controller\[(.+?)\]', ' '.join(rest))
            assert all(
                f'\n{name} =\n' in SETUP for name in ','.join(extras).split(',') if name
            )
        case [program, *rest] if f'\n    {program} = ' in SETUP:  # a node
            check_parameters(rest)
        case [program, *_]:
            assert program in FOREIGN.split(), words


def check_module(module, words):
    """Check that a module exists, or a table of the project with its options."""
    assert importlib.util.find_spec(module), module
    if module == 'benchmark' and words:
        name, *given = (word for word in words if word[0] != '[')
        assert name in TABLES, name
        with contextlib.suppress(ImportError):  # of what it compares with
            if given:  # a sentence may name it alone
                parsed(table_parser(name), given)


def check_ros2(rest):
    match rest:
        case ['run', 'blf_dsc_controller', *own]:
            check(own)
        case ['launch', 'blf_dsc_controller', file, *arguments]:
            assert (ROOT / 'launch' / file).is_file()
            assert all(f"'{each.split(':=')[0]}'" in LAUNCH for each in arguments), rest
        case ['param', 'set', _, name, _]:
            assert name in known_names(), name


def parse(words):
    parsed(make_parser(), words)


def parsed(parser, words):
    try:
        parser.parse_args(words)
    except SystemExit as error:
        if error.code:
            pytest.fail(f'{shlex.join(words)}: {error}')  # argparse has printed why


def check_parameters(rest):
    for previous, word in pairwise(['', *rest]):
        assert previous != '-p' or word.split(':=')[0] in known_names(), word


@each_page(PAGES)
def test_inline_commands_of_a_page_exist(page):
    """Subcommands with their options, and make targets, in `code` within a sentence."""
    begin = r'(?:blf_dsc|make|(?:\S*/)?python)'
    for code in re.findall(rf'(?<!`)`({begin} [^`]+)`', page.read_text()):
        program, first, *rest = shlex.split(code)
        if program == 'make':
            check([program, first])
        elif program.endswith('python'):
            check([program, first, *rest])
        elif first.islower() and first[0] != '-':
            options = subcommand(first)._option_string_actions
            assert {word for word in rest if word.startswith('--')} <= set(options), (
                code
            )


def subcommand(name):
    for action in make_parser()._actions:
        if isinstance(action, argparse._SubParsersAction):
            return action.choices[name]
    raise AssertionError


@pytest.fixture(scope='module')
def site(tmp_path_factory):
    """Every page of the site by its name, built as by `make docs`, which fails at a dead link."""
    out = tmp_path_factory.mktemp('site')
    sphinx = [
        sys.executable,
        '-m',
        'sphinx',
        '-q',
        '-W',
        '--keep-going',
        '-n',
        str(DOC),
        str(out),
    ]
    built = subprocess.run(sphinx, check=False, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    return {path: path.read_text() for path in out.rglob('*.html')}


@pytest.mark.nightly
def test_site_has_every_page_and_loads_no_external_resources(site):
    names = {path.stem for path in site}
    assert {
        path.stem for path in DOC.iterdir() if path.suffix in ('.md', '.rst')
    } <= names
    for path, text in site.items():
        for url in re.findall(r'<(?!a )[^>]* (?:src|href)="([^"]*)"', text):
            assert not urlsplit(url).netloc, (path.name, url)
            assert (
                url.startswith(('#', 'data:'))
                or (path.parent / urlsplit(url).path).exists()
            )
    (folder,) = {path.parent for path in site if path.name == 'index.html'}
    for sheet in folder.rglob('*.css'):
        assert not re.search(
            r'(url\(|@import)\s*["\']?(https?:)?//', sheet.read_text()
        ), sheet


@pytest.mark.nightly
@pytest.mark.parametrize('name', OUTSIDE)
def test_links_outside_the_site_are_valid(name, site):
    page = ROOT / name
    anchors = {
        path.stem: re.findall(r' id="([^"]*)"', text) for path, text in site.items()
    }
    for link in re.findall(r'\]\(([^)\s]+)\)', page.read_text()):
        url = urlsplit(link)
        if not url.scheme:
            target = page.parent / url.path
            assert target.exists(), link
            assert not url.fragment or url.fragment in anchors[target.stem], link
