# SPDX-License-Identifier: Apache-2.0
"""Protection of existing files against being overwritten by accident."""

from __future__ import annotations

import os
from pathlib import Path

from blf_dsc_controller.errors import BlfDscError


def make_room(*paths: Path, force: bool) -> None:
    """Prepare `paths` for writing; a symbolic link is replaced instead of followed.

    Raises BlfDscError if one of them exists, unless `force` is set.
    """
    existing = [path for path in paths if os.path.lexists(path)]
    if existing and not force:
        names = ', '.join(str(path) for path in existing)
        exist = 'exists' if len(existing) == 1 else 'exist'
        raise BlfDscError(f'{names} {exist} already: choose another path, or use --force')
    for path in existing:
        if path.is_symlink():
            path.unlink()
