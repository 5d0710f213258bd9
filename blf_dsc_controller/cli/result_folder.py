# SPDX-License-Identifier: Apache-2.0
"""The folder of a command's results: always a new one, and removed if the run never began.

A command names the folder, and the file that is in it once the run has begun. Until then,
`discard_unbegun` removes the folder, so the same command can be given again.
"""

from __future__ import annotations

import shutil
from contextlib import suppress
from pathlib import Path

from blf_dsc_controller.errors import BlfDscError

BAG = 'bag'
"""What is in the folder of `blf_dsc run` once its run has begun."""

_ANY = '*'
_unbegun: dict[Path, str | None] = {}
"""Folders, and what is in them once their run has begun; None: only `keep` says that it has."""


def make_folder(path: Path, result: str = _ANY) -> Path:
    """Create a folder, whose run has begun once `result` is in it.

    Raises BlfDscError if it exists already.
    """
    refuse_existing(path)
    _unbegun[path] = result  # first: an interrupt may follow
    try:
        path.mkdir(parents=True)
    except FileExistsError:
        del _unbegun[path]  # another command has just made it
        refuse_existing(path)
        raise  # a link to nothing
    return path


def expect_folder(path: Path | None) -> None:
    """Remember a folder that something else makes, whose run begins when `keep` is called.

    A folder that exists already is left alone. None: there is no folder.
    """
    if path is not None and not path.exists():
        _unbegun[path] = None


def keep(path: Path | None) -> None:
    """Never remove this folder: its run has begun, or it is another command's."""
    if path is not None:
        _unbegun.pop(path, None)


def refuse_existing(path: Path) -> None:
    """Raise BlfDscError if something exists there."""
    if path.exists():
        raise BlfDscError(
            f'{path} exists already and is not overwritten: choose another --out'
        )


def discard_unbegun() -> list[Path]:
    """Remove this process's folders whose run has not begun; return them.

    After an error `discard_empty` leaves those with logs in them, which say why.
    """
    discarded = [
        folder
        for folder, result in _unbegun.items()
        if folder.is_dir() and (result is None or not any(folder.glob(result)))
    ]
    for folder in discarded:
        shutil.rmtree(folder, ignore_errors=True)
    _unbegun.clear()
    return discarded


def discard_empty() -> None:
    """Remove this process's folders in which nothing was written, as on a full disk."""
    for folder in _unbegun:
        with suppress(OSError):  # there is none, or something is in it
            folder.rmdir()
