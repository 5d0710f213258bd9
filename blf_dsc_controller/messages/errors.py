# SPDX-License-Identifier: Apache-2.0
"""Errors of serialised messages that callers distinguish."""

from __future__ import annotations

from blf_dsc_controller.errors import BlfDscError


class MessageError(BlfDscError):
    """A serialised message that cannot be used."""


class MissingJointError(MessageError):
    """An expected joint is not among the names of the message."""

    def __init__(self, joint: str, names: tuple[str, ...]) -> None:
        self.joint = joint
        self.names = names
        self.fact = (
            f'joint {joint!r} is not in the message, which names {", ".join(names) or "none"}'
        )
        super().__init__(
            f'{self.fact}: set the parameter `joints` to names from this list, or publish the joint'
        )


class DuplicatedJointError(MessageError):
    """An expected joint is named more than once."""


class ShortArrayError(MessageError):
    """An array of the message does not hold one value for each name."""


class UnknownTypeError(BlfDscError):
    """A message type without a known definition."""

    def __init__(self, type_name: str) -> None:
        super().__init__(
            f'message type {type_name!r} is not known here: its definition is needed to record it'
        )
