# SPDX-License-Identifier: Apache-2.0
"""Files that are written whole, or not at all."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from blf_dsc_controller.errors import BlfDscError


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Name a file or folder that cannot be written, and leave no part of it.

    Raises:
        OSError: it cannot be opened or made.
        BlfDscError: an OSError while it is written, such as that of a full disk.
    """
    try:
        yield
    except OSError as error:
        if error.filename is not None:  # not opened, and named: what is there stays
            raise
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
        raise BlfDscError(
            f'{path} cannot be written: {error.strerror or error}; nothing of it is left'
        ) from error


def write_text(path: Path, text: str) -> None:
    """Write a text in UTF-8.

    Raises:
        OSError: it cannot be opened.
        BlfDscError: it cannot be written; no part of it is left.
    """
    with writing(path):
        path.write_text(text, encoding='utf-8')
