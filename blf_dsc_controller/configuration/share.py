# SPDX-License-Identifier: Apache-2.0
"""Data files of this package and of others, with or without a sourced ROS."""

from __future__ import annotations

import stat
import sysconfig
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from blf_dsc_controller.errors import BlfDscError

if TYPE_CHECKING:
    from collections.abc import Iterator

_PACKAGE = 'blf_dsc_controller'
_CHECKOUT = Path(__file__).resolve().parents[2]
_LARGEST = 1 << 24  # bytes of a parameter file, a URDF or a metadata.yaml


def share_folder() -> Path:
    """Return the folder that holds `config/` and `launch/`, regardless of the current folder.

    If the code runs from a source tree, as in an editable install, that comes first; then the ament
    index (colcon), then the data folders of this Python (pip).

    Raises BlfDscError, listing the places searched, if the folder is not found.
    """
    searched = []
    for folder in _candidates():
        if (folder / 'config').is_dir():
            return folder
        searched.append(f'\n  - {folder / "config"}')
    raise BlfDscError(
        f'the data files of {_PACKAGE} were not found: install the package again. '
        f'Searched:{"".join(searched)}'
    )


def resolve(url: str) -> Path:
    """Return the path of a file, or of a resource as `package://name/path`.

    A path that does not exist is looked up in `config/` of this package. Raises BlfDscError if
    there is no such folder or package.
    """
    if url.startswith('package://'):
        name, _, rest = url.removeprefix('package://').partition('/')
        return _share_of(name) / rest
    path = Path(url).expanduser()
    own = share_folder() / 'config' / url
    if path.is_file() or not own.is_file():
        return path
    return own


def read_text(path: Path) -> str:
    """Return the text of a file; OSError if not regular or too large, or UnicodeDecodeError."""
    state = path.stat()
    if not stat.S_ISREG(state.st_mode):
        raise OSError(f'{path} is not a regular file: give a file')
    if state.st_size > _LARGEST:
        raise OSError(f'{path} has {state.st_size} bytes; expected text of at most {_LARGEST}')
    return path.read_text(encoding='utf-8')


def _share_of(package: str) -> Path:
    if package == _PACKAGE:
        return share_folder()
    try:
        from ament_index_python.packages import get_package_share_directory

        return Path(get_package_share_directory(package))
    except (ImportError, LookupError, OSError) as error:
        raise BlfDscError(
            f'package {package!r} was not found: source the workspace that has it, or give a path'
        ) from error


def _candidates() -> Iterator[Path]:
    if (_CHECKOUT / 'setup.py').is_file():
        yield _CHECKOUT
    with suppress(ImportError, LookupError, OSError):  # no ROS, no index, or package not in it
        from ament_index_python.packages import get_package_share_directory

        yield Path(get_package_share_directory(_PACKAGE))
    for scheme in (sysconfig.get_default_scheme(), sysconfig.get_preferred_scheme('user')):
        yield Path(sysconfig.get_path('data', scheme), 'share', _PACKAGE)
