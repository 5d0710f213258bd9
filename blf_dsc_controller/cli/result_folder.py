# SPDX-License-Identifier: Apache-2.0
"""The folder of a command's results: always a new one, and none of a run that never began."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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


@contextmanager
def only_if_begun(path: Path | None) -> Iterator[Callable[[], None]]:
    """Remove the folder that is made there meanwhile, unless what this yields was called.

    Whatever ended it, an error or an interrupt, the same command can be given again.
    """
    existed = path is None or path.exists()
    begun = False

    def begin() -> None:
        nonlocal begun
        begun = True

    try:
        yield begin
    finally:
        if path is not None and not (begun or existed):
            shutil.rmtree(path, ignore_errors=True)


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
