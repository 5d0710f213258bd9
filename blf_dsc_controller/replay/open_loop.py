# SPDX-License-Identifier: Apache-2.0
"""What another configuration would have commanded on the recorded states.

Open loop: the arm moved under the recorded torques and does not feel these. The learning is
therefore given the torques that did act.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from blf_dsc_controller.bags.content import NO_NAMES, NameMap, read_content
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.replay.law import Replayed, run_law
from blf_dsc_controller.replay.states import States, answered_states
from blf_dsc_controller.replay.torques import applied_torque
from blf_dsc_controller.run import Floats


@dataclass(frozen=True)
class Answer:
    """Torques of another configuration beside those that acted.

    Attributes:
        states: that were answered.
        replayed: what the law told.
        applied: torque that acted from each state to the next (N, n) [N m]; NaN where unknown.
        source: in words, where those come from.
    """

    states: States
    replayed: Replayed
    applied: Floats
    source: str

    @property
    def difference(self) -> Floats:
        """Replayed less applied torque (N, n) [N m]."""
        return np.asarray(self.replayed.told.torque - self.applied)

    @property
    def error_ratio(self) -> Floats:
        """Largest |xi1| / k_c of each joint (n,), against the reference of this configuration."""
        told = self.replayed.told
        return np.asarray((np.abs(told.xi1) / told.bound).max(axis=0))


def answer(
    path: Path, config: ControllerConfig, namespace: str = '', names: NameMap = NO_NAMES
) -> Answer:
    """Run a configuration over the states of any bag.

    Args:
        path: folder of the bag, one of its storage files, or a ROS 1 `.bag`.
        config: of the controller.
        namespace: of the robot to look at, if the bag holds several.
        names: of topics and joints that are called otherwise in the bag.

    Raises:
        NoTorqueError: the bag does not tell which torques acted.
        BlfDscError: the bag, or a message in it, cannot be read.
    """
    content = read_content(path, namespace, names)
    joints = names.joints_of(config.joints)
    states = answered_states(content, joints)
    applied, source = applied_torque(path, content, states, joints)
    measurement = states.measurement.copy()
    n = len(joints)
    measurement[1:, 2 * n :] = applied[:-1]
    learning = replace(config.learning, torque_source='effort')
    replayed = run_law(replace(config, learning=learning), replace(states, measurement=measurement))
    return Answer(states, replayed, applied, source)
