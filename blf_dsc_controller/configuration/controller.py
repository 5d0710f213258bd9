# SPDX-License-Identifier: Apache-2.0
"""Parameters of the controller, and what they ask of each other."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from blf_dsc_controller.arms import tuning
from blf_dsc_controller.arms.known_gears import Gears
from blf_dsc_controller.arms.model import arm_model
from blf_dsc_controller.configuration import (
    law_file,
    plausibility,
    tool_bound,
    two_link,
)
from blf_dsc_controller.configuration.arm_defaults import (
    followed_by,
    stated_design,
    used_design,
)
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
    PAPER,
    gains_of,
    has_exact_rows,
    traits_of,
)
from blf_dsc_controller.configuration.motion_groups import (
    MotionLimits,
    Reference,
)
from blf_dsc_controller.configuration.robot import (
    ArmConfig,
    parameters_of,
)
from blf_dsc_controller.configuration.schema import (
    Value,
    build,
    flatten,
)
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.run import JointUnits, joint_units


@dataclass(frozen=True)
class ControllerConfig(ArmConfig):
    """Parameters of the node `blf_dsc_controller`; the defaults are the recommended set."""

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

    @classmethod
    def variant(cls, given: Mapping[str, Any]) -> type[ControllerConfig]:
        """Return the configuration with the gains that only the given law has.

        Raises BlfDscError if there is no such law.
        """
        law = given.get('law', OWN)
        gains = gains_of(law) if isinstance(law, str) else None
        return _with_groups(gains, planar=not given.get('robot.urdf'))

    @property
    def model(self) -> Literal['two_link', 'urdf']:
        """Model of the arm: that of its URDF, or the paper's two links without one."""
        return 'urdf' if self.robot.urdf else 'two_link'

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle by values.

        The class with the gains of a law is made when they are read.
        """
        return build, (ControllerConfig, flatten(self))

    @classmethod
    def defaults(cls, given: Mapping[str, Any]) -> Mapping[str, Value]:
        """Return gains and limits for the arm of a URDF; the defaults suit the two-link arm."""
        return followed_by(given)

    @property
    def units(self) -> tuple[JointUnits, ...]:
        """Units of each joint."""
        return tuple(map(joint_units, self.robot.kinds(self.joints)))

    def problems(self) -> Iterator[str]:
        """Check the parameters against each other and against the model."""
        yield from self._drive_load_problems()
        yield from self._contact_problems()
        yield from self._stiffness_problems()
        yield from self.arm_problems(f'model {self.model}', self._needed_joints())
        yield from self.reference.problems()
        yield from self.limits.problems(self.joints, self.units)
        yield from tool_bound.problems(self)
        yield from self.learning.problems(self.sample_time)
        yield from plausibility.problems_of_controller(self)

    def _needed_joints(self) -> int | None:
        """Return how many joints the model needs; None for any."""
        if self.model == 'urdf':
            return None
        given = two_link.two_link(self)
        return arm_model(given.l1, given.gravity).n

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

    def _drive_load_problems(self) -> Iterator[str]:
        """Check that the load can be declared to the drives, and how."""
        load = self.load
        compensates = self.robot.drive_compensates != 'none'
        if load.tell_drive and not (self.weighs and compensates):
            yield (
                f'load.tell_drive: got true with model {self.model}, law {self.law} and '
                f'robot.drive_compensates {self.robot.drive_compensates}, but needs a load that is '
                f'weighed, by robot.urdf and {OWN}, and drives that compensate gravity'
            )
        if load.service and not load.tell_drive:
            yield (
                f'load.service: got {load.service}, but load.tell_drive is '
                'false: set it to true'
            )
        if load.frame:
            to_frame = dataclasses.replace(self.robot, tip=load.frame)
            try:
                to_frame.chain(self.joints)
            except BlfDscError as error:
                yield f'load.frame: {error}'

    def _contact_problems(self) -> Iterator[str]:
        """Check that contacts are found, and by a law that can find them."""
        contact = self.contact
        can_find = traits_of(self).learns and self.has_exact_rows
        if contact.enabled and not can_find:
            yield (
                f'contact.enabled: got true with law {self.law}, but the external torque needs a '
                f'law that learns, such as {OWN}'
            )
        if contact.reaction != 'none' and not contact.enabled:
            yield (
                f'contact.reaction: got {contact.reaction}, but without contact.enabled nothing '
                'finds contacts: set it to true'
            )

    def _stiffness_problems(self) -> Iterator[str]:
        """Check that the gains follow from what is given of the feedback."""
        feedback = self.feedback
        if self.model != 'urdf' and feedback.stiffness != Feedback().stiffness:
            yield (
                f'feedback.stiffness: got {feedback.stiffness:g} with model {self.model}, but only '
                'the gains of an arm from a URDF follow from it: leave it at 1, and lower '
                'two_link.feedback_gain and two_link.surface_gain'
            )
        if feedback.inertia == 'whole' and feedback.stiffness > 1.0:
            yield (
                f'feedback.stiffness: got {feedback.stiffness:g} with feedback.inertia whole, but '
                'the delay of the loop allows at most 1'
            )
        if any(feedback.joint_damping_lag) and feedback.inertia == 'whole':
            yield (
                f'feedback.joint_damping_lag: got {max(feedback.joint_damping_lag):g} s with '
                'feedback.inertia whole, whose damping has no lag: set it to 0'
            )
        yield from self._joint_gain_problems()

    def _joint_gain_problems(self) -> Iterator[str]:
        """Check that stiffness and damping of joints are both given, and act."""
        feedback = self.feedback
        given = bool(feedback.joint_stiffness), bool(feedback.joint_damping)
        acts = feedback.inertia == 'none' and self.model == 'urdf'
        if any(given) and self.law in (OWN, PAPER) and not acts:
            yield (
                'feedback.joint_stiffness, feedback.joint_damping: gains follow from them only '
                f'for a URDF with feedback.inertia none, but got {feedback.inertia} and model '
                f'{self.model}'
            )
        elif any(given) and not all(given):
            yield (
                'feedback.joint_stiffness, feedback.joint_damping: one of them is given, but '
                'they belong together: give both'
            )
        elif all(given) and 0.0 in (*feedback.joint_stiffness, *feedback.joint_damping):
            yield (
                'feedback.joint_stiffness, feedback.joint_damping: got 0 for a joint, but each '
                'must be above 0'
            )


def used_design_of(config: ControllerConfig) -> tuning.Design:
    """Return what the gains of an arm from a URDF follow from: its gears, if nothing is given."""
    chain = config.robot.chain(config.joints)
    base = parameters_of(config.robot, chain)
    return used_design(flatten(config), config.robot, chain, base)


def design_of(config: ControllerConfig) -> tuple[tuning.Design, Gears | None]:
    """Return what the gains of an arm from a URDF follow from, and its gears, if known."""
    chain = config.robot.chain(config.joints)
    base = parameters_of(config.robot, chain)
    return stated_design(flatten(config), config.robot, chain, base)


@functools.cache
def _with_groups(gains: type | None, *, planar: bool) -> type[ControllerConfig]:
    """Return the configuration with the gains of a law, and those of two links."""
    groups: dict[str, type] = {}
    if planar:
        groups[two_link.GROUP] = two_link.TwoLink
    if gains:
        groups[law_file.GROUP] = gains
    if not groups:
        return ControllerConfig
    return dataclasses.make_dataclass(
        'ControllerConfig',
        [
            (name, group, dataclasses.field(default=group()))
            for name, group in groups.items()
        ],
        bases=(ControllerConfig,),
        frozen=True,
    )
