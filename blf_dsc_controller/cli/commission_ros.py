# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc commission --ros`: the controller's node measures the robot behind its topics."""

from __future__ import annotations

import gc
import signal
from argparse import Namespace
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import rclpy
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter

from blf_dsc_controller.cli.commission_robot import prepared_folder
from blf_dsc_controller.cli.drive import signals_to
from blf_dsc_controller.commissioning.commissioning import Commissioning
from blf_dsc_controller.commissioning.over_ros import OverRos
from blf_dsc_controller.commissioning.postures import PostureByPosture, move
from blf_dsc_controller.commissioning.run_parameters import undisturbed_parameters
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import CONTROLLER, load, read
from blf_dsc_controller.configuration.robot import TOPIC
from blf_dsc_controller.configuration.schema import change, flatten
from blf_dsc_controller.nodes import process
from blf_dsc_controller.nodes.parameters import wait_for_description
from blf_dsc_controller.nodes.run_by_run import RunByRunNode

_NAME = 'blf_dsc_commission'  # of the node that asks for a URDF
_URDF = 'robot.urdf'


@contextmanager
def ros_session(options: Namespace) -> Iterator[None]:
    """Begin and end ROS, with the topics that the options name."""
    rules = [f'__ns:=/{options.namespace.strip("/")}']
    if options.states:
        rules.append(f'joint_states:={options.states}')
    if options.commands:
        rules.append(f'{CONTROLLER}:~/commands:={options.commands}')
    words = [word for rule in rules for word in ('-r', rule)]
    rclpy.init(
        args=['--ros-args', *words],
        signal_handler_options=rclpy.SignalHandlerOptions.NO,
    )
    try:
        yield
    finally:
        rclpy.try_shutdown()


def config_over_ros(path: Path) -> ControllerConfig:
    """Return the configuration of a file, whose URDF may come from a topic."""
    given = [
        str(section.entries[_URDF].value)
        for section in read(path)
        if _URDF in section.entries
    ]
    if not (given and given[-1].startswith(TOPIC)):
        return load(path, CONTROLLER, ControllerConfig)
    node = Node(_NAME)
    try:
        text = wait_for_description(node, given[-1].removeprefix(TOPIC))
    finally:
        node.destroy_node()
    return load(path, CONTROLLER, ControllerConfig, {_URDF: text})


@contextmanager
def robot_over_ros(
    options: Namespace, commissioning: Commissioning
) -> Iterator[PostureByPosture]:
    """Wait for the robot behind the topics, and let the node work.

    Raises BlfDscError if nobody can be asked, or nobody sends states or takes torques.
    """
    folder = prepared_folder(options)
    with ExitStack() as ending:
        worker = ending.enter_context(
            ProcessPoolExecutor(
                1, get_context('spawn'), signal.signal, (signal.SIGINT, signal.SIG_IGN)
            )
        )
        executor = ending.enter_context(EventsExecutor())
        node = made(commissioning.config)
        ending.callback(node.destroy_node)
        ending.callback(node.close)
        executor.add_node(node)
        spin = partial(process.spin_once, executor, node)
        robot = OverRos(node, spin, commissioning, folder, worker)
        ending.enter_context(signals_to(robot.request_end))
        robot.wait()
        here = robot.position()
        worker.submit(move, commissioning.config, here, here).result()  # it starts here
        gc.collect()
        gc.freeze()  # what is loaded by now stays: scanning it would stall the loop
        yield robot


def made(config: ControllerConfig, **options: object) -> RunByRunNode:
    """Return the node for a configuration, which commands nothing yet."""
    values = flatten(change(config, undisturbed_parameters(config)))
    overrides = [
        Parameter(name, value=list(value) if isinstance(value, tuple) else value)
        for name, value in values.items()
        if value != ()
    ]
    return RunByRunNode(parameter_overrides=overrides, **options)
