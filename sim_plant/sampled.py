# SPDX-License-Identifier: Apache-2.0
"""A plant that owns its vectors and its random generator, for callers in Python."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sim_plant.plant import (
    PARAMETERS,
    PlantSettings,
    initial_state,
    joint_count,
    observe,
    settings_vector,
    settings_view,
    state_view,
    step,
    truth,
)
from sim_plant.sensors import generator, is_noisy

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import ArrayLike, NDArray


class SavedPlant(NamedTuple):
    """A plant's state at one moment, random generator included."""

    state: NDArray[np.float64]
    generator: Mapping[str, Any]


class Plant:
    """A sampled arm: `measure()`, answer with `step(torque)`, and again.

    Parameters
    ----------
    settings
        What defines the plant.
    position, velocity
        (n,) state of sample 0, rad and rad/s.
    seed
        Of the sensor noise: the same seed, the same run.

    """

    def __init__(
        self, settings: PlantSettings, position: ArrayLike, velocity: ArrayLike, seed: int = 0
    ) -> None:
        self.settings = settings_vector(settings)
        self.joints = joint_count(self.settings)
        self.period_ns = int(settings.period_ns)
        self._initial = initial_state(self.settings, position, velocity)
        self._seed = seed
        self.state = self._initial.copy()
        view = settings_view(self.settings)
        self._noisy = is_noisy(view.sensor)
        self._now = state_view(self.state, self.joints, view.actuator.delay)
        self._measurement = np.zeros(3 * self.joints)
        self._truth = np.zeros(PARAMETERS + 3 * self.joints)
        self.rng = generator(seed)

    @property
    def sample(self) -> int:
        """Samples stepped since the start, k."""
        return int(self.state[0])

    @property
    def elapsed_ns(self) -> int:
        """Time since the start, ns."""
        return self.sample * self.period_ns

    def measure(self) -> NDArray[np.float64]:
        """Return [q, dq, effort], (3n,), of this sample: a view, overwritten by the next call.

        The noise is drawn here and not by the compiled `measure`, which draws the same numbers:
        handing a generator to compiled code costs more than all the rest of the call.
        """
        if self._noisy and self._now.sensor.sample[0] != self.sample:
            self.rng.standard_normal(out=self._now.sensor.noise)
        observe(self.settings, self.state, self._measurement)
        return self._measurement

    def step(self, torque: NDArray[np.float64]) -> None:
        """Apply the commanded torque, (n,) float64, N m, and go on to the next sample."""
        step(self.settings, self.state, torque)

    def hold(self) -> None:
        """Stay where it is, at rest and without torque, for one sample: the brakes are on."""
        self._now.x[self.joints :] = 0.0
        self._now.actuator.applied[:] = 0.0
        self._now.sample[0] += 1.0

    def truth(self) -> NDArray[np.float64]:
        """Return [P, tau_dist, q, dq], (3 + 3n,), of this sample: a view, overwritten likewise."""
        truth(self.settings, self.state, self._truth)
        return self._truth

    def reset(self) -> None:
        """Go back to sample 0, to the run of the same seed."""
        self.state[:] = self._initial
        self.rng = generator(self._seed)

    def save(self) -> SavedPlant:
        """Return a copy of everything that changes."""
        return SavedPlant(self.state.copy(), self.rng.bit_generator.state)

    def restore(self, saved: SavedPlant) -> None:
        """Go on from a saved moment of a plant of the same settings."""
        self.state[:] = saved.state
        self.rng.bit_generator.state = saved.generator
