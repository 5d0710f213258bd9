# SPDX-License-Identifier: Apache-2.0
"""Files that are written whole, or not at all."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from blf_dsc_controller.errors import BlfDscError

PART = '.unfinished'
"""Suffix of what is not whole yet; only what is killed leaves it."""


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """Yield a place for a file or folder, which is moved to `path` once it is whole.

    Whatever ends it before, such as Ctrl-C, leaves what was there. A folder, which a file
    cannot replace, or a device is yielded itself.

    Raises:
        OSError: it cannot be made, opened, written or moved.
    """
    if path.exists() and not path.is_file():
        yield path
        return
    part = path.with_name(f'{path.name}{PART}')
    remove(part)  # of one that was killed
    try:
        yield part
        part.replace(path)
    except BaseException as error:
        remove(part)
        if isinstance(error, OSError) and error.filename == str(part):
            error.filename = str(path)
        raise


def try_out(path: Path) -> None:
    """Raise OSError, which names `path`, if `whole` could not make a file there."""
    if path.exists() and not path.is_file():
        return
    part = path.with_name(f'{path.name}{PART}')
    try:
        part.touch()
    except OSError as error:
        error.filename = str(path)
        raise
    finally:  # also if it is interrupted
        with suppress(OSError):
            remove(part)


def remove(path: Path) -> None:
    """Remove a file or folder, if there is one and as far as it can be removed."""
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


@contextmanager
def writing(path: Path) -> Iterator[Path]:
    """Yield a place as `whole` does, and say which file or folder cannot be written.

    Raises:
        OSError: it cannot be opened or made.
        BlfDscError: an OSError while it is written, such as that of a full disk.
    """
    try:
        with whole(path) as part:
            yield part
    except OSError as error:
        if error.filename is not None:  # not opened, and named
            raise
        raise BlfDscError(
            f'{path} cannot be written: {error.strerror or error}; nothing of it is left'
        ) from error


def write_text(path: Path, text: str) -> None:
    """Write a text in UTF-8.

    Raises:
        OSError: it cannot be opened.
        BlfDscError: it cannot be written; no part of it is left.
    """
    with writing(path) as part:
        part.write_text(text, encoding='utf-8')
