# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc drive`: the guarded law on a robot's own interface."""

from __future__ import annotations

import math
import signal
from argparse import Namespace
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

from blf_dsc_controller.bags.sources import BagExistsError
from blf_dsc_controller.cli.result_folder import (
    discard_unbegun,
    expect_folder,
    keep,
)
from blf_dsc_controller.cli.run import STOPPED
from blf_dsc_controller.cli.softer_gains import print_softer_gains
from blf_dsc_controller.cli.start import INTERRUPTED
from blf_dsc_controller.compiled.announcement import announced_compilation
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import (
    CONTROLLER,
    DRIVE,
    ignored_in,
    locate,
)
from blf_dsc_controller.control.arm_controller import ArmController
from blf_dsc_controller.control.realtime import request_realtime
from blf_dsc_controller.drive.driver import Driver
from blf_dsc_controller.drive.drivers import ROS, config_of, driver_of
from blf_dsc_controller.drive.loop import DriveLoop, End, Outcome
from blf_dsc_controller.drive.motor_feedback import (
    as_in_motors,
    closed_in_motors,
    robot_warnings,
)
from blf_dsc_controller.drive.ros_topics import RosTopics
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.nodes.ros_check import require_ros
from blf_dsc_controller.progress import print_notice
from blf_dsc_controller.reference.approach import end_of_waypoints
from blf_dsc_controller.warnings.expected_errors import expectation

CODES = {
    End.DURATION: 0,
    End.REQUESTED: INTERRUPTED,
    End.STOPPED: STOPPED,
    End.REFLEX: STOPPED,
    End.LOST: STOPPED,
}
"""Exit codes by the end of a run."""


def drive(options: Namespace) -> int:
    """Control a robot until the end, and print how it went."""
    _check(options)
    path = locate(options.config)
    config = config_of(options.robot, path, {})
    driver = driver_of(options.robot, path, config)
    if ignored := ignored_in(path, (CONTROLLER, DRIVE)):
        print_notice(f'warning: {ignored}')
    _say_before(config, driver)
    if driver.config.feedback == 'motor':
        config = closed_in_motors(config)
    with ExitStack() as ending:
        expect_folder(options.out)
        ending.callback(discard_unbegun)
        with announced_compilation(print_notice):
            try:
                controller = ArmController(config, record=options.out, stamps='wall')
            except BagExistsError:
                keep(options.out)
                raise
        ros = None
        if options.ros:
            ros = RosTopics(controller, options.namespace)
            ending.callback(ros.close)
        ending.enter_context(controller)
        ending.callback(driver.close)
        connect(driver)
        loop = DriveLoop(
            driver,
            controller,
            duration=options.duration or math.inf,
            beside=ros,
            feedback=driver.config.feedback,
        )
        with signals_to(loop.request_end):
            print_notice(f'controlling {options.robot}: Ctrl-C ends')
            keep(options.out)
            outcome = loop.run()
        _print(outcome, loop, controller)
    if driver.config.feedback == 'host':  # motors tolerate more
        print_softer_gains(outcome.text, config)
    if ros is not None and ros.problem:
        print(f'topics        {ros.problem}')
    if controller.output_problem:
        print(f'recorded      only a part: {controller.output_problem}')
    elif options.out is not None:
        print(
            f'recorded      {options.out}: blf_dsc replay, report, export and identify read it'
        )
    return CODES[outcome.end] or int(bool(controller.output_problem))


def connect(driver: Driver) -> None:
    """Connect to the robot, and print its remarks."""
    print_notice(f'connecting to {driver.address}: some seconds')
    for remark in driver.connect():
        print_notice(remark)
    request_realtime(
        driver.controller.realtime, lambda text: print_notice(f'warning: {text}')
    )


def _say_before(config: ControllerConfig, driver: Driver) -> None:
    """Print the warnings, the errors to expect, and where waypoints end."""
    in_motors = driver.config.feedback == 'motor'
    for warning in robot_warnings(config, in_motors=in_motors):
        print_notice(f'warning: {warning}')
    if config.model == 'urdf':
        loop = as_in_motors(config) if in_motors else config
        print(f'errors to expect: {expectation(loop)}')
    if end := end_of_waypoints(config):
        print(end)


def _check(options: Namespace) -> None:
    """Raise BlfDscError if the options are wrong, or if they need a missing ROS."""
    if not (options.duration >= 0.0 and math.isfinite(options.duration)):
        raise BlfDscError(
            f'--duration: got {options.duration:g} s, but a finite time of at least 0 is needed '
            '(0: until Ctrl-C)'
        )
    if not options.robot:
        raise BlfDscError('--robot: got nothing, but a robot or its address is needed')
    if options.ros and options.robot == ROS:
        raise BlfDscError('--robot ros has its topics already: leave out --ros')
    if options.ros:
        require_ros()
    elif options.namespace:
        raise BlfDscError(
            '--namespace is for the topics, which need --ros: give it, too'
        )


@contextmanager
def signals_to(request_end: Callable[[], None]) -> Iterator[None]:
    """Request the end on SIGINT and SIGTERM, instead of interrupting a step."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, lambda *_: request_end()) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


def _print(outcome: Outcome, loop: DriveLoop, controller: ArmController) -> None:
    """Print the end, the largest error, the load, and how fast the torques were."""
    reason = f': {outcome.text}' if outcome.text else ''
    print(f'end           {outcome.end}{reason}')
    print(f'states        {outcome.states}, and {controller.missed} missed')
    print(f'tracking      largest error {loop.worst:.0%} of its bound')
    if not math.isnan(loop.worst_at_tool):
        print(f'tool          largest error {1e3 * loop.worst_at_tool:.3g} mm')
    mass, interval = controller.load
    if not math.isnan(mass):
        print(f'load          {mass:.2f} +- {interval:.2f} kg more than at the start')
    if loop.remark:
        print(f'load          no longer declared to the drives: {loop.remark}')
    if controller.guard.findings.untrusted:
        print(f'sensors       {controller.guard.findings.untrusted}')
    median, most = loop.latency.quantile(0.5), loop.latency.quantile(0.99)
    print(
        f'latency       from state to torque: median {1e6 * median:.0f} us, 99 % '
        f'{1e6 * most:.0f} us, largest {1e6 * loop.latency.largest:.0f} us'
    )
