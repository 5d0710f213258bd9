# SPDX-License-Identifier: Apache-2.0
"""Randomly changing arms, each with and without learning: 14,000 in five studies.

    python -m benchmark changes --out out/changes

The same command goes on after an interruption, as `blf_dsc monte-carlo` does, which runs
the studies.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from benchmark.studies import path_of
from blf_dsc_controller.cli.studies import monte_carlo

STUDIES = ('events', 'panda', 'panda_500hz', 'ur5e', 'ur5e_500hz')


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    about = 'folder with a folder of each study (changes)'
    parser.add_argument('--out', type=Path, default=Path('changes'), help=about)
    parser.add_argument(
        '--runs', type=int, help='runs of each study (as its file says)'
    )
    parser.add_argument('--workers', type=int, help='processes (one per core)')


def main(options: argparse.Namespace) -> None:
    """Run the studies, and put them side by side in changes.md and changes.png."""
    given = {**vars(options), 'dask': None, 'reproduce': None, 'report': None}
    folders = [options.out / name for name in STUDIES]
    for name, folder in zip(STUDIES, folders, strict=True):
        study = {'config': path_of(f'monte_carlo_{name}'), 'out': folder}
        monte_carlo(argparse.Namespace(**given | study))
    monte_carlo(argparse.Namespace(**given | {'report': folders}))
