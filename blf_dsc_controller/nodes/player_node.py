# SPDX-License-Identifier: Apache-2.0
"""The node `rosbag2_player`: plays a bag, with the services of rosbag2's player.

The services have rosbag2's names. Its service types are not available as wheels, so all of them
are std_srvs/Trigger: `is_paused` and `play_next` return their result in `success`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import rclpy
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from std_srvs.srv import Trigger

from blf_dsc_controller.bags.sources import BagError, open_bag
from blf_dsc_controller.messages.codecs import encode_clock
from blf_dsc_controller.messages.topics import CLOCK, HISTORY, STREAM
from blf_dsc_controller.nodes.endpoints import message_class, qos_profile
from blf_dsc_controller.nodes.process import drain
from blf_dsc_controller.replay.timeline import Timeline

_MOST_AT_ONCE = 100
_LONGEST_WAIT = 0.01  # s
_CLOCK_PERIOD = 10_000_000  # ns
_LATCHED = ('bound',)


class PlayerNode(Node):
    """Publishes the messages of a bag in its time, and that time on /clock if `clock` is set.

    `rate` is bag time per time, 0 as fast as possible; a `loop` begins again at the end. Raises
    BagError if there is no bag, it is damaged, or it holds nothing that can be played here.
    """

    def __init__(self, path: Path, rate: float, *, loop: bool, clock: bool, **options: Any) -> None:
        super().__init__('rosbag2_player', **options)
        with open_bag(path) as bag:
            types = {name: type_ for name, type_ in bag.held if not (clock and name == '/clock')}
            outputs = {name: self._output(name, type_) for name, type_ in types.items()}
            known = {name for name, output in outputs.items() if output is not None}
            messages = sorted(bag.messages(known), key=lambda message: message[1])
        if not messages:
            raise BagError(f'{path} is empty: it holds no message')
        self._messages = [partial(outputs[name].publish, raw) for name, _, raw in messages]
        self.outputs = [output for output in outputs.values() if output is not None]
        self.timeline = Timeline([at for _, at, _ in messages], rate, loop=loop)
        self._clock_output = (
            self.create_publisher(message_class(CLOCK.type), '/clock', 10) if clock else None
        )
        self._clock_published = 0
        actions: dict[str, Callable[[], tuple[bool, str]]] = {
            'pause': self.pause,
            'resume': self._resume,
            'toggle_paused': lambda: self._resume() if self.timeline.paused else self.pause(),
            'is_paused': lambda: (self.timeline.paused, ''),
            'play_next': self._play_next,
        }
        for name, action in actions.items():
            self.create_service(Trigger, f'~/{name}', partial(_respond, action))

    def play(self) -> None:
        """Publish what is due."""
        now = time.monotonic_ns()
        for number in self.timeline.due(now, _MOST_AT_ONCE):
            self._messages[number]()
        if self._clock_output is not None and now - self._clock_published >= _CLOCK_PERIOD:
            self._clock_published = now
            self._clock_output.publish(encode_clock(self.timeline.position(now)))

    def _output(self, name: str, type_name: str) -> Any:
        try:
            class_ = message_class(type_name)
        except (ImportError, AttributeError):
            self.get_logger().warning(f'{name} is not played: {type_name} is not installed here')
            return None
        quality = HISTORY if name.rsplit('/', 1)[-1] in _LATCHED else STREAM
        return self.create_publisher(class_, name, qos_profile(quality))

    def pause(self) -> tuple[bool, str]:
        """Hold the position in the bag."""
        self.timeline.pause(time.monotonic_ns())
        return True, 'paused'

    def _resume(self) -> tuple[bool, str]:
        self.timeline.resume(time.monotonic_ns())
        return True, 'playing'

    def _play_next(self) -> tuple[bool, str]:
        number = self.timeline.step()
        if number is None:
            return False, 'pause first' if not self.timeline.paused else 'this is the end'
        self._messages[number]()
        return True, f'message {number + 1} of {len(self._messages)}'


def _respond(
    action: Callable[[], tuple[bool, str]], _: Trigger.Request, response: Trigger.Response
) -> Trigger.Response:
    response.success, response.message = action()
    return response


def play(
    path: Path,
    rate: float,
    *,
    loop: bool,
    clock: bool,
    paused: bool,
    delay: float,
    remaps: Sequence[str],
) -> None:
    """Play a bag as PlayerNode does, until its end or until Ctrl-C.

    Subscribers have `delay` [s] to be found before the first message; a start that is `paused`
    waits for the service `resume`. `remaps` are such as `joint_states:=other`.
    """
    words = [word for remap in remaps for word in ('--remap', remap)]
    rclpy.init(args=['bag_replay', '--ros-args', *words] if words else None)
    try:
        node = PlayerNode(path, rate, loop=loop, clock=clock)
        executor = EventsExecutor()
        executor.add_node(node)
        begin = time.monotonic()
        while time.monotonic() - begin < delay:
            executor.spin_once(timeout_sec=_LONGEST_WAIT)
        if paused:
            node.pause()
        while rclpy.ok() and not node.timeline.is_over:
            node.play()
            wait = node.timeline.wait(time.monotonic_ns())
            executor.spin_once(timeout_sec=min(wait, _LONGEST_WAIT))
        drain(node.outputs)
    except KeyboardInterrupt:
        pass
    finally:
        rclpy.try_shutdown()
