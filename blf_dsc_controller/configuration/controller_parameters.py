# SPDX-License-Identifier: Apache-2.0
"""Parameters of the controller, and what they say together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from blf_dsc_controller.configuration import law_file
from blf_dsc_controller.configuration.controller_groups import (
    Barrier,
    CommissionedGains,
    Contact,
    DeclaredLoad,
    DisturbanceEstimate,
    Feedback,
    Learning,
    Safety,
    Telemetry,
    Torque,
    sizing,
)
from blf_dsc_controller.configuration.law_traits import (
    LAWS,
    OWN,
    Traits,
    has_exact_rows,
    traits_of,
)
from blf_dsc_controller.configuration.motion_groups import (
    MotionLimits,
    Reference,
)
from blf_dsc_controller.configuration.robot import ArmConfig
from blf_dsc_controller.configuration.schema import flatten
from blf_dsc_controller.run import JointUnits, joint_units


@dataclass(frozen=True)
class ControllerParameters(ArmConfig):
    """Parameters of the controller, each valid by itself."""

    law: str = sizing(
        'blf_dsc',
        f'control law: {", ".join(LAWS)}, or a Python file that defines one',
        kept=law_file.kept,
    )
    reference: Reference = Reference()
    limits: MotionLimits = MotionLimits()
    barrier: Barrier = Barrier()
    feedback: Feedback = Feedback()
    disturbance: DisturbanceEstimate = DisturbanceEstimate()
    torque: Torque = Torque()
    learning: Learning = Learning()
    load: DeclaredLoad = DeclaredLoad()
    contact: Contact = Contact()
    safety: Safety = Safety()
    telemetry: Telemetry = Telemetry()
    commissioning: CommissionedGains = CommissionedGains()

    @property
    def model(self) -> Literal['two_link', 'urdf']:
        """Model of the arm: that of its URDF, or the paper's two links without one."""
        return 'urdf' if self.robot.urdf else 'two_link'

    @property
    def units(self) -> tuple[JointUnits, ...]:
        """Units of each joint."""
        return tuple(map(joint_units, self.robot.kinds(self.joints)))

    @property
    def traits(self) -> Traits:
        """What the law does; that of a file says so itself."""
        return traits_of(self.law, getattr(self, law_file.GROUP, None))

    @property
    def weighs(self) -> bool:
        """Whether what `robot.tip` holds is weighed: by exact rows of an arm from a URDF."""
        return self.model == 'urdf' and self.has_exact_rows

    @property
    def learns_load_friction(self) -> bool:
        """Whether friction that grows with the load is learned: a torque loop hides it."""
        is_soft = self.law == OWN and self.feedback.inertia == 'none'
        return self.weighs and is_soft and not self.robot.torque_loop

    @property
    def has_torque_sensors(self) -> bool:
        """Whether efforts are said to be of joint torque sensors, for a law that uses them."""
        says = self.robot.torque_loop and self.robot.effort == 'whole'
        return says and self.law == OWN and self.model == 'urdf'

    @property
    def observes_load(self) -> bool:
        """Whether the load is observed by joint torque sensors."""
        return self.disturbance.observer_bandwidth > 0.0 and self.has_torque_sensors

    @property
    def has_exact_rows(self) -> bool:
        """Whether loads and contacts show in the rows that the law learns from."""
        return has_exact_rows(flatten(self))
