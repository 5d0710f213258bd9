# SPDX-License-Identifier: Apache-2.0
"""Compilation of the numerical kernels, with a cache that knows what it depends on.

Numba keys a cached function by the contents of its own file, not by those of the functions it
calls in other files, so an edit there would leave stale machine code behind. Here the cache folder
is named after a digest of every source file of both packages' ground floor: any change of any
kernel compiles afresh, and a reinstall of the same version finds its old cache again.

Where nothing can be written below the home folder, the cache is in the folder for temporary files.
"""

from __future__ import annotations

import functools
import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar, cast

import numba
from numba.core import config
from numba.extending import register_jitable

F = TypeVar('F', bound=Callable[..., object])

INLINED = {'error_model': 'numpy', 'forceinline': True, 'no_cfunc_wrapper': True}
"""Compiler options of functions that are compiled into kernels."""

_PACKAGE_ROOT = Path(__file__).resolve().parents[2]
_GROUND_FLOOR = (
    'blf_dsc_controller/compiled/*.py',
    'blf_dsc_controller/arms/*.py',
    'blf_dsc_controller/law/*.py',
    'blf_dsc_controller/reference/*.py',
    'blf_dsc_controller/supervision/checks.py',
    'blf_dsc_controller/simulation/*.py',
    'sim_plant/*.py',
)
_ABOVE = {
    'approach.py',
    'command_input.py',
    'exciting_reference.py',
    'factory.py',
    'handshake.py',
    'node.py',
    'plant.py',
    'status.py',
}


def ground_floor_sources() -> list[Path]:
    """Every source file a kernel can live in."""
    found = (path for pattern in _GROUND_FLOOR for path in _PACKAGE_ROOT.glob(pattern))
    return sorted(path for path in found if path.name not in _ABOVE)


@functools.cache
def cache_folder() -> Path:
    """Folder of this version's machine code, below NUMBA_CACHE_DIR or else the user's cache."""
    digest = hashlib.sha256(numba.__version__.encode())
    for source in ground_floor_sources():
        digest.update(source.read_bytes())
    chosen = os.environ.get('NUMBA_CACHE_DIR')
    return (Path(chosen) if chosen else _base()) / digest.hexdigest()[:16]


def _base() -> Path:
    try:
        users = Path(os.environ.get('XDG_CACHE_HOME') or '~/.cache').expanduser()
        return _writable(users / 'blf_dsc_controller')
    except (OSError, RuntimeError):  # read-only, full, or no home at all
        pass
    try:
        return _writable(Path(tempfile.gettempdir(), f'blf_dsc_controller-{os.getuid()}'))
    except OSError:  # another user's
        return Path(tempfile.mkdtemp(prefix='blf_dsc_controller-'))


def _writable(folder: Path) -> Path:
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if folder.stat().st_uid != os.getuid():
        raise PermissionError
    with tempfile.TemporaryFile(dir=folder):
        return folder


def is_compiled(*functions: Callable[..., object]) -> bool:
    """Whether the machine code of all these kernels is in the cache already."""
    return bool(config.DISABLE_JIT) or all(
        any(cache_folder().glob(f'*/{_file_stem(function)}-*.nbi')) for function in functions
    )


def _file_stem(function: Callable[..., object]) -> str:
    return f'{function.__module__.rpartition(".")[2]}.{function.__name__}'


def inner(function: F) -> F:
    """Let kernels call `function`, which is compiled into them; in Python it stays what it is."""
    register_jitable(**INLINED)(function)
    return function


def kernel(function: F) -> F:
    """Compile `function`, which Python calls: IEEE arithmetic (no fast-math), cached."""
    before = config.CACHE_DIR
    config.CACHE_DIR = str(cache_folder())
    try:
        compiled = numba.njit(
            function, cache=True, error_model='numpy', nogil=True, no_cfunc_wrapper=True
        )
        return cast('F', compiled)
    finally:
        config.CACHE_DIR = before
