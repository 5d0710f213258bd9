# SPDX-License-Identifier: Apache-2.0
"""Where the data files of the package are: presets (`config/`) and launch files (`launch/`)."""

from __future__ import annotations

import sysconfig
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from blf_dsc_controller.errors import BlfDscError

if TYPE_CHECKING:
    from collections.abc import Iterator

PACKAGE = 'blf_dsc_controller'

_CHECKOUT = Path(__file__).resolve().parents[2]


def share_folder() -> Path:
    """Return the folder that holds `config/` and `launch/`, whatever the current folder is.

    The source tree comes first if the code runs from one: an editable install leaves the files
    there. Then the ament index (colcon), then the data folders of this Python (pip).

    Raises BlfDscError with the places searched if it is in none of them.
    """
    searched = []
    for folder in _candidates():
        if (folder / 'config').is_dir():
            return folder
        searched.append(f'\n  - {folder / "config"}')
    raise BlfDscError(
        f'the data files of {PACKAGE} were not found: install the package again. '
        f'Searched:{"".join(searched)}'
    )


def _candidates() -> Iterator[Path]:
    if (_CHECKOUT / 'setup.py').is_file():
        yield _CHECKOUT
    with suppress(ImportError, LookupError, OSError):  # no ROS, index, or package in it
        from ament_index_python.packages import get_package_share_directory

        yield Path(get_package_share_directory(PACKAGE))
    for scheme in (sysconfig.get_default_scheme(), sysconfig.get_preferred_scheme('user')):
        yield Path(sysconfig.get_path('data', scheme), 'share', PACKAGE)
