# SPDX-License-Identifier: Apache-2.0
"""The parser of `blf_dsc`, whose errors say what to type."""

from __future__ import annotations

import argparse
import difflib
import os
import re
import textwrap
from collections.abc import Sequence
from typing import Any, NoReturn

from blf_dsc_controller import __version__
from blf_dsc_controller.cli.commands import COMMANDS, Command

_WIDTH = 88
_OTHERS = {
    'view': 'blf_dsc run --view shows a run, arm_view a running loop',
    'presets': 'blf_dsc run --config list lists them',
}
"""What is meant by words that are no command."""


class _Parser(argparse.ArgumentParser):
    """Parser whose errors are one line, with an example of what to type."""

    def __init__(self, *words: Any, **options: Any) -> None:
        super().__init__(*words, **options)
        # negative numbers, also those with an exponent, are no options
        self._negative_number_matcher = re.compile(r'-\.?\d')

    def error(self, message: str) -> NoReturn:
        """Exit with code 2."""
        help_line = f'{self.prog} --help'
        examples = (self.epilog or '').partition('Example:')[2].split('\n')[1:]
        if examples:
            help_line = f'for example: {examples[0].strip()} ({help_line})'
        else:
            help_line = f'see {help_line}'
        self.exit(2, f'{self.prog}: {message}; {help_line}\n')

    def takes(self, word: str) -> bool:
        """Whether a word is an option of this command, other than that for help."""
        return word in {*self._option_string_actions} - {'-h', '--help'}

    def refuse(self, unknown: str) -> NoReturn:
        """Exit with code 2 because of a word that this command does not take."""
        options = self._option_string_actions
        name = unknown.partition('=')[0]
        if name.startswith('-'):
            close = difflib.get_close_matches(name, options, n=1)
            guess = f', did you mean {close[0]}?' if close else ''
            self.error(f'no option {name}{guess}')
        if '--config' in options:
            self.error(f'no argument {unknown}: a file or preset is --config {unknown}')
        self.error(f'no argument {unknown}')


def parse(
    parser: argparse.ArgumentParser, words: Sequence[str], given: argparse.Namespace
) -> argparse.Namespace:
    """Add the options of a command line to those given, or exit with what is wrong."""
    options, unknown = parser.parse_known_args(words, given)
    if unknown:
        of_command = parser.get_default('commands').get(options.command, parser)
        of_command.refuse(unknown[0])
    return options


def make_parser() -> argparse.ArgumentParser:
    """Return the parser.

    The option `handler` is the (module, function) of a sub-command.
    """
    parser = _Parser(
        prog='blf_dsc',
        description='Track a trajectory within a bound, with a robot arm whose masses are '
        'unknown: run the controller, examine bags, identify arms, study laws.',
        epilog='blf_dsc COMMAND --help lists the options of a command, with an example.',
    )
    parser.add_argument(
        '--version', action='version', version=f'blf_dsc_controller {__version__}'
    )
    commands = parser.add_subparsers(
        title='commands', dest='command', metavar='COMMAND'
    )
    for each in COMMANDS:
        _add(commands, each)
    parser.set_defaults(commands=commands.choices)
    return parser


def _add(commands: argparse._SubParsersAction[_Parser], command: Command) -> None:
    """Add the parser of a command."""
    made = commands.add_parser(
        command.name,
        help=command.about.partition('. ')[0].rstrip('.'),
        description=textwrap.fill(command.about, _WIDTH),
        epilog=f'Example:\n  blf_dsc {command.name} {command.example}',
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    made.set_defaults(handler=(command.module, command.name.replace('-', '_')))
    for option in command.options:
        made.add_argument(option.name, **option.settings)


def check_command(parser: argparse.ArgumentParser, words: Sequence[str]) -> None:
    """End with a suggestion if the first word is meant for a command, but is none."""
    known = parser.get_default('commands')
    if words and words[0] in _OTHERS:
        parser.error(f'no command {words[0]}: {_OTHERS[words[0]]}')
    if words and not words[0].startswith('-') and words[0] not in known:
        close = difflib.get_close_matches(words[0], known, n=1)
        guess = f', did you mean {close[0]}?' if close else ''
        parser.error(f'no command {words[0]}{guess}; there are {", ".join(known)}')
    behind = next((word for word in words if word in known), None)
    if behind is not None and known[behind].takes(words[0]):
        parser.error(
            f'{words[0]} belongs behind the command: blf_dsc {behind} {words[0]} ...'
        )


def check_text(parser: argparse.ArgumentParser, words: Sequence[str]) -> None:
    """End with a message if a word is no text: pages and files could not name it."""
    for word in words:
        try:
            os.fsencode(word).decode()
        except UnicodeDecodeError:
            parser.error(f'{word!a} is no text in UTF-8: rename the file')
