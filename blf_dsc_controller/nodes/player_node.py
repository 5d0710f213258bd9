# SPDX-License-Identifier: Apache-2.0
"""The node `rosbag2_player`: plays a bag, with the services of rosbag2's player.

The services have rosbag2's names. Its service types are not available as wheels, so all of them
are std_srvs/Trigger: `is_paused` and `play_next` return their result in `success`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection
from functools import partial
from heapq import heappop, heappush
from math import inf
from pathlib import Path
from typing import Any

from rclpy.exceptions import NameValidationException
from rclpy.node import Node
from rclpy.publisher import Publisher
from std_srvs.srv import Trigger

from blf_dsc_controller.bags.sources import BagError, BagMessage, Messages, open_bag
from blf_dsc_controller.messages.codecs import encode_clock
from blf_dsc_controller.messages.topics import CLOCK, Quality
from blf_dsc_controller.nodes.endpoints import message_class, qos_profile

_MOST_AT_ONCE = 100
_CLOCK_PERIOD = 10_000_000  # ns
_LATE = 64  # messages


class Timeline:
    """Position in a bag over time; it begins paused.

    All times are integers [ns], of the bag or of the caller's steady clock.

    Attributes:
        paused: whether only `jump` moves it.
    """

    def __init__(self, start: int, rate: float) -> None:
        """Begin at `start`; rate 0 is as fast as possible: only `jump` moves the position."""
        self._bag = start
        self._now = 0
        self._rate = rate
        self.paused = True

    def position(self, now: int) -> int:
        """Return the time in the bag."""
        return self._bag if self.paused else self._bag + round((now - self._now) * self._rate)

    def pause(self, now: int) -> None:
        """Hold the position."""
        self._bag, self.paused = self.position(now), True

    def resume(self, now: int) -> None:
        """Continue from the position."""
        self._bag, self._now, self.paused = self.position(now), now, False

    def jump(self, to: int, now: int) -> None:
        """Move to a time in the bag."""
        self._bag, self._now = to, now

    def wait(self, until: int, now: int) -> float:
        """Return the time [s] until the position reaches `until`; infinite while paused."""
        if self.paused:
            return float('inf')
        left = max(0, until - self.position(now))
        return left / self._rate * 1e-9 if self._rate > 0.0 else 0.0


class PlayerNode(Node):
    """Publishes the messages of a bag in bag time, and that time on /clock if `clock` is set.

    Messages are read as they are played, so a bag may be larger than memory. Publishers use the
    recorded quality of service of their topics. `rate` is bag time per real time, or 0 to play as
    fast as possible; with `loop`, playback restarts at the end. Empty `topics` selects all topics;
    `offset` [s] and `duration` [s] select the time range. The player is paused until `resume`.

    Raises:
        BagError: the bag is missing or damaged, or has no messages for these topics and times.
    """

    def __init__(
        self,
        path: Path,
        rate: float,
        *,
        loop: bool,
        clock: bool,
        topics: Collection[str] = (),
        offset: float = 0.0,
        duration: float = inf,
        **options: Any,
    ) -> None:
        super().__init__('rosbag2_player', **options)
        with open_bag(path) as bag:
            held, offered, counts, times = bag.held, bag.offered, bag.counts, bag.times
        if not any(counts.values()):
            raise BagError(f'{path} is empty: it holds no message')
        wanted = {'/' + name.lstrip('/') for name in topics} or {*counts}
        if not wanted <= {*counts}:
            missing, listing = sorted(wanted - {*counts}), ', '.join(counts)
            raise BagError(f'the bag has no topic {", ".join(missing)}; it holds {listing}')
        self.begin = times[0] + round(offset * 1e9)
        self.end = (
            times[1] if duration == inf else min(times[1], self.begin + round(duration * 1e9))
        )
        if self.begin > times[1]:
            seconds = (times[1] - times[0]) * 1e-9
            raise BagError(f'nothing is left after {offset:g} s: the bag lasts {seconds:.3f} s')
        self._path, self._loop = path, loop
        self._latched = {name for name in wanted if offered[name].durability == 'transient_local'}
        self._outputs: dict[str, Publisher] = {}
        for name, type_ in held:
            if name in wanted and not (clock and name == CLOCK.name):
                self._add(name, type_, offered[name])
        self.timeline = Timeline(self.begin, rate)
        self._rate = rate
        self._messages = self._read()
        self._next = next(self._messages, None)
        if self._next is None:
            raise BagError(f'{path} holds no playable message for these topics and times')
        self._clock_output = (
            self.create_publisher(message_class(CLOCK.type), CLOCK.name, 10) if clock else None
        )
        self._clock_published = 0
        actions: dict[str, Callable[[], tuple[bool, str]]] = {
            'pause': self._pause,
            'resume': self.resume,
            'toggle_paused': lambda: self.resume() if self.timeline.paused else self._pause(),
            'is_paused': lambda: (self.timeline.paused, ''),
            'play_next': self._play_next,
        }
        for name, action in actions.items():
            self.create_service(Trigger, f'~/{name}', partial(_respond, action))

    @property
    def outputs(self) -> Collection[Publisher]:
        """Publishers of the bag's topics."""
        return self._outputs.values()

    @property
    def is_over(self) -> bool:
        """Whether no message is left."""
        return self._next is None

    @property
    def elapsed(self) -> float:
        """Bag time [s] since the beginning of the selected range."""
        at = min(self.timeline.position(time.monotonic_ns()), self.end)
        return (at - self.begin) * 1e-9

    def play(self) -> float:
        """Publish the messages that are due; return the time [s] until the next one."""
        now = time.monotonic_ns()
        for _ in range(_MOST_AT_ONCE):
            if self._next is None or self.timeline.wait(self._next.received, now) > 0.0:
                break
            self._publish(self._next, now)
        if self._clock_output is not None and now - self._clock_published >= _CLOCK_PERIOD:
            self._clock_published = now
            self._clock_output.publish(encode_clock(self.timeline.position(now)))
        return 0.0 if self._next is None else self.timeline.wait(self._next.received, now)

    def _add(self, name: str, type_name: str, quality: Quality) -> None:
        try:
            type_ = message_class(type_name)
            self._outputs[name] = self.create_publisher(type_, name, qos_profile(quality))
        except (ImportError, AttributeError):
            self.get_logger().warning(f'{name} is not played: {type_name} is not installed here')
        except NameValidationException:
            self.get_logger().warning(f'{name} is not played: it is not the name of a topic')

    def _read(self) -> Messages:
        """Yield the messages to play, after each latched topic's last one before the range."""
        with open_bag(self._path) as bag:
            if self.begin > bag.times[0]:
                latched = self._latched & {*self._outputs}
                before = {}
                for message in bag.messages(latched) if latched else ():
                    if message.received < self.begin:
                        before[message.topic] = message._replace(received=self.begin)
                yield from before.values()
            for message in _in_order(bag.messages({*self._outputs}, self.begin)):
                if message.received > self.end:
                    return
                yield message

    def _publish(self, message: BagMessage, now: int) -> None:
        """Publish the next message, and read the one after it."""
        self._outputs[message.topic].publish(message.raw)
        if self._rate == 0.0 or self.timeline.paused:
            self.timeline.jump(message.received, now)
        self._next = next(self._messages, None)
        if self._next is None and self._loop:
            self._messages = self._read()
            self._next = next(self._messages, None)
            self.timeline.jump(self.begin, now)

    def _pause(self) -> tuple[bool, str]:
        self.timeline.pause(time.monotonic_ns())
        return True, 'paused'

    def resume(self) -> tuple[bool, str]:
        """Start, or continue after a pause."""
        self.timeline.resume(time.monotonic_ns())
        return True, 'playing'

    def _play_next(self) -> tuple[bool, str]:
        if not self.timeline.paused or self._next is None:
            return False, 'end of the bag' if self._next is None else 'pause first'
        self._publish(self._next, time.monotonic_ns())
        return True, f'at {self.elapsed:.3f} s'


def _in_order(messages: Messages) -> Messages:
    """Yield messages in order of reception, if none is more than 64 messages late in the file."""
    waiting: list[tuple[int, int, BagMessage]] = []
    for number, message in enumerate(messages):
        heappush(waiting, (message.received, number, message))
        if len(waiting) > _LATE:
            yield heappop(waiting)[2]
    while waiting:
        yield heappop(waiting)[2]


def _respond(
    action: Callable[[], tuple[bool, str]], _: Trigger.Request, response: Trigger.Response
) -> Trigger.Response:
    response.success, response.message = action()
    return response
