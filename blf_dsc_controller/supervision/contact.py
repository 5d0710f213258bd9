# SPDX-License-Identifier: Apache-2.0
"""What a contact is called in events, logs and stops."""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.external_torque import DISTANCE


def contact_text(controller: Controller, config: ControllerConfig) -> str:
    """Return what the last sample shows of a contact: the joint that shows it most."""
    sample = controller.sample
    worst = int(np.argmax(np.abs(sample.external) / sample.external_interval))
    torque = sample.external[worst]
    interval = sample.external_interval[worst]
    return (
        f'something touches the arm: {torque:+.3g} N m from outside on joint '
        f'{config.joints[worst]!r}, where model and noise explain {interval:.3g} N m '
        f'(distance {sample.contact[DISTANCE]:.3g}, threshold {config.contact.threshold:g})'
    )
