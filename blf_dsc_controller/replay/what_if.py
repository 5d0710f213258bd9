# SPDX-License-Identifier: Apache-2.0
"""What another configuration would have commanded on the recorded states of any bag.

Open loop: the arm moved under the recorded torques. Learning therefore gets those as the applied
ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.bags.content import (
    NO_NAMES,
    Content,
    NameMap,
    TopicMessages,
    decode_arrays,
    decode_joint_states,
    first_layout,
    read_content,
)
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.law.factory import begin, controller_of
from blf_dsc_controller.messages.samples import columns_of, run_of
from blf_dsc_controller.messages.topics import COMMANDS, JOINT_STATE, JOINT_STATES, TRACKING_ERROR
from blf_dsc_controller.replay.states import States, law_states
from blf_dsc_controller.run import Floats, Run, Series, Stamps
from blf_dsc_controller.supervision.velocity import Velocity

_NANO = 1e-9


class WhatIf(NamedTuple):
    """Torques of another configuration beside the applied ones."""

    run: Run  # over the states that the law used, with its own torques
    rows: Floats  # of the window's regression in each sample, [X | u] (N, n, m + 1)
    active: Floats  # which disturbance columns are estimated at the end (m,)
    applied: Floats  # torque from each state to the next (N, n), N m; NaN where unknown
    source: str  # topic that it comes from
    error_ratio: Floats  # largest |xi1| / k_c of each joint (n,), against this reference

    @property
    def difference(self) -> Floats:
        """Torque of this configuration less the applied one (N, n) [N m]."""
        return np.asarray(self.run.torque - self.applied)


def what_if(
    path: Path, config: ControllerConfig, namespace: str = '', names: NameMap = NO_NAMES
) -> WhatIf:
    """Run a configuration over the states of any bag (folder, storage file, or ROS 1 `.bag`).

    `namespace` is that of the robot, if the bag holds several; `names` are those of topics and
    joints that have other names in the bag.

    Raises:
        StartError: the law cannot take over in the first state, and approaches are disabled.
        MotionError: there is no approach within the limits.
        BlfDscError: the bag cannot be read, or it does not hold the applied torques.
    """
    content = read_content(path, namespace, names)
    joints = names.joints_of(config.joints)
    states = law_states(content, joints)
    applied, source = applied_torque(path, content, states, joints)
    config = replace(config, learning=replace(config.learning, torque_source='effort'))
    controller = controller_of(config)
    n, m = len(joints), controller.settings.m
    measurements = states.measurement.copy()
    measurements[1:, 2 * n :] = applied[:-1]
    samples = np.empty((states.stamp.size, controller.sample_vector.size))
    rows = np.zeros((states.stamp.size, n, m + 1))
    stamps = states.stamp.tolist()
    last = stamps[0] - config.sample_time_ns
    velocity = Velocity(config.safety.velocity, n)
    for k, (stamp, measurement) in enumerate(zip(stamps, measurements, strict=True)):
        q, dq = measurement[:n], measurement[n : 2 * n]
        velocity.replace(stamp, q, dq)
        if k == 0:
            begin(controller, config, q, dq)
        controller.update((stamp - stamps[0]) * _NANO, (stamp - last) * _NANO, measurement)
        samples[k] = controller.sample_vector
        rows[k] = controller.signals.row
        last = stamp
    run = run_of(config, controller, states.stamp, states.measurement, samples)
    columns = columns_of(samples, controller.settings)
    ratio = (np.abs(columns.xi1) / columns.bound).max(axis=0)
    return WhatIf(run, rows, controller.state.active.copy(), applied, source, ratio)


def applied_torque(
    path: Path, content: Content, states: States, joints: Sequence[str]
) -> tuple[Floats, str]:
    """Torque from each of the n joints' states to the next (N, n) [N m], and its topic.

    In this order: the saturated torque of the controller's telemetry, the commands, the effort of
    the next state.

    Raises:
        BlfDscError: the bag holds none of them.
    """
    if TRACKING_ERROR in content.topics:
        recorded = content.topics[TRACKING_ERROR]
        stamp, values = decode_joint_states(recorded, joints, ('effort',))
        torque = Series(tuple(joints), stamp, values[:, 2]).exact(states.stamp)
        return torque, f'effort of {recorded.name}'
    if COMMANDS in content.topics:
        recorded = content.topics[COMMANDS]
        return _commanded(content, recorded, states, joints), recorded.name
    effort = states.measurement[:, 2 * len(joints) :]
    if np.isnan(effort).all():
        reason = (
            f'{path} does not hold the torques: there is no topic of commands (name it: --map '
            'commands=/its/name) and the effort of the joint states is empty'
        )
        raise BlfDscError(reason)
    last = np.full((1, len(joints)), np.nan)
    return np.vstack([effort[1:], last]), f'effort of {content.topics[JOINT_STATES].name}'


def _commanded(
    content: Content, recorded: TopicMessages, states: States, joints: Sequence[str]
) -> Floats:
    """Command after each state: the k-th, or the last before the next state if counts differ."""
    torque = _command_values(content, recorded, joints)
    if len(recorded.raw) == states.stamp.size:
        return torque
    received = np.array(content.topics[JOINT_STATES].received, dtype=np.int64)
    stamp, _ = decode_joint_states(content.topics[JOINT_STATES], joints)
    came = np.array(recorded.received, dtype=np.int64)
    of_state = dict(zip(stamp.tolist(), received.tolist(), strict=True))
    moments: Stamps = np.array([of_state[one] for one in states.stamp.tolist()], dtype=np.int64)
    until = np.append(moments[1:], np.iinfo(np.int64).max)
    index = np.searchsorted(came, until) - 1
    held = torque[np.maximum(index, 0)]
    held[index < 0] = np.nan
    return held


def _command_values(content: Content, recorded: TopicMessages, joints: Sequence[str]) -> Floats:
    """Commands (m, n): by name, or in the order of the joints, or in that of the joint states."""
    if recorded.type == JOINT_STATE:
        return decode_joint_states(recorded, joints, ('effort',))[1][:, 2]
    size = first_layout(recorded).arrays[0].size
    values = decode_arrays(recorded, size)
    states = first_layout(content.topics[JOINT_STATES])
    names = states.names
    if values is None or size not in (len(joints), len(names)):
        reason = (
            f'{recorded.name} has {size} values, but there are {len(joints)} joints, and '
            f'{len(names)} in the joint states ({", ".join(names)}): their order is not known'
        )
        raise BlfDscError(reason)
    return values if size == len(joints) else values[:, states.columns_of(joints)]
