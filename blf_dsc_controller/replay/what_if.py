# SPDX-License-Identifier: Apache-2.0
"""What another configuration would have commanded on the recorded states of any bag.

Open loop: the arm moved under the recorded torques. Learning therefore gets those as the applied
ones.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from blf_dsc_controller.bags.content import NO_NAMES, NameMap, read_content
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.law.factory import begin, controller_of
from blf_dsc_controller.law.sample import Sample
from blf_dsc_controller.replay.rerun import columns_of
from blf_dsc_controller.replay.states import States, law_states
from blf_dsc_controller.replay.torques import applied_torque
from blf_dsc_controller.run import Floats
from blf_dsc_controller.supervision.velocity import Velocity

_NANO = 1e-9


@dataclass(frozen=True)
class WhatIf:
    """Torques of another configuration beside the applied ones.

    Attributes:
        states: that the law used.
        samples: columns of the law's telemetry samples, each (N, its length).
        rows: of the window's regression in each sample, [X | u] (N, n, m + 1).
        active: which disturbance columns are estimated at the end (m,).
        applied: torque from each state to the next (N, n) [N m]; NaN where unknown.
        source: topic that it comes from.
    """

    states: States
    samples: Sample
    rows: Floats
    active: Floats
    applied: Floats
    source: str

    @property
    def difference(self) -> Floats:
        """Torque of this configuration less the applied one (N, n) [N m]."""
        return np.asarray(self.samples.torque - self.applied)

    @property
    def error_ratio(self) -> Floats:
        """Largest |xi1| / k_c of each joint (n,), against the reference of this configuration."""
        return np.asarray((np.abs(self.samples.xi1) / self.samples.bound).max(axis=0))


def what_if(
    path: Path, config: ControllerConfig, namespace: str = '', names: NameMap = NO_NAMES
) -> WhatIf:
    """Run a configuration over the states of any bag.

    Args:
        path: folder of the bag, one of its storage files, or a ROS 1 `.bag`.
        config: of the controller.
        namespace: of the robot, if the bag holds several.
        names: of topics and joints that have other names in the bag.

    Raises:
        OutsideBarrierError: the first state is outside the bound, and approaches are disabled.
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
    columns = columns_of(samples, controller.settings)
    return WhatIf(states, columns, rows, controller.state.active.copy(), applied, source)
