# SPDX-License-Identifier: Apache-2.0
"""The process that controls the arm of a script: the loop of `blf_dsc drive`, again and again.

    START -> loop -> ENDED -> RECOVER -> loop -> ...       until the script closes or ends

Between two loops the robot holds itself by its own means, and what was learned is kept.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

from blf_dsc_controller.compiled.announcement import announced_compilation
from blf_dsc_controller.configuration.nodes import (
    CONTROLLER,
    DRIVE,
    ignored_in,
    locate,
)
from blf_dsc_controller.control.arm_controller import ArmController
from blf_dsc_controller.control.realtime import request_realtime
from blf_dsc_controller.drive.beside import LinkLog
from blf_dsc_controller.drive.driver import Driver
from blf_dsc_controller.drive.drivers import config_of, driver_of
from blf_dsc_controller.drive.loop import DriveLoop, End
from blf_dsc_controller.drive.motor_feedback import closed_in_motors, robot_warnings
from blf_dsc_controller.drive.script import Script
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages import script_link, topic_link
from blf_dsc_controller.messages.link import Link, link_of

_POLL = 0.1  # s
_PATIENCE = 5.0  # s, for the script to take the last messages
_HOLD = {'reference.type': 'hold'}


def main() -> int:
    """Control the arm until the script closes or ends."""
    link = link_of(sys.argv[1])
    log = LinkLog(link)
    code = 0
    try:
        wanted = _awaited(link, script_link.START)
        if wanted is not None:
            _control(link, log, wanted)
    except (BlfDscError, OSError) as error:
        link.put(script_link.FAILED, topic_link.encode(str(error)))
        code = 1
    except Exception as error:
        text = f'{type(error).__name__}: {error}; the traceback is on stderr'
        link.put(script_link.FAILED, topic_link.encode(text))
        link.close(_PATIENCE)
        raise
    link.close(_PATIENCE)
    return code


def _control(link: Link, log: LinkLog, wanted: Mapping[str, Any]) -> None:
    overrides = wanted['overrides']
    given = overrides.get(CONTROLLER, {})
    path = locate(wanted['config'])
    held = {**overrides, CONTROLLER: _HOLD | given}
    config = config_of(wanted['robot'], path, held)
    driver = driver_of(wanted['robot'], path, config, overrides)
    in_motors = driver.config.feedback == 'motor'
    ignored = ignored_in(path, (CONTROLLER, DRIVE))
    for warning in filter(
        None, [*robot_warnings(config, in_motors=in_motors), ignored]
    ):
        log.info(warning)
    if in_motors:
        config = closed_in_motors(config)
    record = Path(wanted['record']) if wanted['record'] else None
    with announced_compilation(lambda text: sys.stderr.write(f'{text}\n')):
        controller = ArmController(config, record=record, stamps='wall')
    with controller, closing(driver):
        for remark in driver.connect():
            log.info(remark)
        request_realtime(config.realtime, log.warning)
        _run(driver, controller, Script(link, controller, driver.inputs), link)
    if controller.output_problem:
        log.error(f'recorded only a part: {controller.output_problem}')


def _run(driver: Driver, controller: ArmController, script: Script, link: Link) -> None:
    """Run the loop, and again each time that the script recovers it."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: script.request_close())
    while True:
        loop = DriveLoop(
            driver,
            controller,
            beside=script,
            feedback=driver.config.feedback,
        )
        script.begin(loop)
        if script.is_over:
            return
        outcome = loop.run()
        waits = outcome.end is not End.REQUESTED and not script.is_over
        ended = {'end': outcome.end, 'text': outcome.text, 'waits': waits}
        script.tell(script_link.ENDED, ended)
        median, most = loop.latency.quantile(0.5), loop.latency.quantile(0.99)
        script.log.info(
            f'{outcome.states} states, and {controller.missed} missed; largest error '
            f'{loop.worst:.0%} of its bound; from state to torque {1e6 * median:.0f} us in the '
            f'median, {1e6 * most:.0f} us at 99 %'
        )
        if not waits or _awaited(link, script_link.RECOVER, driver) is None:
            return
        if outcome.end is End.LOST:
            for remark in driver.connect():
                script.log.info(remark)
        controller.start()


def _awaited(link: Link, kind: int, driver: Driver | None = None) -> Any:
    """Wait for a message and return its content; None if the script closes or ends.

    The robot of a `driver` rests meanwhile.
    """
    while not link.broken:
        link.flush()
        if driver is None:
            link.wait(_POLL)
        else:
            driver.wait(_POLL)
        for got, content in link.messages():
            if got == script_link.CLOSE:
                return None
            if got == kind:
                return topic_link.decode(content)
    return None


if __name__ == '__main__':
    sys.exit(main())
