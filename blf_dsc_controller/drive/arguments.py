# SPDX-License-Identifier: Apache-2.0
"""What a script gives to a `Drive`: refused in one line if it is something else."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from blf_dsc_controller.errors import BlfDscError, DriveError
from blf_dsc_controller.messages.tip_load import TipLoad
from blf_dsc_controller.reference.trajectory import LONGEST

_TURNS = 4.0 * math.pi  # rad, beyond which hardly a joint turns
_NODES = ('blf_dsc_controller', 'drive', 'sim_plant')
_SUCH_AS = "give them by node and name, as in {'drive': {'feedback': 'motor'}}"


def checked_config(config: object) -> str:
    """Return a parameter file or a preset as text."""
    if isinstance(config, (str, os.PathLike)):
        return os.fspath(config)
    raise DriveError(
        f'config: got {_kind(config)}, but a parameter file or the name of a preset is needed; '
        'overrides take values of single parameters'
    )


def checked_robot(robot: object) -> str:
    """Return the address of a robot."""
    if isinstance(robot, str) and robot.strip():
        return robot
    raise DriveError(f"robot: got {robot!r}, but its address is needed, or 'simulated'")


def checked_record(record: object) -> Path | None:
    """Return the folder of a bag; None: none."""
    if record is None:
        return None
    if isinstance(record, (str, os.PathLike)):
        return Path(record)
    raise DriveError(f"record: got {record!r}, but a new folder is needed, as in 'bag'")


def checked_overrides(overrides: object) -> dict[str, dict[str, Any]]:
    """Return values by node and name, as JSON has them."""
    if overrides is None:
        return {}
    if not isinstance(overrides, Mapping):
        raise DriveError(f'overrides: got {_kind(overrides)}: {_SUCH_AS}')
    for node, values in overrides.items():
        if node not in _NODES:
            raise DriveError(
                f'overrides: got {node!r}, but the nodes of a Drive are {", ".join(_NODES)}: '
                f'{_SUCH_AS}'
            )
        if not isinstance(values, Mapping):
            raise DriveError(f'overrides: {node}: got {_kind(values)}: {_SUCH_AS}')
    return {
        node: {str(name): _plain(name, value) for name, value in values.items()}
        for node, values in overrides.items()
    }


def _plain(name: object, value: object) -> Any:
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, (list, tuple)):
        return [_plain(name, each) for each in value]
    if value is None or isinstance(value, (str, int, float)):
        return value
    raise DriveError(
        f'overrides: {name}: got {_kind(value)}, but a number, a text, a truth value or a list of '
        'them is needed'
    )


def checked_positions(positions: ArrayLike, joints: Sequence[str]) -> NDArray[Any]:
    """Return positions (n,) of n joints [rad]."""
    try:
        values = np.asarray(positions, float)
    except (TypeError, ValueError):  # text, names, lists of different lengths
        raise _no_positions(positions, joints) from None
    if values.shape != (len(joints),) or not np.isfinite(values).all():
        got = values.tolist() if values.ndim else positions
        raise _no_positions(got, joints)
    return values


def _no_positions(got: object, joints: Sequence[str]) -> DriveError:
    return DriveError(
        f'positions: got {got!r}, but {len(joints)} finite values are needed, one for each of '
        f'{", ".join(joints)}'
    )


def hint_at_degrees(positions: ArrayLike) -> str:
    """Return what to write if positions may be degrees, for an error of theirs; or empty."""
    if np.abs(positions).max() <= _TURNS:
        return ''
    return '; positions are in rad: if these are degrees, give np.deg2rad of them'


def checked_speed(speed: Any) -> float:
    """Return a share of the limits."""
    if _is_number(speed) and 0.0 < speed <= 1.0:
        return float(speed)
    raise DriveError(
        f'speed: got {speed!r}, but a share of the limits is needed: above 0, up to 1'
    )


def checked_timeout(timeout: Any) -> float:
    """Return a time [s]; infinite: for ever."""
    if timeout is None:
        return math.inf
    if _is_number(timeout) and timeout >= 0.0:
        return float(timeout)
    raise DriveError(
        f'timeout: got {timeout!r}, but seconds from 0 on are needed, or None: for ever'
    )


def checked_begin(begin: Any) -> float | None:
    """Return a time of the wall clock [s]; None: now."""
    if begin is None:
        return None
    if _is_number(begin) and abs(begin - time.time()) <= LONGEST:
        return float(begin)
    raise DriveError(
        f'begin: got {begin!r}, but a time of the wall clock in s is needed, as in '
        'time.time() + 1.0, within an hour of now'
    )


def checked_load(mass: Any, centre: Any) -> dict[str, Any]:
    """Return a load [kg] and its centre (3,) [m] as JSON has them."""
    try:
        load = TipLoad.given(mass, centre)
    except BlfDscError as error:
        raise DriveError(str(error)) from None
    return {'mass': load.mass, 'centre': list(load.centre)}


def checked_interval(interval: Any) -> float:
    """Return the time [s] in which a tip takes up a load."""
    if _is_number(interval):
        return float(interval)
    raise DriveError(f'interval: got {interval!r}, but seconds are needed')


def checked_joints(joints: Any) -> list[str]:
    """Return names of joints."""
    is_text = isinstance(joints, str) or not isinstance(joints, Sequence)
    if is_text or not all(isinstance(each, str) for each in joints):
        raise DriveError(
            f"joints: got {joints!r}, but a list of names is needed, as in ['joint1', 'joint2']"
        )
    return list(joints)


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float, np.integer, np.floating))


def _kind(value: object) -> str:
    return type(value).__name__
