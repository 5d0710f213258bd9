# SPDX-License-Identifier: Apache-2.0
"""Packages of the optional extras: their import, and how to install them."""

from __future__ import annotations

import importlib
import shlex
from pathlib import Path
from typing import Any

from blf_dsc_controller.errors import BlfDscError, MissingExtraError

_SOURCES = Path(__file__).resolve().parents[1]
# pyarrow does not declare which numpy it needs.
_REMEDY = {'pyarrow': "with a numpy before 2: pip install 'pyarrow<26'"}


def install_command(extra: str) -> str:
    """Return the command that installs an extra.

    It names the checkout that this package runs from.

    pip finds a package that is installed otherwise by its name.
    """
    is_checkout = (_SOURCES / 'setup.cfg').is_file()
    package = _SOURCES if is_checkout else 'blf_dsc_controller'
    return f'pip install {shlex.quote(f"{package}[{extra}]")}'


def missing_extra(module: str, extra: str, purpose: str) -> MissingExtraError:
    """Return the error that says what needs a module, and how to install it."""
    return MissingExtraError(
        f'{purpose} needs {module}, which is not installed: {install_command(extra)}'
    )


def import_extra(module: str, extra: str, purpose: str) -> Any:
    """Import a module of an extra for a purpose, which begins the message.

    Raises:
        MissingExtraError: the module is not installed.
        BlfDscError: it is installed, but cannot be loaded.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError:
        raise missing_extra(module, extra, purpose) from None
    except ImportError as error:
        package = module.partition('.')[0]
        remedy = _REMEDY.get(package, 'install a release that fits the others')
        raise BlfDscError(
            f'{purpose} needs {module}, which is installed, but cannot be loaded '
            f'({error}); {remedy}'
        ) from error
