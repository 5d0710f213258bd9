# SPDX-License-Identifier: Apache-2.0
"""Encoder readings of the true state: offset, white noise, quantisation, and a velocity.

The velocity is either measured, with noise of its own, or differenced from the measured positions;
a low-pass filter may follow.
Noise comes from one seeded generator, so the same seed repeats a run exactly.
"""

import numpy as np

from blf_dsc_controller.compiled.elementary import exp
from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array
from sim_plant.layout import MEASURED, Encoders, PlantSettings, PlantState


def generator(seed: int) -> np.random.Generator:
    """Return the generator of a seed: PCG64 on every version of numpy."""
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed)))


@inner
def is_noisy(encoders: Encoders) -> bool:
    """Return whether a reading needs random numbers at all."""
    return encoders.position_noise > 0.0 or encoders.velocity_noise > 0.0


@inner
def draw(rng: np.random.Generator, noise: Array) -> None:
    """Fill `noise` with the same standard normal numbers as `rng.standard_normal(out=noise)`."""
    for i in range(noise.size):
        noise[i] = rng.standard_normal()


@inner
def quantised(angle: float, resolution: float) -> float:
    """Round to the nearest multiple of the resolution; 0 means no quantisation."""
    if resolution == 0.0:
        return angle
    return float(np.rint(angle / resolution) * resolution)


@inner
def sense(plant: PlantSettings, now: PlantState) -> None:
    """Write the reading of this sample, including offset and noise.

    A differenced velocity spans the samples since the last reading; the first reading has no
    predecessor and gets the true velocity.
    """
    n, encoders, reading = plant.n, plant.encoders, now.reading
    first = reading.sample[0] < 0
    span = (int(now.sample[0]) - reading.sample[0]) * (plant.period_ns * 1e-9)
    filters = encoders.velocity_pole > 0.0 and not first
    old = exp(-encoders.velocity_pole * span) if filters else 0.0
    for i in range(n):
        position = now.x[i] + now.acting.offset[i] + encoders.position_noise * reading.noise[i]
        position = quantised(position, encoders.resolution)
        if encoders.velocity_source == MEASURED:
            velocity = now.x[n + i] + encoders.velocity_noise * reading.noise[n + i]
        elif first:
            velocity = now.x[n + i]
        else:
            velocity = (position - reading.position[i]) / span
        if filters:
            velocity += old * (reading.velocity[i] - velocity)
        reading.velocity[i] = velocity
        reading.position[i] = position
    reading.sample[0] = now.sample[0]
