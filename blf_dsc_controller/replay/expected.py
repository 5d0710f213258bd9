# SPDX-License-Identifier: Apache-2.0
"""What the controller's topics must hold after a replay: a name and a column for each number."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from blf_dsc_controller.bags.batch import decode_joint_states
from blf_dsc_controller.bags.content import TopicMessages
from blf_dsc_controller.law.factory import estimate_names
from blf_dsc_controller.messages.cdr import JointStateLayout
from blf_dsc_controller.messages.monitor import Monitor
from blf_dsc_controller.messages.names import LAMBDA_MIN, LATCHED
from blf_dsc_controller.messages.telemetry import DECIMATION, disturbance_names
from blf_dsc_controller.messages.topics import (
    COMMANDS,
    LEARNING,
    MONITOR,
    REFERENCE,
    TRACKING_ERROR,
    Topic,
)
from blf_dsc_controller.replay.law import Replayed
from blf_dsc_controller.replay.states import States
from blf_dsc_controller.run import Floats

Columns = Mapping[str, Floats]
"""Values (N,) by the field that holds them, as in `velocity of joint1` or `lambda_min`."""


def expected(
    replayed: Replayed, states: States, monitored: Mapping[int, bytes]
) -> dict[Topic, Columns]:
    """Columns of every topic of the controller, over the samples.

    Args:
        replayed: what the law told.
        states: of N samples, that it answered.
        monitored: messages of the monitor, by the number of their sample.
    """
    told, config = replayed.told, replayed.config
    joints = config.joints
    return {
        COMMANDS: _of_joints(joints, effort=told.torque),
        TRACKING_ERROR: _of_joints(
            joints, position=told.xi1, velocity=told.xi2, effort=told.torque
        ),
        REFERENCE: _of_joints(joints, position=told.qr, velocity=told.dqr),
        LEARNING: {
            **dict(zip(estimate_names(config), told.estimate.T, strict=True)),
            **dict(zip(disturbance_names(joints), told.disturbance.T, strict=True)),
            LAMBDA_MIN: told.lambda_min[:, 0],
            LATCHED: told.latched[:, 0],
        },
        MONITOR: _table(monitored, states),
    }


def monitored(replayed: Replayed, states: States, bound: Floats) -> dict[int, bytes]:
    """What the monitor says of every tenth sample.

    Args:
        replayed: what the law told.
        states: of N samples, that it answered, without a break.
        bound: k_c of each sample (N, n) [rad].
    """
    config = replayed.config
    monitor = Monitor(config.joints, estimate_names(config), replayed.settings)
    ratio = np.fmax.accumulate(np.abs(replayed.told.xi1) / replayed.told.bound)
    return {
        k: monitor.message(int(states.stamp[k]), replayed.sample(k), ratio[k], bound[k])[1]
        for k in range(0, states.stamp.size, DECIMATION)
    }


def _table(monitored: Mapping[int, bytes], states: States) -> Columns:
    """Columns of the monitor; NaN between its messages."""
    if not monitored:
        return {}
    messages = list(monitored.values())
    names = JointStateLayout.parse(messages[0]).names
    _, values = decode_joint_states(TopicMessages(MONITOR.resolved, raw=messages), names, ())
    table = np.full((states.stamp.size, len(names)), np.nan)
    table[list(monitored)] = values[:, 0]
    return dict(zip(names, table.T, strict=True))


def _of_joints(joints: Sequence[str], **fields: Floats) -> dict[str, Floats]:
    return {
        f'{field} of {joint}': column
        for field, values in fields.items()
        for joint, column in zip(joints, values.T, strict=True)
    }
