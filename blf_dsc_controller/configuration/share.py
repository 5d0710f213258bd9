# SPDX-License-Identifier: Apache-2.0
"""Where the files that come with the package are: presets (config/) and launch files (launch/).

The answer never depends on the current folder: a preset's name means the same wherever a command
is started.
"""

from __future__ import annotations

import sysconfig
from pathlib import Path
from typing import TYPE_CHECKING

from blf_dsc_controller.errors import BlfDscError

if TYPE_CHECKING:
    from collections.abc import Iterator

PACKAGE = 'blf_dsc_controller'

_CHECKOUT = Path(__file__).resolve().parents[2]
_PRESETS = 'config'


def share_folder() -> Path:
    """Locate the folder that holds `config/` and `launch/`.

    The source tree comes first if the code itself runs from one: an editable install leaves these
    files there, and another folder would belong to another version. Then what ROS's ament index
    knows (colcon), then the data folder of this Python's packages (pip).

    Raises BlfDscError, naming the places looked at, when it is in none of them.
    """
    searched = []
    for folder in _candidates():
        if (folder / _PRESETS).is_dir():
            return folder
        searched.append(f'\n  - {folder / _PRESETS}')
    raise BlfDscError(
        f'the files that come with {PACKAGE} were not found: install the package again. '
        f'Looked at:{"".join(searched)}'
    )


def config_file(name: str) -> Path:
    """Locate a file in `config/` by its name or, a preset, by its name without `.yaml`.

    An empty name gives the folder itself. Raises BlfDscError, with the presets there are, when
    there is no such file.
    """
    folder = share_folder() / _PRESETS
    for path in (folder / f'{name}.yaml', folder / name):
        if path.exists():
            return path
    presets = ', '.join(sorted(path.stem for path in folder.glob('*.yaml'))) or 'none'
    raise BlfDscError(f'there is no preset {name!r} in {folder}; the presets are: {presets}')


def _candidates() -> Iterator[Path]:
    if (_CHECKOUT / 'setup.py').is_file():
        yield _CHECKOUT
    yield from _ament_index()
    for scheme in (sysconfig.get_default_scheme(), sysconfig.get_preferred_scheme('user')):
        yield Path(sysconfig.get_path('data', scheme), 'share', PACKAGE)


def _ament_index() -> Iterator[Path]:
    try:
        from ament_index_python.packages import get_package_share_directory
    except ImportError:
        return
    try:
        yield Path(get_package_share_directory(PACKAGE))
    except (LookupError, OSError):  # not in the index; no AMENT_PREFIX_PATH, hence no index
        return
