# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc replay --play`: play a bag over ROS until its end or Ctrl-C."""

from __future__ import annotations

import re
import time
from argparse import Namespace
from math import inf

import rclpy
from rclpy.experimental import EventsExecutor

from blf_dsc_controller.cli.progress import Progress
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.nodes.player_node import PlayerNode
from blf_dsc_controller.nodes.process import drain
from blf_dsc_controller.nodes.rclpy_internals import RCLError

_LONGEST_WAIT = 0.01  # s
_RATES = (1e-3, 1e6)
_NAME = r'(?:~?/)?[A-Za-z_]\w*(?:/[A-Za-z_]\w*)*'
_REMAP = re.compile(rf'(?:\w+:)?{_NAME}:=(?:{_NAME}|/)')


def play(options: Namespace) -> None:
    """Play a bag with PlayerNode, after `delay` [s] for the discovery of subscribers.

    Raises:
        BlfDscError: an option is out of range, or PlayerNode rejects the bag.
    """
    _check(options)
    words = [word for remap in options.remap for word in ('--remap', remap)]
    try:
        rclpy.init(
            args=['blf_dsc', '--ros-args', *words] if words else [],
            signal_handler_options=rclpy.SignalHandlerOptions.NO,
        )
        node = PlayerNode(
            options.bag,
            options.rate,
            loop=options.loop,
            clock=options.clock,
            topics=options.topics,
            offset=options.start_offset,
            duration=options.playback_duration,
        )
        _announce(node, options)
        _run(node, options)
    except RCLError as error:
        raise BlfDscError(f'{error}') from error
    except KeyboardInterrupt:
        pass
    finally:
        rclpy.try_shutdown()


def _check(options: Namespace) -> None:
    slowest, fastest = _RATES
    if options.rate != 0.0 and not slowest <= options.rate <= fastest:
        raise BlfDscError(
            f'--rate {options.rate:g}: expected a speed from {slowest:g} to {fastest:g}, or 0 for '
            'as fast as possible'
        )
    for name in ('delay', 'start_offset', 'playback_duration'):
        value = getattr(options, name)
        if not 0.0 <= value < inf and (name, value) != ('playback_duration', inf):
            option = name.replace('_', '-')
            raise BlfDscError(f'--{option} {value:g}: expected a time in seconds, 0 or more')
    for remap in options.remap:
        if not _REMAP.fullmatch(remap):
            raise BlfDscError(
                f'--remap {remap}: expected FROM:=TO with names of topics, as in '
                'joint_states:=recorded_states'
            )


def _announce(node: PlayerNode, options: Namespace) -> None:
    rate = f'at rate {options.rate:g}' if options.rate else 'as fast as possible'
    again = ', in a loop' if options.loop else ''
    name, seconds = node.get_fully_qualified_name(), (node.end - node.begin) * 1e-9
    print(f'{name} plays {seconds:.3f} s of {options.bag} {rate}{again}:')
    for output in node.outputs:
        print(f'  {output.topic_name}')
    if options.start_paused:
        print(f'paused: ros2 service call {name}/resume std_srvs/srv/Trigger', flush=True)


def _run(node: PlayerNode, options: Namespace) -> None:
    with EventsExecutor() as executor:
        executor.add_node(node)
        begin = time.monotonic()
        while time.monotonic() - begin < options.delay:
            executor.spin_once(timeout_sec=_LONGEST_WAIT)
        if not options.start_paused:
            node.resume()
        progress = Progress('played', (node.end - node.begin) * 1e-9)
        try:
            while not node.is_over:
                wait = node.play()
                progress.show(node.elapsed, 'paused' if node.timeline.paused else '')
                executor.spin_once(timeout_sec=min(wait, _LONGEST_WAIT))
            drain(node.outputs)
        finally:
            progress.close()
