# SPDX-License-Identifier: Apache-2.0
"""The sampled plant: a reading of sample k, then the torque over [k, k + 1], and so on.

Settings and state are one flat float64 vector each, named by the views below. Time is counted in
whole nanoseconds, t_k = (k T_ns) 1e-9 s, so every caller meets the same floats. The kernels serve
the ROS 2 node and the compiled offline loop alike, bit for bit.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from blf_dsc_controller.compiled.jit import inner, kernel
from blf_dsc_controller.compiled.views import borrowed, part
from blf_dsc_controller.errors import ConfigurationError
from sim_plant.actuator import Actuator, ActuatorState, actuate, actuator_view
from sim_plant.disturbance import DISTURBANCE_TERMS, disturbance_torque
from sim_plant.dynamics import ARM_SIZE, Arm, arm_view, parameters
from sim_plant.integrator import integrate, scratch_size
from sim_plant.sensors import SENSOR_SIZE, Sensor, SensorState, draw, is_noisy, sense, sensor_view

PARAMETERS = 3
_SCALARS = 2 + ARM_SIZE + SENSOR_SIZE + 1
_PER_JOINT = DISTURBANCE_TERMS + 1


class PlantSettings(NamedTuple):
    """All that defines a plant but its seed and its initial state."""

    period_ns: float  # sample time, whole ns
    integrator: int  # RK4 or DOPRI5
    arm: Arm
    sensor: Sensor
    disturbance: NDArray[np.float64]  # of `disturbance_vector`
    actuator: Actuator


class PlantState(NamedTuple):
    """All that changes from sample to sample but the random generator."""

    sample: NDArray[np.float64]  # (1,), k
    x: NDArray[np.float64]  # (2n,) q [rad], dq [rad/s], noise-free
    sensor: SensorState
    actuator: ActuatorState
    scratch: NDArray[np.float64]  # of the integrator


def settings_vector(settings: PlantSettings) -> NDArray[np.float64]:
    """Return the flat vector of the settings, whose arrays may be any sequences of numbers.

    Raises
    ------
    ConfigurationError
        If the torque limit and the disturbance are not of the same joints.

    """
    n = len(settings.disturbance) // DISTURBANCE_TERMS
    limits = len(settings.actuator.torque_limit)
    if limits != n:
        problem = f'actuator.torque_limit has {limits} entries: expected one for each of {n} joints'
        raise ConfigurationError([problem])
    parts: list[ArrayLike] = [settings.period_ns, settings.integrator]
    parts += [*settings.arm, *settings.sensor, settings.disturbance, *settings.actuator]
    return np.concatenate([np.ravel(np.asarray(part, dtype=np.float64)) for part in parts])


@inner
def joint_count(settings: NDArray[np.float64]) -> int:
    """Return n of a settings vector."""
    return (settings.size - _SCALARS) // _PER_JOINT


@inner
def settings_view(flat: NDArray[np.float64]) -> PlantSettings:
    """Name the parts of a settings vector."""
    sensor = 2 + ARM_SIZE
    disturbance = sensor + SENSOR_SIZE
    actuator = flat.size - 1 - joint_count(flat)
    return PlantSettings(
        flat[0],
        int(flat[1]),
        arm_view(flat[2:sensor]),
        sensor_view(flat[sensor:disturbance]),
        flat[disturbance:actuator],
        actuator_view(flat[actuator:]),
    )


@inner
def state_view(flat: NDArray[np.float64], n: int, delay: int) -> PlantState:
    """Name the parts of a state vector of n joints and a delay in samples."""
    sensor = 1 + 2 * n
    actuator = sensor + 1 + 4 * n
    ring = actuator + n
    scratch = ring + delay * n
    return PlantState(
        flat[:1],
        flat[1:sensor],
        SensorState(
            flat[sensor : sensor + 1],
            flat[sensor + 1 : sensor + 1 + 2 * n],
            flat[sensor + 1 + 2 * n : sensor + 1 + 3 * n],
            flat[sensor + 1 + 3 * n : actuator],
        ),
        ActuatorState(flat[actuator:ring], flat[ring:scratch].reshape((delay, n))),
        flat[scratch:],
    )


def initial_state(
    settings: NDArray[np.float64], position: ArrayLike, velocity: ArrayLike
) -> NDArray[np.float64]:
    """Return the state vector of sample 0 at a position, (n,) rad, and velocity, (n,) rad/s."""
    n = joint_count(settings)
    delay = settings_view(settings).actuator.delay
    flat = np.zeros(1 + 2 * n + 1 + 4 * n + n + delay * n + scratch_size(n))
    state = state_view(flat, n, delay)
    state.x[:n] = position
    state.x[n:] = velocity
    state.sensor.sample[0] = -1.0
    return flat


@inner
def draw_next(plant: PlantSettings, now: PlantState, rng: np.random.Generator) -> None:
    """Draw the noise of the next reading, where the sensor has any and the sample is unread."""
    if is_noisy(plant.sensor) and now.sensor.sample[0] != now.sample[0]:
        draw(rng, now.sensor.noise)


@inner
def read(plant: PlantSettings, now: PlantState, measurement: NDArray[np.float64]) -> None:
    """Write [q, dq, effort], (3n,), of this sample; see `observe`."""
    n = now.actuator.applied.size
    if now.sensor.sample[0] != now.sample[0]:
        period = plant.period_ns * 1e-9
        q = part(now.x, 0, (n,))
        dq = part(now.x, n, (n,))
        sense(plant.sensor, int(now.sample[0]), period, q, dq, now.sensor)
    for i in range(n):
        measurement[i] = now.sensor.position[i]
        measurement[n + i] = now.sensor.velocity[i]
        measurement[2 * n + i] = now.actuator.applied[i]


@inner
def move(plant: PlantSettings, now: PlantState, command: NDArray[np.float64]) -> None:
    """Take the commanded torque of this sample and go on to the next one; see `step`."""
    actuate(plant.actuator, int(now.sample[0]), command, now.actuator)
    integrate(
        plant.integrator,
        plant.arm,
        plant.disturbance,
        now.sample[0] * plant.period_ns * 1e-9,
        plant.period_ns * 1e-9,
        now.actuator.applied,
        now.x,
        now.scratch,
    )
    now.sample[0] += 1.0


@inner
def reveal(plant: PlantSettings, now: PlantState, out: NDArray[np.float64]) -> None:
    """Write what no sensor tells; see `truth`."""
    n = now.actuator.applied.size
    t = now.sample[0] * plant.period_ns * 1e-9
    parameters(plant.arm, out)
    dq = part(now.x, n, (n,))
    disturbance_torque(plant.disturbance, t, dq, part(out, PARAMETERS, (n,)))
    for i in range(2 * n):
        out[PARAMETERS + n + i] = now.x[i]


@inner
def plant_of(
    settings: NDArray[np.float64], state: NDArray[np.float64]
) -> tuple[PlantSettings, PlantState]:
    """Name the parts of both vectors, without counting references to them."""
    plant = settings_view(borrowed(settings))
    return plant, state_view(borrowed(state), joint_count(settings), plant.actuator.delay)


@kernel
def draw_noise(
    settings: NDArray[np.float64], state: NDArray[np.float64], rng: np.random.Generator
) -> None:
    """Draw the noise of the next reading, where the sensor has any and the sample is unread."""
    plant, now = plant_of(settings, state)
    draw_next(plant, now, rng)


@kernel
def observe(
    settings: NDArray[np.float64], state: NDArray[np.float64], measurement: NDArray[np.float64]
) -> None:
    """Write [q, dq, effort], (3n,), of this sample, with the noise already drawn.

    `effort` is the torque applied over the last interval, N m. A sample is read once: asking for
    it again gives the same numbers.
    """
    plant, now = plant_of(settings, state)
    read(plant, now, measurement)


@kernel
def measure(
    settings: NDArray[np.float64],
    state: NDArray[np.float64],
    rng: np.random.Generator,
    measurement: NDArray[np.float64],
) -> None:
    """Draw the noise of this sample and `observe` it."""
    plant, now = plant_of(settings, state)
    draw_next(plant, now, rng)
    read(plant, now, measurement)


@kernel
def step(
    settings: NDArray[np.float64], state: NDArray[np.float64], command: NDArray[np.float64]
) -> None:
    """Take the commanded torque, (n,) N m, of this sample and go on to the next one."""
    plant, now = plant_of(settings, state)
    move(plant, now, command)


@kernel
def truth(
    settings: NDArray[np.float64], state: NDArray[np.float64], out: NDArray[np.float64]
) -> None:
    """Write what no sensor tells, (3 + 3n,): [P, tau_dist, q, dq] of this sample."""
    plant, now = plant_of(settings, state)
    reveal(plant, now, out)


KERNELS = (observe, step, truth)
"""What Python calls of a plant; compiled before the node starts."""
