# SPDX-License-Identifier: Apache-2.0
"""Definitions of the message types of ROS 2 Jazzy, without a ROS installation."""

from __future__ import annotations

import functools

from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from blf_dsc_controller.messages.errors import UnknownTypeError


@functools.cache
def typestore() -> Typestore:
    """Types of Jazzy's common interfaces, to which further types can be registered."""
    return get_typestore(Stores.ROS2_JAZZY)


def definition(type_name: str) -> tuple[str, str]:
    """Text of a message type with those of all nested types, and its hash (RIHS01_...).

    Raises:
        UnknownTypeError: the type is not in the store.
    """
    if type_name not in typestore().fielddefs:
        raise UnknownTypeError(type_name)
    text, _md5 = typestore().generate_msgdef(type_name, ros_version=2)
    return text, typestore().hash_rihs01(type_name)
