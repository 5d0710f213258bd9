# SPDX-License-Identifier: Apache-2.0
"""Which topic of a bag is which, whatever the nodes and their namespace were called."""

from __future__ import annotations

from collections.abc import Iterable

from blf_dsc_controller.bags.errors import AmbiguousTopicError
from blf_dsc_controller.messages.topics import Topic


def find(topic: Topic, held: Iterable[tuple[str, str]], namespace: str = '') -> str | None:
    """Name of the topic of a bag that is `topic`, None if there is none.

    Looked for by type and by the full name, then by the name behind a namespace, then by the last
    part of the name.

    Args:
        topic: of this package.
        held: name and type of each topic of the bag.
        namespace: only topics below it count.

    Raises:
        AmbiguousTopicError: several topics fit equally well.
    """
    prefix = f'/{namespace.strip("/")}/' if namespace.strip('/') else '/'
    names = [name for name, type_ in held if type_ == topic.type and name.startswith(prefix)]
    for ending in (topic.resolved, f'/{topic.leaf}'):
        if prefix + ending[1:] in names:
            return prefix + ending[1:]
        fitting = sorted(name for name in names if name.endswith(ending))
        if len(fitting) > 1:
            raise AmbiguousTopicError(topic.relative, fitting)
        if fitting:
            return fitting[0]
    return None
