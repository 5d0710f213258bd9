# SPDX-License-Identifier: Apache-2.0
"""The driver that a configuration names: one of this package, or a Python file."""

from __future__ import annotations

import importlib.util
from pathlib import Path

from blf_dsc_controller.drive.driver import Driver
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.extras import import_extra


def find_driver(name: str) -> type[Driver]:
    """Return the class of a driver by the parameter `driver`.

    Raises:
        BlfDscError: there is none of this name, or its file defines none.
        MissingExtraError: what it needs is not installed.
    """
    if name.endswith('.py'):
        return _load(Path(name).expanduser())
    if name == 'franka':
        import_extra('pylibfranka', 'franka', 'the driver franka')
        from blf_dsc_controller.drive.franka import FrankaDriver

        return FrankaDriver
    if name == 'damiao':
        import_extra('can', 'damiao', 'the driver damiao')
        from blf_dsc_controller.drive.damiao import DamiaoDriver

        return DamiaoDriver
    raise BlfDscError(
        f'drive: driver: got {name!r}, but expected franka, damiao, or a Python file (.py)'
    )


def _load(path: Path) -> type[Driver]:
    """Return `DRIVER` of a Python file."""
    if not path.is_file():
        raise BlfDscError(f'drive: driver: there is no file {path.absolute()}')
    spec = importlib.util.spec_from_file_location(f'driver_{path.stem}', path)
    if spec is None or spec.loader is None:
        raise BlfDscError(f'drive: driver: {path} is not a Python file')
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise BlfDscError(f'{path} cannot be imported: {error!r}') from error
    found = getattr(module, 'DRIVER', None)
    if not (isinstance(found, type) and issubclass(found, Driver)):
        raise BlfDscError(
            f'{path}: expected a class DRIVER, a subclass of '
            'blf_dsc_controller.drive.driver.Driver'
        )
    return found
