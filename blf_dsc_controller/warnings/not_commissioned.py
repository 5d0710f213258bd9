# SPDX-License-Identifier: Apache-2.0
"""The warning before a robot moves with gains that were not found by measuring it."""

from __future__ import annotations

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.law_traits import OWN, PAPER


def not_commissioned(config: ControllerConfig, *, in_motors: bool = False) -> str:
    """Return that the gains were not measured, with what to do; empty if nothing is to be said.

    It is for robots: nobody measures a simulated arm, or the two links of the paper.
    Gains of an arm of which nothing is known are warned of in any case
    (`stability`).  A commissioning measures no feedback that is `in_motors`.
    """
    feedback = config.feedback
    if config.model != 'urdf' or config.law not in (OWN, PAPER):
        return ''
    if config.commissioning.friction:
        if feedback.stiffness <= 1.0:
            return ''
        return (
            f'feedback.stiffness: {feedback.stiffness:g} times the gains for which this arm was '
            'commissioned: give 1 at most, or measure it again'
        )
    is_unknown = not (feedback.joint_stiffness or config.robot.joint_stiffness)
    if feedback.inertia == 'none' and is_unknown:
        return ''
    unmeasured = 'commissioning: nobody has measured whether this arm bears its gains'
    if in_motors:
        return (
            f'{unmeasured}, which its motors close, and `blf_dsc commission` measures torques over '
            'the bus: begin with those of its maker, and halve feedback.stiffness if the arm hums '
            'or rings'
        )
    return f'{unmeasured}: `blf_dsc commission` does, and chooses gains with a margin'
