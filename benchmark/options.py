# SPDX-License-Identifier: Apache-2.0
"""Options that several tables have."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path


def positive(text: str) -> int:
    """Return the integer above 0 of a word."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f'{text} is not above 0')
    return value


def add_out(parser: argparse.ArgumentParser, folder: str) -> None:
    """Add the option `out`: a new folder."""
    about = f'new folder for the figures ({folder})'
    parser.add_argument('--out', type=Path, default=Path(folder), help=about)


def add_configs(parser: argparse.ArgumentParser, *presets: str) -> None:
    """Add the option `config`: arms by their presets or files."""
    about = f'presets or files ({" ".join(presets)})'
    parser.add_argument('--config', nargs='+', default=list(presets), help=about)


def add_runs(parser: argparse.ArgumentParser, count: int, what: str) -> None:
    """Add the option `runs`: how many."""
    about = f'{what} ({count})'
    parser.add_argument('--runs', type=positive, default=count, help=about)


def add_arms(
    parser: argparse.ArgumentParser, arms: Sequence[str], runs: int, what: str
) -> None:
    """Add options of tables over `arms` in turn: `runs` in all, and `each` to print each."""
    add_runs(parser, runs, what)
    parser.add_argument('--arms', nargs='+', default=list(arms), choices=arms)
    parser.add_argument('--each', action='store_true', help='print each run, too')
