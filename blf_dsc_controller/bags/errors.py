# SPDX-License-Identifier: Apache-2.0
"""What can be wrong with a bag; every error carries the data it speaks of."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.errors import MessageError, MissingJointError


class BagExistsError(BlfDscError):
    """The folder to record into is there already."""

    def __init__(self, path: Path) -> None:
        self.path = path
        super().__init__(
            f'{path} exists already and is not overwritten: choose another folder or remove it'
        )


class WriteError(BlfDscError):
    """A bag that cannot be written any further, for another reason than a full disk."""

    def __init__(self, error: OSError) -> None:
        super().__init__(
            f'the bag cannot be written any further: {error}; what was written before is saved by '
            'bag_recover'
        )


class DiskFullError(BlfDscError):
    """The disk of a bag is full; what was written until then is a complete bag."""

    def __init__(self, path: Path, messages: int) -> None:
        self.path = path
        self.messages = messages
        super().__init__(
            f'the disk is full: recording into {path} has ended with {messages} messages, which '
            'are complete and readable; make room, or split and move bags while they are recorded'
        )


class UnreadableBagError(BlfDscError):
    """A folder that is no bag, or a bag that cannot be read to its end."""

    def __init__(self, path: Path, reason: str) -> None:
        self.path = path
        self.reason = reason
        super().__init__(f'{path} cannot be read as a bag: {reason}')


class MissingTopicError(BlfDscError):
    """A topic that is essential to the result is not in the bag."""

    def __init__(self, wanted: str, type_name: str, held: Iterable[tuple[str, str]]) -> None:
        self.wanted = wanted
        self.type_name = type_name
        self.held = tuple(held)
        listing = ''.join(
            f'\n  {name} ({type_ or "of a type it does not tell"})' for name, type_ in self.held
        )
        named = 'called' if wanted.startswith('/') else 'whose name ends in'
        super().__init__(
            f'the bag has no topic {named} {wanted!r} of type {type_name}; it holds:{listing}'
        )


class EmptyBagError(BlfDscError):
    """A bag without a message; with a `topic`, without one of that."""

    def __init__(self, path: Path, topic: str = '') -> None:
        self.path = path
        self.topic = topic
        super().__init__(f'{path} is empty: it holds no message{topic and f" of {topic}"}')


class NameMapError(BlfDscError):
    """An entry that does not say what is called what."""

    def __init__(self, entry: str, reason: str) -> None:
        self.entry = entry
        super().__init__(
            f'--map {entry}: {reason}; expected OURS=THEIRS with a topic, as in '
            'joint_states=/arm/states, or a joint, as in joint1=shoulder'
        )


class AmbiguousTopicError(BlfDscError):
    """Several topics of a bag could be the one that is wanted."""

    def __init__(self, wanted: str, candidates: Iterable[str]) -> None:
        self.wanted = wanted
        self.candidates = tuple(candidates)
        super().__init__(
            f'the bag has {len(self.candidates)} topics that could be {wanted!r}: '
            f'{", ".join(self.candidates)}; name the namespace of the one robot to look at'
        )


class UnreadableMessageError(BlfDscError):
    """A message of a bag that cannot be decoded."""

    def __init__(self, topic: str, index: int, error: MessageError) -> None:
        self.topic = topic
        self.index = index
        reason = str(error)
        if isinstance(error, MissingJointError):
            reason = (
                f'{error.fact}: the bag is of another robot, or has other names for its joints, '
                f'as in bag_replay --config FILE --map {error.joint}=ITS_NAME'
            )
        super().__init__(f'message {index + 1} of {topic} cannot be read: {reason}')


class UnknownFormatError(BlfDscError):
    """A file whose ending does not say how it is to be written."""

    def __init__(self, path: Path) -> None:
        self.path = path
        super().__init__(
            f'{path} ends in neither .csv nor .parquet: name the file such that it tells its format'
        )


class NoConfigurationError(BlfDscError):
    """A bag that does not tell how the controller was configured, or not in a readable way."""

    def __init__(self, path: Path, damage: str = '') -> None:
        self.path = path
        reason = (
            f'{path} holds a configuration that cannot be read ({damage})'
            if damage
            else f'{path} does not hold the configuration of a controller: it was recorded by '
            'something else, or without the controller'
        )
        super().__init__(f'{reason}; name one, as in --config recommended')


class OtherVersionError(BlfDscError):
    """A bag of another version of this package, whose configuration this one cannot run."""

    def __init__(self, path: Path, recorded: str, present: str, reason: Exception) -> None:
        self.path = path
        self.recorded = recorded
        self.present = present
        super().__init__(
            f'{path} was recorded by version {recorded or "unknown"}, and this is version '
            f'{present}, which cannot run its configuration: {reason}\n'
            'Replay it with the version that recorded it, or name another configuration (--config)'
        )
