# SPDX-License-Identifier: Apache-2.0
"""Contacts of an arm: sentences about them, and whether the arm holds after one."""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.perception import DISTANCE
from blf_dsc_controller.reference.retargeting import TrajectoryError
from blf_dsc_controller.run import Contact


def contact_of(controller: Controller, config: ControllerConfig, stamp: int) -> Contact:
    """Return the contact of the last sample, whose stamp is in ns, with its sentence."""
    sample = controller.sample
    worst = int(np.argmax(np.abs(sample.external) / sample.external_interval))
    joint, unit = config.joints[worst], config.units[worst].torque
    torque = float(sample.external[worst])
    interval = float(sample.external_interval[worst])
    text = (
        f'something touches the arm: the external torque is {torque:+.3g} {unit} on joint '
        f'{joint!r}, and model error and noise explain at most {interval:.3g} {unit} '
        f'(distance {sample.contact[DISTANCE]:.3g}, threshold {config.contact.threshold:g})'
    )
    return Contact(stamp, joint, torque, interval, text)


class Contacts:
    """The contacts of an arm so far.

    Attributes:
        last: the last contact; None: nothing so far.
        count: contacts so far.
        hold: whether the reference rests since the last one, until the next trajectory.
    """

    def __init__(self) -> None:
        self.last: Contact | None = None
        self.count = 0
        self.hold = False

    def add(self, contact: Contact) -> None:
        """Count a contact."""
        self.last = contact
        self.count += 1

    def check_target(self) -> None:
        """Check that the arm may follow a target, which could lead back into what it has touched.

        Raises:
            TrajectoryError: the arm holds since a contact.
        """
        if self.hold:
            remedy = 'send a trajectory that leads away from it, or call reset'
            why = self.last.text if self.last else ''
            raise TrajectoryError([f'{why}, and the arm holds: {remedy}'])
