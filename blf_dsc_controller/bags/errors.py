# SPDX-License-Identifier: Apache-2.0
"""Errors of bags that callers distinguish."""

from __future__ import annotations

from pathlib import Path

from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.cdr import MessageError, MissingJointError


class BagError(BlfDscError):
    """A bag that cannot be read or written."""


class DiskFullError(BagError):
    """The disk is full; the bag was ended in order before."""

    def __init__(self, path: Path, messages: int) -> None:
        self.messages = messages
        super().__init__(
            f'the disk is full: recording into {path} has ended with {messages} messages, which '
            'are complete and readable; make room, or split and move bags while they are recorded'
        )


class UnreadableMessageError(BagError):
    """A message of a bag that cannot be decoded."""

    def __init__(self, topic: str, index: int, error: MessageError) -> None:
        reason = str(error)
        if isinstance(error, MissingJointError):
            reason = (
                f'{error.fact}: the bag is of another robot, or has other names for its joints, '
                f'as in bag_replay --config FILE --map {error.joint}=ITS_NAME'
            )
        super().__init__(f'message {index + 1} of {topic} cannot be read: {reason}')
