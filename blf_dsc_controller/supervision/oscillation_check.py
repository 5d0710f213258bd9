# SPDX-License-Identifier: Apache-2.0
"""The reaction to an arm that oscillates: it stops, or is warned of.

An oscillation whose torques reach a fifth of their limits stops also an arm that is only warned
of others.
"""

from __future__ import annotations

import re
from math import inf, log, pi
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.known_gears import MARGIN
from blf_dsc_controller.arms.linear_loop import DAMPING_RATIO
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.oscillation import FEW, PATIENCE, oscillates
from blf_dsc_controller.law.torque_sensors import NONE
from blf_dsc_controller.numerics.digits import two_digits
from blf_dsc_controller.supervision.not_sensors import fault_of

# of the torque limit, as amplitude: the tones of a commissioning, which calm arms follow, have
# looked like an oscillation of up to 0.16
_TOLERATED = 0.2

_OSCILLATES = ' oscillates at '
_ADVICE = 'give a feedback.stiffness of '

_LATELY = 0.1  # s


def advised_stiffness(text: str) -> float | None:
    """Return the `feedback.stiffness` that the text of a stop advises; None if it does not."""
    found = re.search(rf'{_OSCILLATES}.*{_ADVICE}([\d.e+-]*\d)', text)
    return float(found[1]) if found else None


class JointOscillation(NamedTuple):
    """The oscillation of the joint with the largest fraction of its torque limit."""

    joint: str
    frequency: float  # Hz
    torque: float  # N m or N, amplitude
    unit: str  # of the torque

    @property
    def text(self) -> str:
        """A sentence with the numbers, without its end."""
        return (
            f'joint {self.joint!r}{_OSCILLATES}{two_digits(self.frequency)} Hz with '
            f'+-{two_digits(self.torque)} {self.unit}'
        )


class OscillationCheck:
    """Decides whether an arm that oscillates stops.

    Attributes:
        last: the last oscillation that is warned of; None: none so far.
        count: of those so far.
    """

    def __init__(self, config: ControllerConfig, controller: Controller) -> None:
        self._controller = controller
        self._state = controller.checks.oscillation
        self.last: JointOscillation | None = None
        self.count = 0
        self.configure(config)

    def configure(self, config: ControllerConfig) -> None:
        """React as a configuration says from now on."""
        self._config = config
        self.restart()

    def restart(self) -> None:
        """Begin again at t = 0."""
        self._reported = -inf  # s

    @property
    def only_warns(self) -> bool:
        """Whether a weak oscillation does not stop the arm: then one may become strong."""
        return self._config.safety.oscillation == 'warn'

    def must_stop(self, t: float) -> bool:
        """Whether the arm has to stop for an oscillation at t [s].

        If it does not, `last` and `count` change once an oscillation is warned of.
        """
        reaction = self._config.safety.oscillation
        joints = range(self._state.waves.size)
        oscillating = np.array([oscillates(self._state, i) for i in joints])
        oscillation = self._worst(oscillating)
        if oscillation is None or reaction == 'ignore':
            return False
        fraction = self._state.amplitude / self._controller.settings.torque.limit
        if reaction == 'stop' or fraction[oscillating].max() > _TOLERATED:
            return True
        if not self.is_ongoing(t):
            self.last = oscillation
            self.count += 1
        self._reported = t
        return False

    def _worst(self, oscillating: NDArray[np.bool_]) -> JointOscillation | None:
        """Return the oscillation of the worst joint `oscillating` (n,); None: none does."""
        state = self._state
        limit = self._controller.settings.torque.limit
        torque = state.amplitude
        if not oscillating.any() or not np.isfinite(torque).all():
            return None
        worst = int(np.argmax(np.where(oscillating, torque / limit, -1.0)))
        frequency = 0.5 / float(state.half[worst])
        config = self._config
        unit = config.units[worst].torque
        return JointOscillation(
            config.joints[worst], frequency, float(torque[worst]), unit
        )

    def is_ongoing(self, t: float) -> bool:
        """Whether an oscillation that has been warned of still lasts at t [s]."""
        return t - self._reported < 2.0 * PATIENCE

    @property
    def text(self) -> str:
        """The last oscillation that is warned of; empty without one."""
        return '' if self.last is None else self.last.text

    @property
    def cause(self) -> str:
        """What an arm that stops now was doing, and the remedy; empty if not oscillating."""
        state = self._state
        oscillation = self._worst((state.calm < _LATELY) & (state.half > 0.0))
        if oscillation is None:
            return ''
        worst = self._config.joints.index(oscillation.joint)
        return f'{oscillation.text}: {self._remedy(worst)}'

    def _remedy(self, worst: int) -> str:
        """Return what to do if the `worst` joint oscillates: lower gains, or what may be wrong."""
        config = self._config
        too_stiff = 'the gains are too high for this arm or its base'
        if config.observes_load and fault_of(self._controller) == NONE:
            too_stiff += (
                ', or the load observer is too fast for it, or its efforts are not those of '
                'joint torque sensors'
            )
        if config.model != 'urdf':
            return (
                f'{too_stiff}; lower two_link.mu, two_link.surface_gain and '
                'two_link.feedback_gain'
            )
        return (
            f'{too_stiff}; commission it (`blf_dsc commission`), or {_ADVICE}'
            f'{self._part_with_margin(worst) * config.feedback.stiffness:.2g} with the bounds that '
            '`blf_dsc report` of the bag prints'
        )

    def _part_with_margin(self, i: int) -> float:
        """Return the part of the gains with which the resonance of joint i has the MARGIN.

        The heights of its half waves grow by exp(g) in a period.  Without feedback they decay
        by exp(-2 pi D), so the gains are g / (2 pi D) + 1 times those with which they last.
        """
        state = self._state
        k = int(state.waves[i])
        if k < FEW:
            return MARGIN
        last, before = (state.travel[(k - n) % len(state.travel), i] for n in (1, 3))
        growth = max(0.0, log(last / before))
        return MARGIN / (1.0 + growth / (2.0 * pi * DAMPING_RATIO))
