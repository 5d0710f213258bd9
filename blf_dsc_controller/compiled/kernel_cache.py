# SPDX-License-Identifier: Apache-2.0
"""Machine code of kernels on disk: one folder for each content of the sources.

The folder of a kernel is named after a digest of every source file it is compiled from
and of the constants it uses, and of nothing else: an edit recompiles what depends on
it, and a reinstall or a second checkout finds the existing cache.

The package's own folder `SHIPPED` is looked at first, and never written to when kernels
run.  If the user's cache folder is not writable, the cache is in the folder for
temporary files.  Machine code is loaded only from a folder of this user that nobody
else can enter, whatever the umask; what comes with the package is as safe as its code.
"""

from __future__ import annotations

import functools
import hashlib
import os
import shutil
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numba
from numba.core import config

from blf_dsc_controller.compiled.dependencies import PACKAGE, dependencies
from blf_dsc_controller.compiled.own_folder import is_of_user, make_own, user

try:
    from blf_dsc_controller.compiled.linked import KernelCache
except ImportError:  # it uses parts of numba that other releases may lack: see there
    _CACHE: Any = None
else:
    _CACHE = KernelCache

KERNELS: list[Any] = []
"""All kernels that have been imported."""

SHIPPED = Path(__file__).with_name('kernels')
"""Folder of kernels that come with the package: see `ship`."""


def is_quick() -> bool:
    """Whether kernels are linked into one another: see `linked`."""
    return _CACHE is not None


def place() -> Path:
    """Return the folder of all machine code: NUMBA_CACHE_DIR, or else the user's cache."""
    return _base(os.environ.get('NUMBA_CACHE_DIR'))


def add_kernel(kernel: Any, *types: type) -> None:
    """Keep the machine code of a kernel, which is compiled with these types, in its folder."""
    KERNELS.append(kernel)
    if not config.DISABLE_JIT:
        _keep(kernel, cache_folder(kernel.py_func, *types))


def cache_folder(function: Callable[..., object], *types: type) -> Path:
    """Return the folder of a kernel's machine code, in `place`."""
    files, constants = dependencies(function, *types)
    digest = hashlib.sha256(' '.join([numba.__version__, *sorted(constants)]).encode())
    for name, source in sorted((_name(source), source) for source in files):
        digest.update(name.encode() + b'\0' + source.read_bytes())
    return place() / digest.hexdigest()[:16]


def ship() -> Path:
    """Copy the kernels in the cache into a folder of the package, and return it."""
    for each in KERNELS:
        folder = cache_folder(each)
        if folder.exists():
            shutil.copytree(
                folder,
                SHIPPED / folder.name,
                ignore=shutil.ignore_patterns('*.lock'),
                copy_function=_copy,
                dirs_exist_ok=True,
            )
    SHIPPED.mkdir(exist_ok=True)
    for path in (SHIPPED, *SHIPPED.rglob('*')):  # for all to read, whatever the umask
        path.chmod(0o755 if path.is_dir() else 0o644)
    return SHIPPED


def _copy(source: str, target: str) -> None:
    """Copy a file, whole or not at all."""
    part = Path(f'{target}.unfinished')
    try:
        shutil.copy2(source, part)
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)


def _keep(kernel: Any, folder: Path) -> None:
    """Cache the machine code of a kernel in a folder that no other source shares.

    Within it, numba tells signatures, processors and Python versions apart.
    """
    if _CACHE is not None:
        cache = _CACHE(kernel.py_func, folder, SHIPPED / folder.name)
        kernel._cache = cache  # noqa: SLF001 - as numba's enable_caching
        return
    if not make_own(folder):
        return
    before = config.CACHE_DIR
    # of a further folder in it, for the place of the source
    config.CACHE_DIR = str(folder)
    try:
        kernel.enable_caching()
    finally:
        config.CACHE_DIR = before


@functools.cache
def _base(chosen: str | None) -> Path:
    """Return the first folder for machine code that can be written, if need be a temporary one."""
    users = Path(os.environ.get('XDG_CACHE_HOME') or '~/.cache', 'blf_dsc_controller')
    inside = f'blf_dsc_controller-{user()}'  # of a folder for everybody
    folders = [users, Path(tempfile.gettempdir(), inside)]
    if chosen:
        folders[:0] = [Path(chosen), Path(chosen, inside)]
    for folder in folders:
        with suppress(OSError, RuntimeError):  # read-only, full, or no home at all
            place: Path = folder.expanduser()
            place.mkdir(mode=0o700, parents=True, exist_ok=True)
            if _is_private(place):
                with tempfile.TemporaryFile(dir=place):
                    return place
    return Path(tempfile.mkdtemp(prefix='blf_dsc_controller-'))


def _is_private(folder: Path) -> bool:
    """Whether this user owns a folder, and nobody else can write it."""
    return is_of_user(folder.stat())


def _name(source: Path) -> str:
    """Return the place of a file in the packages, which cached types refer to."""
    inside = source.is_relative_to(PACKAGE.parent)
    return str(source.relative_to(PACKAGE.parent)) if inside else source.name
