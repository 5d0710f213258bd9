# SPDX-License-Identifier: Apache-2.0
"""A simulated arm, sample by sample: its vectors and its random generator."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from blf_dsc_controller.compiled.jit import direct
from blf_dsc_controller.compiled.layout import pack
from sim_plant.elastic import REST, run_elastic_plant
from sim_plant.kernels import (
    OBSERVE,
    STEP,
    TRUTH,
    drawn,
    generator,
    is_due,
    plant_views,
    run_plant,
)
from sim_plant.layout import (
    BOTH,
    PlantSettings,
    state_size,
)


class Plant:
    """A sampled arm: call `measure()`, then `step(torque)`, in turn.

    It starts at `position` (n,) [rad] with `velocity` (n,) [rad/s]; `seed` determines
    the noise, so the same seed repeats the run.
    """

    def __init__(
        self,
        settings: PlantSettings,
        position: ArrayLike,
        velocity: ArrayLike,
        seed: int,
    ) -> None:
        self.arm = settings.arm
        self.settings = pack(settings)
        self.joints = settings.n
        self.period_ns = settings.period_ns
        self.state = np.zeros(state_size(settings))
        self._settings, self._now = plant_views(self.arm, self.settings, self.state)
        self._q, self._dq = self._now.x[: 2 * self.joints].reshape(2, -1)
        self._q[:], self._dq[:] = position, velocity
        self._measurement = np.zeros(3 * self.joints)
        self._truth = np.zeros(settings.p + 3 * self.joints)
        self._seed = seed
        self._noise = np.zeros(4 * self.joints)
        self._drawn = drawn(self._settings)
        self.rng = generator(seed)
        if settings.springs > 0:
            self._now.acting.sample[0] = -1.0
            self._run(*self._arguments(REST, self._truth))
        self._now.reading.sample[0] = self._now.acting.sample[0] = -1.0
        self._initial = self.state.copy()

    @functools.cached_property
    def _run(self) -> Callable[..., None]:
        return direct(self._compiled, *self._arguments(STEP, self._truth))

    @property
    def _compiled(self) -> Callable[..., None]:
        return run_elastic_plant if self._settings.springs > 0 else run_plant

    def _arguments(self, tasks: int, torque: np.ndarray) -> tuple[Any, ...]:
        vectors = self.arm, self.settings, self.state, self._noise
        return *vectors, tasks, torque, self._measurement, self._truth

    @property
    def sample(self) -> int:
        """Samples stepped since the start, k."""
        return int(self.state[0])

    @property
    def is_stopped(self) -> bool:
        """Whether the drives have made a reflex stop, which lasts until a reset."""
        return bool(self._now.drives.stopped[0])

    @property
    def motors(self) -> np.ndarray:
        """Positions and velocities (2, n) of the motors: those of the links without springs."""
        if self._settings.springs == 0:
            return np.stack((self._q, self._dq))
        return np.stack((self._now.elastic.theta, self._now.elastic.dtheta))

    @property
    def motor_reading(self) -> np.ndarray | None:
        """What encoders of motors beside those of links show (2, n); None: there are none.

        They have the resolution of the others, no noise, no offset and no filter.
        """
        if self._settings.encoders.side != BOTH:
            return None
        reading = np.array(self.motors)
        step = self._settings.encoders.resolution
        if step > 0.0:
            reading[0] = step * np.rint(reading[0] / step)
        return reading

    @property
    def base(self) -> np.ndarray:
        """Deflection of the base along x and y [m] and about them [rad]; empty if it is rigid."""
        return self._now.elastic.q[: self._settings.mounts]

    @property
    def elapsed_ns(self) -> int:
        """Time since the start [ns]."""
        return self.sample * self.period_ns

    def measure(self) -> np.ndarray:
        """Return [q, dq, effort] (3n,) of this sample, overwritten by the next call."""
        if is_due(self._settings, self._now):
            self.rng.standard_normal(out=self._noise[self._drawn])
        self._run(*self._arguments(OBSERVE, self._truth))
        return self._measurement

    def step(self, torque: np.ndarray) -> None:
        """Apply the commanded torque (n,) [N m] and advance to the next sample."""
        self._run(*self._arguments(STEP, torque))

    def change(self, settings: PlantSettings) -> None:
        """Switch to settings with the same number of joints, period and delay."""
        self.arm = settings.arm
        self.settings = pack(settings)
        self._settings, self._now = plant_views(self.arm, self.settings, self.state)
        self._drawn = drawn(self._settings)
        self._now.acting.sample[0] = -1.0

    def truth(self) -> np.ndarray:
        """Return [P, tau_dist, q, dq] (p + 3n,) of this sample.

        The next call overwrites it.
        """
        self._run(*self._arguments(TRUTH, self._truth))
        return self._truth

    def reset(self) -> None:
        """Return to sample 0 and reseed, so that the run is repeated."""
        self.state[:] = self._initial
        self.rng = generator(self._seed)

    def compile(self) -> None:
        """Compile every kernel of this plant, and return to sample 0."""
        self.step(np.zeros(self.measure().size // 3))
        self.truth()
        self.reset()
