# SPDX-License-Identifier: Apache-2.0
"""Where a robot's joints are, without a torque: compare with its URDF before it moves.

    python -m blf_dsc_controller.drive.show_joints --robot can0 --config yam

Turn a joint by hand: the number must grow as the URDF turns it, and be 0 at its zero.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, suppress

import numpy as np
from numpy.typing import ArrayLike

from blf_dsc_controller.arms.urdf import Chain
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import CONTROLLER, load, locate
from blf_dsc_controller.drive.drivers import driver_of
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.run import joint_units

_TURN = 2.0 * np.pi  # rad


def lines(chain: Chain, positions: ArrayLike) -> Iterator[str]:
    """Yield a line for each joint at positions (n,) [rad or m], which says if they cannot be."""
    for joint, q in zip(chain.joints, np.asarray(positions, np.float64), strict=True):
        unit = joint_units(joint.kind).position
        text = (
            f'{joint.name:24} {q:8.3f} of {joint.lower:.2f} to {joint.upper:.2f} {unit}'
        )
        if joint.lower <= q <= joint.upper:
            yield text
            continue
        shifts = (-_TURN, _TURN) if unit == 'rad' else ()
        turns = [s for s in shifts if joint.lower <= q + s <= joint.upper]
        hint = f': {turns[0]:+.3f} rad, a turn, would be within' if turns else ''
        yield f'{text}: outside{hint}'


def _show(robot: str, given: str, period: float) -> None:
    path = locate(given)
    config = load(path, CONTROLLER, ControllerConfig)
    chain = config.robot.chain(config.joints)
    with (
        closing(driver_of(robot, path, config)) as driver,
        suppress(KeyboardInterrupt),
    ):
        driver.connect()
        while True:
            print('\n'.join(lines(chain, driver.positions())), flush=True)  # noqa: T201
            if not period:
                break
            time.sleep(period)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the joints again and again, until Ctrl-C; return an exit code."""
    parser = argparse.ArgumentParser(prog='show_joints', description=__doc__)
    parser.add_argument('--robot', required=True, help='its address')
    parser.add_argument('--config', required=True, help='parameter file or preset')
    parser.add_argument('--period', type=float, default=0.5, help='s; 0: once')
    options = parser.parse_args(arguments)
    try:
        _show(options.robot, options.config, options.period)
    except BlfDscError as error:
        print(f'show_joints: {error}', file=sys.stderr)  # noqa: T201
        return 1
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
