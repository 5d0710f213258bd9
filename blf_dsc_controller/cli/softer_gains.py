# SPDX-License-Identifier: Apache-2.0
"""What to paste after a stop because of an oscillation: softer gains, and the bounds they keep."""

from __future__ import annotations

import yaml

from blf_dsc_controller.commissioning.chosen import (
    as_parameters,
    widened_bounds,
    with_gains,
)
from blf_dsc_controller.configuration.controller import (
    ControllerConfig,
    used_design_of,
)
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.supervision.oscillation_check import LOWER, OSCILLATES
from blf_dsc_controller.warnings.expected_errors import expectation


def print_softer_gains(text: str, config: ControllerConfig) -> None:
    """Print what to paste after a stop with this text.

    Nothing, unless an arm of a URDF oscillated whose joints have gains, each on its own.
    """
    if OSCILLATES not in text or config.model != 'urdf':
        return
    arm = used_design_of(config)
    if arm.joints is None:
        return
    gains = arm.joints.scaled(LOWER * arm.stiffness)
    values = as_parameters(gains.stiffness.round(3), gains.damping.round(3))
    softer = with_gains(config, values)
    try:
        values |= widened_bounds(softer)
    except BlfDscError:
        tool = ' and a barrier.tool_bound' if config.barrier.tool_bound else ''
        print(
            f'no bounds were found for half of these gains, with a robot.payload of '
            f'{config.robot.payload:g} kg{tool}: commission the arm (`blf_dsc commission`)'
        )
        return
    listed = {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in values.items()
    }
    section = {'/**/blf_dsc_controller': {'ros__parameters': listed}}
    print(
        'put these parameters in the place of those in the file, whose others stay: half of these '
        'gains, and the bounds that they keep. At the frequency of the oscillation their margin is '
        '0.5 if it just went on, and less if it grew: halve them again if the arm stops again, or '
        'commission it. Errors to '
        f'expect: {expectation(change(softer, values))}\n'
        f'{yaml.safe_dump(section, default_flow_style=None, sort_keys=False, width=1000)}',
        end='',
    )
