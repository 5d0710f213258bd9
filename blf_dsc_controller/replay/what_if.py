# SPDX-License-Identifier: Apache-2.0
"""What another configuration would have commanded on the recorded states of any bag.

Open loop: the arm moved under the recorded torques, so learning uses those as the applied ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.bags.content import NO_NAMES, Content, NameMap, read_content
from blf_dsc_controller.bags.reader import applied_torque, single_run
from blf_dsc_controller.bags.sources import BagError
from blf_dsc_controller.bags.topic_messages import JointStates
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.law.factory import begin, controller_of
from blf_dsc_controller.law.telemetry import run_of
from blf_dsc_controller.messages.topics import JOINT_STATES, TRACKING_ERROR
from blf_dsc_controller.run import Floats, Run
from blf_dsc_controller.supervision.checks import Velocity

_NANO = 1e-9
_BLOCK = 65_536  # states checked at once


class WhatIf(NamedTuple):
    """Torques of another configuration beside the applied ones."""

    run: Run  # over the states that the law used, with its own torques
    applied: Floats  # torque from each state to the next (N, n), N m; NaN where unknown
    source: str  # topic of the applied torque
    left_out: int  # number of states that are not finite or follow an unknown torque
    error_ratio: Floats  # largest |xi1| / k_c of each joint (n,), with this reference

    @property
    def difference(self) -> Floats:
        """Torque of this configuration minus the applied one (N, n) [N m]."""
        return np.asarray(self.run.torque - self.applied)


def what_if(
    path: Path, config: ControllerConfig, namespace: str = '', names: NameMap = NO_NAMES
) -> WhatIf:
    """Run a configuration over the states of any bag (folder, storage file, or ROS 1 `.bag`).

    `namespace` is that of the robot, if the bag holds several; `names` maps topics and joints that
    have other names in the bag.

    Raises:
        BlfDscError: the bag cannot be read, or does not hold the applied torques.
        StartError: the law cannot take over in the first state, and approaches are disabled.
        MotionError: there is no approach within the limits.
    """
    content = read_content(path, namespace, names)
    every = _law_states(content, names.joints_of(config.joints))
    finite = np.concatenate([
        np.isfinite(every.field(0, rows) + every.field(1, rows)).all(axis=1)
        for rows in (slice(k, k + _BLOCK) for k in range(0, every.size, _BLOCK))
    ])  # fmt: skip
    states = every.select(np.flatnonzero(finite))
    source, torque = applied_torque(content, states)
    applied = torque.field(2)
    before = np.concatenate((applied[:1], applied[:-1]))
    known = np.flatnonzero(np.isfinite(before).all(axis=1))
    if not known.size:
        raise BagError(f'{path} holds no joint state that is finite and has a known torque')
    states, applied = states.select(known), applied[known]
    config = replace(config, learning=replace(config.learning, torque_source='effort'))
    if source != f'effort of {content.topics[JOINT_STATES].name}':
        config = replace(config, robot=replace(config.robot, effort='commanded'))
    run = _run_over(states, applied, config)
    ratio = np.abs(np.asarray(run.error) / np.asarray(run.bound)).max(axis=0)
    return WhatIf(run, applied, source, every.size - known.size, ratio)


def _law_states(content: Content, joints: Sequence[str]) -> JointStates:
    """Return the states that the law used, according to its telemetry; all if there is none.

    `joints` are the names in the bag. Raises BagError as `single_run`.
    """
    states, _, _ = single_run(content, joints, ('position', 'velocity'))
    errors = content.topics.get(TRACKING_ERROR)
    if errors is None:
        return states
    telemetry = errors.joint_states(errors.joint_names(), ())
    used = telemetry.stamp[np.isfinite(telemetry.field(0)).any(axis=1)]
    stamp = states.stamp
    lost = np.setdiff1d(used, stamp)
    kept = np.isin(stamp, used)
    if lost.size:
        kept &= stamp < lost[0]
    return states.select(np.flatnonzero(kept))


def _run_over(states: JointStates, applied: Floats, config: ControllerConfig) -> Run:
    """Run a configuration over states, between which the applied torques (N, n) acted."""
    controller = controller_of(config)
    n = len(states.names)
    stamps = states.stamp.tolist()
    recorded = np.hstack([states.field(k) for k in range(3)])
    measurements = recorded.copy()
    measurements[1:, 2 * n :] = applied[:-1]
    samples = np.empty((len(stamps), controller.sample_vector.size))
    last = stamps[0] - config.sample_time_ns
    velocity = Velocity(n) if config.safety.velocity == 'estimated' else None
    for k, (stamp, measurement) in enumerate(zip(stamps, measurements, strict=True)):
        if velocity is not None:
            velocity.replace(stamp, measurement)
        if k == 0:
            begin(controller, config, measurement[:n], measurement[n : 2 * n])
        controller.update((stamp - stamps[0]) * _NANO, (stamp - last) * _NANO, measurement)
        samples[k] = controller.sample_vector
        controller.weigh(config.sample_time)
        last = stamp
    return run_of(config, controller, states.stamp, recorded, samples)
