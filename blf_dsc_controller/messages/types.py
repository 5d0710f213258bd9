# SPDX-License-Identifier: Apache-2.0
"""Definitions of the message types of ROS 2 Jazzy, known without a ROS installation."""

from __future__ import annotations

import functools

from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from blf_dsc_controller.messages.errors import UnknownTypeError


@functools.cache
def typestore() -> Typestore:
    """Types of Jazzy's common interfaces; types registered in it are known from then on."""
    return get_typestore(Stores.ROS2_JAZZY)


def definition(type_name: str) -> str:
    """Text of a message type followed by those of all types nested in it.

    Raises:
        UnknownTypeError: the type is not in the store.
    """
    _require(type_name)
    text, _md5 = typestore().generate_msgdef(type_name, ros_version=2)
    return text


def type_hash(type_name: str) -> str:
    """Hash of a message type (RIHS01_...), as ROS 2 computes it.

    Raises:
        UnknownTypeError: the type is not in the store.
    """
    _require(type_name)
    return typestore().hash_rihs01(type_name)


def _require(type_name: str) -> None:
    if type_name not in typestore().fielddefs:
        raise UnknownTypeError(type_name)
