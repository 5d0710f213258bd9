# SPDX-License-Identifier: Apache-2.0
"""Errors of serialised messages."""

from __future__ import annotations

from collections.abc import Collection

from blf_dsc_controller.errors import BlfDscError


class MessageError(BlfDscError):
    """A serialised message that cannot be used."""


class MissingJointError(MessageError):
    """An expected joint is not among the names of the message."""

    def __init__(self, joint: str, names: tuple[str, ...]) -> None:
        self.joint, self.names = joint, names
        listed = ', '.join(names) or 'none'
        self.fact = f'joint {joint!r} is not in the message, which names {listed}'
        super().__init__(
            f'{self.fact}: set the parameter `joints` to names from this list, or publish the joint'
        )

    def is_foreign(self, joints: Collection[str]) -> bool:
        """Return whether the message is for other joints only: drivers may share a topic."""
        return bool(self.names) and not set(joints) & set(self.names)


class DuplicatedJointError(MessageError):
    """An expected joint is named more than once."""


class ShortArrayError(MessageError):
    """An array of the message does not hold one value for each name."""
