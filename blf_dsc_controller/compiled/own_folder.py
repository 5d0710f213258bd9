# SPDX-License-Identifier: Apache-2.0
"""Folders that only this user can enter, whatever the umask: for code that runs.

Cached machine code is a pickle. Whoever can write one lets its reader run anything.
"""

from __future__ import annotations

import os
import shutil
import stat
import tempfile
from contextlib import suppress
from pathlib import Path

_OTHERS = stat.S_IRWXG | stat.S_IRWXO


def is_own(folder: Path) -> bool:
    """Whether it is a folder of this user, and nobody else can enter it."""
    try:
        found = folder.lstat()
    except OSError:
        return False
    is_folder = stat.S_ISDIR(found.st_mode)
    return is_folder and found.st_uid == os.getuid() and not found.st_mode & _OTHERS


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
