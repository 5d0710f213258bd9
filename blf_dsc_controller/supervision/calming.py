# SPDX-License-Identifier: Apache-2.0
"""The reaction to an arm that oscillates: softer feedback, then a stop.

The rates of the feedback are halved, which is what half of `feedback.stiffness` would
be, and once more if the arm still oscillates a while later.  If that does not help
either, or if the torques of the oscillation reach half of their limits, the arm stops.
The gains stay soft until the next reset, activation or change of parameters: an arm
that has oscillated with them would do so again.
"""

from __future__ import annotations

from math import inf
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.law.blf_dsc import shift_surface
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.oscillation import PATIENCE, VIOLENT, oscillates
from blf_dsc_controller.law.state import Settings, settings_of
from blf_dsc_controller.supervision.digits import two_digits

_HALF = 0.5
_SOFTEST = 0.25  # of the rates
_LATELY = 0.1  # s


class Shaking(NamedTuple):
    """The oscillation of the joint that shows it most."""

    joint: str
    frequency: float  # Hz
    torque: float  # N m or N, amplitude
    unit: str  # of the torque

    @property
    def text(self) -> str:
        """A sentence with the numbers, without its end."""
        return self._with('oscillates')

    @property
    def past(self) -> str:
        """The same of an oscillation that is over."""
        return self._with('has oscillated')

    def _with(self, verb: str) -> str:
        return (
            f'joint {self.joint!r} {verb} at {two_digits(self.frequency)} Hz with '
            f'+-{two_digits(self.torque)} {self.unit}'
        )


def softened(settings: Settings, share: float) -> Settings:
    """Return settings with a share of the rates of the feedback; exact for powers of two.

    Stiffnesses are squares of rates.
    """
    surface, feedback = settings.surface, settings.feedback
    barrier, disturbance = settings.barrier, settings.disturbance
    observer = settings.observer
    square = share**2
    return settings._replace(
        robust_gain=share * settings.robust_gain,
        surface=surface._replace(gain=share * surface.gain, mu=share * surface.mu),
        feedback=feedback._replace(
            gain=share * feedback.gain,
            robust_gain=share * feedback.robust_gain,
            damping_rate=share * feedback.damping_rate,
        ),
        barrier=barrier._replace(
            weight=square * barrier.weight, slope_limit=square * barrier.slope_limit
        ),
        disturbance=disturbance._replace(gain=square * disturbance.gain),
        observer=observer._replace(
            observer_bandwidth=share * observer.observer_bandwidth
        ),
    )


class Calming:
    """Finds the oscillation of a law's arm, and softens its feedback.

    Attributes:
        share: of the configured rates that the feedback has.
        last: the last oscillation; None: none so far.
        count: oscillations so far, and steps of softening.
    """

    def __init__(self, config: ControllerConfig, controller: Controller) -> None:
        self._controller = controller
        self._state = controller.checks.oscillation
        self.last: Shaking | None = None
        self.count = 0
        self.configure(config)

    def configure(self, config: ControllerConfig) -> None:
        """Begin again with the gains of a configuration, which the law has now."""
        self._config = config
        self.share = 1.0
        self._reported = -inf  # s

    def react(self, t: float) -> bool:
        """React to an oscillation that the law reports at t [s]; return False to stop.

        `last` and `count` change if the event is to be recorded.
        """
        reaction = self._config.safety.oscillation
        joints = range(self._state.waves.size)
        shakes = np.array([oscillates(self._state, i) for i in joints])
        found = self._find(shakes)
        if found is None or reaction == 'ignore':
            return True
        goes_on = t - self._reported < 2.0 * PATIENCE
        self._reported = t
        gives_up = self.share <= _SOFTEST or self._is_violent(shakes)
        if reaction == 'stop' or (reaction == 'soften' and gives_up):
            return False
        if reaction == 'warn' and goes_on:
            return True
        if reaction == 'soften':
            self._scale(_HALF)
        self.last = found
        self.count += 1
        return True

    def _find(self, shakes: NDArray[np.bool_]) -> Shaking | None:
        """Return the oscillation of the worst of the joints that do (n,); None: none does."""
        now = self._state
        limit = self._controller.settings.torque.limit
        torque = now.amplitude
        if not shakes.any() or not np.isfinite(torque).all():
            return None
        worst = int(np.argmax(np.where(shakes, torque / limit, -1.0)))
        frequency = 0.5 / float(now.half[worst])
        config = self._config
        unit = config.units[worst].torque
        return Shaking(config.joints[worst], frequency, float(torque[worst]), unit)

    def _is_violent(self, shakes: NDArray[np.bool_]) -> bool:
        """Whether one of the joints that oscillate (n,) does so with large torques."""
        limit = self._controller.settings.torque.limit
        return bool((self._state.amplitude > VIOLENT * limit)[shakes].any())

    def is_due(self, t: float) -> bool:
        """Whether the arm oscillates at t [s], or has softer feedback since it did."""
        return self.share < 1.0 or t - self._reported < 2.0 * PATIENCE

    @property
    def text(self) -> str:
        """The last oscillation, and what has been done about it; empty without one."""
        if self.last is None:
            return ''
        if self.share == 1.0:
            return self.last.text
        return f'{self.last.text}: its feedback is softened, to {self.share:g} of its rates'

    @property
    def cause(self) -> str:
        """What an arm that stops now was doing, and the remedy; empty if not oscillating."""
        state = self._state
        found = self._find((state.calm < _LATELY) & (state.half > 0.0))
        if found is None:
            return ''
        return f'{found.text}: {self._remedy}'

    @property
    def softness(self) -> str:
        """Why the feedback is softer than configured, and the remedy; empty if it is not."""
        if self.last is None or self.share == 1.0:
            return ''
        softer = 'lower surface.mu, surface.gain and feedback.gain'
        if self._config.model == 'urdf':
            stiffness = self.share * self._config.feedback.stiffness
            softer = f'give a feedback.stiffness of {stiffness:.2g}'
        return (
            f'{self.last.past}, so that the feedback has been softened to {self.share:g} of its '
            f'rates: {softer}, and a wider bound'
        )

    @property
    def _remedy(self) -> str:
        config = self._config
        softened_to = '' if self.share == 1.0 else f', even at {self.share:g} of them'
        too_stiff = f'the gains are too high for this arm or its base{softened_to}'
        if config.model != 'urdf':
            return f'{too_stiff}; lower surface.mu, surface.gain and feedback.gain'
        stiffness = _HALF * self.share * config.feedback.stiffness
        return (
            f'{too_stiff}; give a feedback.stiffness of {stiffness:.2g}, and lower gains of '
            'feedback, surface and barrier that are given'
        )

    def restart(self) -> None:
        """Return to the configured gains, and begin again at t = 0."""
        self._reported = -inf
        if self.share < 1.0:
            self._scale(1.0 / self.share)

    def _scale(self, factor: float) -> None:
        controller = self._controller
        # those in `controller.settings` that are no arrays are those of the start
        settings = settings_of(controller.settings_vector, controller.settings.model)
        if settings.has_barrier == 1:  # so that beta2 - alpha2 does not jump
            signals = controller.signals
            gap = signals.dqr - signals.surface.beta2
            shift_surface(controller.state, (1.0 - factor) * gap)
        controller.retune(controller.law, softened(settings, factor))
        self.share *= factor
