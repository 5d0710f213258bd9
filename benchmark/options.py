# SPDX-License-Identifier: Apache-2.0
"""Options that several tables have."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_out(parser: argparse.ArgumentParser, folder: str) -> None:
    """Add the option `out`: a new folder."""
    about = f'new folder for the figures ({folder})'
    parser.add_argument('--out', type=Path, default=Path(folder), help=about)


def add_configs(parser: argparse.ArgumentParser, *presets: str) -> None:
    """Add the option `config`: arms by their presets or files."""
    about = f'presets or files ({" ".join(presets)})'
    parser.add_argument('--config', nargs='+', default=list(presets), help=about)
