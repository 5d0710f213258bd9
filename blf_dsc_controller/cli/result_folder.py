# SPDX-License-Identifier: Apache-2.0
"""The folder of a command's results: always a new one, and none of a run that never began."""

from __future__ import annotations

import shutil
from pathlib import Path

from blf_dsc_controller.errors import BlfDscError

_BAG = 'bag'
_made: list[Path] = []


def make_folder(path: Path) -> Path:
    """Create a folder; raises BlfDscError if it exists already."""
    refuse_existing(path)
    path.mkdir(parents=True)
    return path


def make_run_folder(path: Path) -> Path:
    """Create the folder of a run, which `discard_unrecorded` may remove again."""
    _made.append(make_folder(path))
    return path


def refuse_existing(path: Path) -> None:
    """Raise BlfDscError if something exists there."""
    if path.exists():
        raise BlfDscError(
            f'{path} exists already and is not overwritten: choose another --out'
        )


def discard_unrecorded() -> list[Path]:
    """Remove the folders of this process's runs that have no bag, and return them.

    It is for an interrupt: the same command can then be given again. After an error
    they stay, since their logs say why.
    """
    discarded = [folder for folder in _made if not (folder / _BAG).exists()]
    for folder in discarded:
        shutil.rmtree(folder)
    _made.clear()
    return discarded
