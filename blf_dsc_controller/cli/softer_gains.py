# SPDX-License-Identifier: Apache-2.0
"""What to paste after a stop because of an oscillation: softer gains, and the bounds they keep."""

from __future__ import annotations

import yaml

from blf_dsc_controller.bags.content import Content
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
from blf_dsc_controller.run import Run
from blf_dsc_controller.supervision.oscillation_check import advised_stiffness
from blf_dsc_controller.warnings.expected_errors import expectation


def print_softer_gains_of(run: Run, content: Content) -> None:
    """Print what to paste after the first stop in a bag, if its arm can be built."""
    if run.arm is not None:
        for stop in run.stops[:1]:
            print_softer_gains(stop.text, content.controller_config())


def print_softer_gains(text: str, config: ControllerConfig) -> None:
    """Print what to paste after a stop with this text.

    Nothing, unless it advises softer gains, and each joint has gains of its own.
    """
    stiffness = advised_stiffness(text)
    if stiffness is None:
        return
    arm = used_design_of(config).joints
    if arm is None:
        return
    gains = arm.scaled(stiffness)
    values = as_parameters(gains.stiffness.round(3), gains.damping.round(3))
    softer = with_gains(config, values)
    try:
        values |= widened_bounds(softer)
    except BlfDscError:
        tool = ' and a barrier.tool_bound' if config.barrier.tool_bound else ''
        print(
            f'no bounds were found for a feedback.stiffness of {stiffness:g}, with a robot.payload '
            f'of {config.robot.payload:g} kg{tool}: commission the arm (`blf_dsc commission`)'
        )
        return
    listed = {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in values.items()
    }
    section = {'/**/blf_dsc_controller': {'ros__parameters': listed}}
    print(
        'put these parameters in the place of those in the file, whose others stay: gains with a '
        'margin of about 0.5 at the frequency of the oscillation, by how fast it grew, and bounds '
        'that they keep. Halve the gains if the arm stops again, or commission it. Errors to '
        f'expect: {expectation(change(softer, values))}\n'
        f'{yaml.safe_dump(section, default_flow_style=None, sort_keys=False, width=1000)}',
        end='',
    )
