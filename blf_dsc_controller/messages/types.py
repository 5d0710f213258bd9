# SPDX-License-Identifier: Apache-2.0
"""Definitions of the message types of ROS 2 Jazzy, without a ROS installation."""

from __future__ import annotations

import functools
from typing import NamedTuple

from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from blf_dsc_controller.errors import BlfDscError


class UnknownTypeError(BlfDscError):
    """A message type without a known definition."""

    def __init__(self, type_name: str) -> None:
        super().__init__(
            f'unknown message type {type_name!r}: its definition is needed to record it'
        )


class Definition(NamedTuple):
    """Definition of a message type, empty where it is unknown."""

    text: str  # with those of all nested types
    hash: str  # RIHS01_...
    encoding: str = 'ros2msg'


@functools.cache
def typestore() -> Typestore:
    """Return the types of Jazzy's common interfaces; further types can be registered there."""
    return get_typestore(Stores.ROS2_JAZZY)


def definition(type_name: str) -> Definition:
    """Return the definition of a message type; UnknownTypeError if it is not in the store."""
    if type_name not in typestore().fielddefs:
        raise UnknownTypeError(type_name)
    text, _md5 = typestore().generate_msgdef(type_name, ros_version=2)
    return Definition(text, typestore().hash_rihs01(type_name))
