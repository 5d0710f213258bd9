# SPDX-License-Identifier: Apache-2.0
"""What can be wrong with a serialised message; every error carries the data it speaks of."""

from __future__ import annotations

from blf_dsc_controller.errors import BlfDscError


class MessageError(BlfDscError):
    """A serialised message that cannot be used."""


class MessageEncodingError(MessageError):
    """The message is not in the plain CDR encoding that ROS 2 uses."""

    def __init__(self, encapsulation: bytes) -> None:
        self.encapsulation = encapsulation
        super().__init__(
            f'message starts with the bytes {encapsulation.hex(" ")}, not with 00 00 or 00 01: '
            'it is not plain CDR; publish it with a ROS 2 middleware in its default encoding'
        )


class TruncatedMessageError(MessageError):
    """The message ends before all that it announces has come."""

    def __init__(self, needed: int, got: int) -> None:
        self.needed = needed
        self.got = got
        super().__init__(
            f'message of {got} bytes is cut off: its contents need at least {needed} bytes'
        )


class MissingJointError(MessageError):
    """A joint that is asked for is not among the names of the message."""

    def __init__(self, joint: str, names: tuple[str, ...]) -> None:
        self.joint = joint
        self.names = names
        self.fact = (
            f'joint {joint!r} is not in the message, which names {", ".join(names) or "none"}'
        )
        super().__init__(
            f'{self.fact}: set the parameter `joints` to names from this list, or publish the joint'
        )


class UnnamedJointsError(MessageError):
    """A joint state that names no joint at all."""

    def __init__(self) -> None:
        super().__init__('it names no joint, so its values cannot be told apart')


class DuplicatedJointError(MessageError):
    """A joint that is asked for is named more than once."""

    def __init__(self, joint: str, names: tuple[str, ...]) -> None:
        self.joint = joint
        self.names = names
        super().__init__(
            f'joint {joint!r} appears {names.count(joint)} times in the message '
            f'({", ".join(names)}): name each joint once'
        )


class ShortArrayError(MessageError):
    """An array of the message does not hold one value for each of its names."""

    def __init__(self, field: str, needed: int, got: int) -> None:
        self.field = field
        self.needed = needed
        self.got = got
        super().__init__(
            f'`{field}` of the message holds {got} values for {needed} names: '
            'publish one value for each name'
        )


class UnknownTypeError(BlfDscError):
    """A message type whose definition is not known here."""

    def __init__(self, type_name: str) -> None:
        self.type_name = type_name
        super().__init__(
            f'message type {type_name!r} is not known here: its definition is needed to record it'
        )
