# SPDX-License-Identifier: Apache-2.0
"""Definitions of installed message types that are not among the common ones of Jazzy."""

from __future__ import annotations

import sysconfig
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from ament_index_python.packages import get_package_share_directory
from rosbags.interfaces import Nodetype
from rosbags.typesys import get_types_from_msg

from blf_dsc_controller.messages.errors import UnknownTypeError
from blf_dsc_controller.messages.types import typestore


def learn(type_name: str) -> None:
    """Read a type, and those nested in it, from the .msg files of its package.

    Raises:
        UnknownTypeError: there is no such file, or a nested type is not to be found.
    """
    if type_name in typestore().fielddefs:
        return
    package, kind, name = type_name.split('/')
    path = _share(package) / kind / f'{name}.msg'
    try:
        text = path.read_text(encoding='utf-8')
    except OSError:
        raise UnknownTypeError(type_name) from None
    found = get_types_from_msg(text, type_name)
    for nested in _nested(found[type_name][1]):
        learn(nested)
    typestore().register(found)


def _share(package: str) -> Path:
    try:
        return Path(get_package_share_directory(package))
    except (LookupError, OSError):  # a pip install sets no AMENT_PREFIX_PATH
        return Path(sysconfig.get_path('data'), 'share', package)


def _nested(fields: Iterable[tuple[str, Any]]) -> Iterator[str]:
    for _, (node, content) in fields:
        if node is Nodetype.NAME:
            yield content
        elif node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            yield from _nested([('', content[0])])
