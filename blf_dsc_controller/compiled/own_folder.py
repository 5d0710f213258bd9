# SPDX-License-Identifier: Apache-2.0
"""Folders that only this user can enter, whatever the umask: for code that runs.

Cached machine code is a pickle. Whoever can write one lets its reader run anything.
"""

from __future__ import annotations

import os
import shutil
import stat
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

_OTHERS = stat.S_IRWXG | stat.S_IRWXO
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


def user() -> int | None:
    """Return the number of this user; None where the system has none, such as Windows.

    There, folders of the user's profile are closed to others by the system.
    """
    number: Callable[[], int] | None = getattr(os, 'getuid', None)
    return None if number is None else number()


def is_of_user(found: os.stat_result, closed: int = _OTHERS_WRITE) -> bool:
    """Whether something is this user's, and has none of these rights, by default to write."""
    own = user()
    return own is None or (found.st_uid == own and not found.st_mode & closed)


def is_own(folder: Path) -> bool:
    """Whether it is a folder of this user, and nobody else can enter it."""
    try:
        found = folder.lstat()
    except OSError:
        return False
    return stat.S_ISDIR(found.st_mode) and is_of_user(found, _OTHERS)


def make_own(folder: Path) -> bool:
    """Make such a folder, empty if it was there and others could enter it.

    Return False if that is not possible: it is another user's, or read-only.
    """
    with suppress(OSError):
        if os.path.lexists(folder) and not is_own(folder):
            aside = Path(tempfile.mkdtemp(dir=folder.parent))
            folder.rename(aside / folder.name)
            shutil.rmtree(aside, ignore_errors=True)
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    return is_own(folder)
