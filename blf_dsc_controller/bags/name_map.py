# SPDX-License-Identifier: Apache-2.0
"""What topics and joints are called in a bag that was made elsewhere."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from blf_dsc_controller.bags.errors import NameMapError
from blf_dsc_controller.messages.topics import TOPICS

_LEAVES = tuple(topic.leaf for topic in TOPICS)


@dataclass(frozen=True)
class NameMap:
    """Names of the bag by ours: a topic by the last part of its name, a joint by its own."""

    topics: Mapping[str, str] = field(default_factory=dict)
    joints: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def parse(cls, entries: Iterable[str]) -> NameMap:
        """Read entries such as `commands=/arm/torque` and `joint1=shoulder`.

        Raises:
            NameMapError: an entry has no two sides, or one side is there twice.
        """
        topics: dict[str, str] = {}
        joints: dict[str, str] = {}
        for entry in entries:
            ours, _, theirs = (side.strip() for side in entry.partition('='))
            if not ours or not theirs:
                raise NameMapError(entry, 'one side is missing')
            side = topics if ours in _LEAVES else joints
            if ours in side or theirs in side.values():
                raise NameMapError(entry, 'a name was given before')
            side[ours] = theirs
        return cls({leaf: '/' + name.lstrip('/') for leaf, name in topics.items()}, joints)

    def joints_of(self, joints: Iterable[str]) -> tuple[str, ...]:
        """Names that these joints have in the bag.

        Raises:
            NameMapError: a name is mapped that is neither a topic nor one of `joints`.
        """
        ours = tuple(joints)
        for joint, theirs in self.joints.items():
            if joint not in ours:
                reason = f'{joint} is neither a topic nor one of the joints {", ".join(ours)}'
                raise NameMapError(f'{joint}={theirs}', reason)
        return tuple(self.joints.get(joint, joint) for joint in ours)


NO_NAMES = NameMap()
