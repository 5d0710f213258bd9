# SPDX-License-Identifier: Apache-2.0
"""The controller of a configuration, and the start of its reference."""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.law_file import errors_told_with_line
from blf_dsc_controller.errors import check_type
from blf_dsc_controller.factory.laws import law_of
from blf_dsc_controller.factory.settings import settings_of_config
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.reference.approach import plan_start, reference_of


def controller_of(config: ControllerConfig) -> Controller:
    """Return the controller of a configuration, compiled and in its initial state.

    Raises ArgumentTypeError if it is another configuration.
    """
    check_type(
        'config', config, ControllerConfig, 'load_loop returns it as .controller'
    )
    with errors_told_with_line(config.law):
        return Controller(
            law_of(config), settings_of_config(config), reference_of(config)
        )


def begin(
    controller: Controller,
    config: ControllerConfig,
    q: np.ndarray,
    dq: np.ndarray,
    t: float = 0.0,
) -> float:
    """Set the planned reference of the controller; return when [s] the approach ends, or `t`.

    Arguments and errors are those of `plan_start`.
    """
    motion = plan_start(config, controller.bound_at(t), q, dq, t)
    controller.reference_vector = motion.vector
    return motion.settled
