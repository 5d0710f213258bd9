# SPDX-License-Identifier: Apache-2.0
"""What the encoders tell of the true state: white noise, quantisation, and a velocity.

The velocity is either measured, with noise of its own, or differenced from the measured positions.
Noise comes from one seeded generator, so a run is repeated exactly by repeating its seed.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.compiled.jit import inner

MEASURED = 0
DIFFERENCED = 1
VELOCITY_SOURCES = {'measured': MEASURED, 'differenced': DIFFERENCED}
SENSOR_SIZE = 4


class Sensor(NamedTuple):
    """Quality of the encoders, the same on every joint."""

    position_noise: float  # rad, standard deviation
    velocity_noise: float  # rad/s, standard deviation; not used when differenced
    resolution: float  # rad, 0 = none
    velocity_source: int  # MEASURED or DIFFERENCED


class SensorState(NamedTuple):
    """The latest reading, and which sample it is of."""

    sample: NDArray[np.float64]  # (1,), -1 before the first reading
    noise: NDArray[np.float64]  # (2n,) standard normal: positions, velocities
    position: NDArray[np.float64]  # (n,) rad
    velocity: NDArray[np.float64]  # (n,) rad/s


@inner
def sensor_view(flat: NDArray[np.float64]) -> Sensor:
    """Read a sensor from its (SENSOR_SIZE,) vector."""
    return Sensor(flat[0], flat[1], flat[2], int(flat[3]))


def generator(seed: int) -> np.random.Generator:
    """Return the generator of a seed: PCG64, on every version of numpy."""
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed)))


@inner
def is_noisy(sensor: Sensor) -> bool:
    """Return whether a reading needs random numbers at all."""
    return sensor.position_noise > 0.0 or sensor.velocity_noise > 0.0


@inner
def draw(rng: np.random.Generator, noise: NDArray[np.float64]) -> None:
    """Fill with standard normal numbers: the same as `rng.standard_normal(out=noise)`."""
    for i in range(noise.size):
        noise[i] = rng.standard_normal()


@inner
def quantised(angle: float, resolution: float) -> float:
    """Return the nearest multiple of the resolution; a resolution of 0 is none."""
    if resolution == 0.0:
        return angle
    return float(np.rint(angle / resolution) * resolution)


@inner
def sense(
    sensor: Sensor,
    sample: int,
    period: float,
    q: NDArray[np.float64],
    dq: NDArray[np.float64],
    state: SensorState,
) -> None:
    """Write the reading of this sample into the state, of the noise that is there.

    A differenced velocity spans the samples since the last reading, `period` seconds each; at the
    first reading there is no other, so the true velocity is told.
    """
    n = q.size
    first = state.sample[0] < 0
    span = (sample - state.sample[0]) * period
    for i in range(n):
        position = quantised(q[i] + sensor.position_noise * state.noise[i], sensor.resolution)
        if sensor.velocity_source == MEASURED:
            state.velocity[i] = dq[i] + sensor.velocity_noise * state.noise[n + i]
        elif first:
            state.velocity[i] = dq[i]
        else:
            state.velocity[i] = (position - state.position[i]) / span
        state.position[i] = position
    state.sample[0] = sample
