# SPDX-License-Identifier: Apache-2.0
"""The folder of a command's results: always a new one, and none of a run that never began."""

from __future__ import annotations

import shutil
from pathlib import Path

from blf_dsc_controller.errors import BlfDscError

_BAG = 'bag'
_ANY = '*'
_made: list[tuple[Path, str]] = []  # and the result in it


def make_folder(path: Path) -> Path:
    """Create a folder, which `discard_unrecorded` may remove again while it is empty.

    Raises BlfDscError if it exists already.
    """
    return _make(path, _ANY)


def make_run_folder(path: Path) -> Path:
    """Create the folder of a run, which `discard_unrecorded` may remove again."""
    return _make(path, _BAG)


def _make(path: Path, result: str) -> Path:
    refuse_existing(path)
    _made.append((path, result))
    path.mkdir(parents=True)
    return path


def refuse_existing(path: Path) -> None:
    """Raise BlfDscError if something exists there."""
    if path.exists():
        raise BlfDscError(
            f'{path} exists already and is not overwritten: choose another --out'
        )


def discard_unrecorded() -> list[Path]:
    """Remove this process's folders that are empty, or of a run without a bag; return them.

    It is for an interrupt: the same command can then be given again. After an error
    they stay, since their logs say why.
    """
    discarded = [
        folder
        for folder, result in _made
        if folder.is_dir() and not any(folder.glob(result))
    ]
    for folder in discarded:
        shutil.rmtree(folder)
    _made.clear()
    return discarded
