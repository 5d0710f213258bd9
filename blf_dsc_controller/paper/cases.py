# SPDX-License-Identifier: Apache-2.0
"""What is run side by side, and the variations that the claims of the paper are held against."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from blf_dsc_controller.configuration.nodes import CONTROLLER, PLANT, LoopConfig
from blf_dsc_controller.configuration.params_file import load_loop, locate
from blf_dsc_controller.configuration.schema import change

DURATION = 60.0  # s

NO_DISTURBANCE = {'disturbance.constant': [0.0, 0.0], 'disturbance.amplitude': [0.0, 0.0]}
LEAKY = {
    'disturbance.leakage': 0.02,
    'truth.parameters': [1.0, 0.32, 0.4],
    'truth.constant': [0.1, 0.1],
}


@dataclass(frozen=True)
class Case:
    """A preset with changes to the law and to the plant."""

    name: str
    label: str
    preset: str
    law: Mapping[str, object] = field(default_factory=dict)
    plant: Mapping[str, object] = field(default_factory=dict)
    duration: float = DURATION

    def loop(self) -> LoopConfig:
        """Configuration of the case."""
        loop = load_loop(locate(self.preset), {PLANT: {'duration': self.duration}, CONTROLLER: {}})
        return loop._replace(
            controller=change(loop.controller, self.law), plant=change(loop.plant, self.plant)
        )

    @property
    def command(self) -> str:
        """Command that runs the preset by itself."""
        return f'closed_loop --offline --config {self.preset}'


SIDE_BY_SIDE = (
    Case('paper', "proposed, the paper's choices", 'paper'),
    Case('paper_tuned', 'proposed, tuned', 'paper_tuned'),
    Case('comparison', 'comparison, tuned', 'comparison'),
    Case('comparison_detuned', 'comparison, low gains', 'comparison_detuned'),
    Case('slotine_li', 'Slotine-Li, tuned', 'slotine_li'),
    Case('recommended', 'recommended', 'recommended'),
    Case('two_tone', 'two tones, columns', 'two_tone'),
    Case('model_based', 'all known (16)', 'model_based'),
)

VARIATIONS = (
    Case('paper_quiet', 'paper, no disturbance', 'paper', plant=NO_DISTURBANCE),
    Case('recommended_quiet', 'recommended, no disturbance', 'recommended', plant=NO_DISTURBANCE),
    Case(
        'paper_at_rest',
        'paper, reference at rest',
        'paper',
        law={'reference.amplitude': [0.0, 0.0], 'reference.offset': [2.2935, 1.6961]},
    ),
    Case(
        'paper_from_zero', 'paper, P^(0) = 0', 'paper', law={'learning.initial_estimate': [0.0] * 3}
    ),
    Case(
        'leaky',
        'recommended, eta = 0.02, sinusoidal disturbance',
        'recommended',
        law={**LEAKY, 'truth.amplitude': [0.1, 0.1]},
    ),
    Case(
        'leaky_constant',
        'recommended, eta = 0.02, constant disturbance',
        'recommended',
        law=LEAKY,
        plant={'disturbance.amplitude': [0.0, 0.0]},
    ),
    Case(
        'paper_pushed',
        'paper, 8 N m against joint 1',
        'paper',
        plant={'disturbance.constant': [8.0, 0.1]},
    ),
    Case(
        'recommended_pushed',
        'recommended, 8 N m against joint 1',
        'recommended',
        plant={'disturbance.constant': [8.0, 0.1]},
    ),
)
