# SPDX-License-Identifier: Apache-2.0
"""Describe a contact for events, logs, stops and diagnostics."""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.perception import DISTANCE
from blf_dsc_controller.run import Contact


def contact_of(controller: Controller, config: ControllerConfig, stamp: int) -> Contact:
    """Return what the last sample, of a stamp [ns], shows of a contact."""
    sample = controller.sample
    worst = int(np.argmax(np.abs(sample.external) / sample.external_interval))
    joint = config.joints[worst]
    torque = float(sample.external[worst])
    interval = float(sample.external_interval[worst])
    text = (
        f'something touches the arm: the external torque is {torque:+.3g} N m on joint '
        f'{joint!r}, and model error and noise explain at most {interval:.3g} N m '
        f'(distance {sample.contact[DISTANCE]:.3g}, threshold {config.contact.threshold:g})'
    )
    return Contact(stamp, joint, torque, interval, text)
