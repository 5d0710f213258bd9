# SPDX-License-Identifier: Apache-2.0
"""Springs, motors, base and steps of a plant with elastic joints, from its configuration."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.errors import BlfDscError
from sim_plant.arm import RigidArm, RigidBodies, bodies_of, fill_mobility, motion_of
from sim_plant.kernels import lag
from sim_plant.layout import Base, Springs

MOUNTS = 4
"""Coordinates of a base that gives way: along x and y, and tilts about x and y."""

_EDGE = 0.6  # m, of the cube on which an arm stands: a small table, or a pedestal
CUBE = np.array([0.0, 0.0, -0.5 * _EDGE]), np.full(3, _EDGE**2 / 6.0)
"""Its centre of mass [m] beneath the arm, and its inertia per kg about it [m^2]."""

_BLOCK = 5e-4  # s, for which M is held
_STEP = 2.5e-5  # s, longest step of springs and motors
# rad, of the fastest oscillation in a step: its frequency is 0.4 % off, and stable up to 2
_PHASE = 0.3
_DECAY = 0.5  # of a velocity by friction in a step
_POSTURES = 2.0  # times the square of the highest frequency at the start
MOST_STEPS = 1000
"""Steps of an integrator in a sample, at most."""


class Elasticity(NamedTuple):
    """Fields of `PlantSettings` that describe springs and base."""

    steps: int
    blocks: int
    springs: int
    mounts: int
    transmission: Springs
    base: Base


def is_elastic(config: PlantConfig) -> bool:
    """Return whether anything between motors and ground gives way."""
    return any(config.joint.stiffness) or config.base.mass > 0.0


def mounts_of(config: PlantConfig) -> int:
    """Return the number of coordinates of the base."""
    return MOUNTS if config.base.mass > 0.0 else 0


def stiffness_of(config: PlantConfig) -> np.ndarray:
    """Return the stiffness (n,) of each joint [N m/rad], 0 where it is rigid."""
    return np.array(config.joint.stiffness or (0.0,) * len(config.joints))


def apparent_rotors(config: PlantConfig, rotors: np.ndarray) -> np.ndarray:
    """Return the drives' inertias (n,) as commands see them: a torque loop hides a share."""
    return np.asarray(rotors / (1.0 + config.actuator.loop_gain))


def on_base(bodies: RigidBodies, mass: float) -> RigidBodies:
    """Return bodies on a base of some mass [kg]: a cube, with the arm on top of it.

    It moves along x and y, and tilts about x and y, all through the origin of the arm.
    """
    ahead = MOUNTS - 1  # bodies without mass between the base's coordinates
    centre, inertia = CUBE
    shifted = np.diag(inertia) + centre @ centre * np.eye(3) - np.outer(centre, centre)
    return bodies._replace(
        n=bodies.n + MOUNTS,
        rotation=np.concatenate((np.tile(np.eye(3), (MOUNTS, 1, 1)), bodies.rotation)),
        offset=np.concatenate((np.zeros((MOUNTS, 3)), bodies.offset)),
        axis=np.concatenate((np.tile(np.eye(3)[:2], (2, 1)), bodies.axis)),
        prismatic=np.concatenate(([1.0, 1.0, 0.0, 0.0], bodies.prismatic)),
        mass=np.concatenate((np.zeros(ahead), [mass], bodies.mass)),
        moment=np.concatenate((np.zeros((ahead, 3)), [mass * centre], bodies.moment)),
        inertia=np.concatenate(
            (np.zeros((ahead, 3, 3)), [mass * shifted], bodies.inertia)
        ),
        rotor=np.concatenate((np.zeros(MOUNTS), bodies.rotor)),
        zeros=np.zeros(bodies.n + MOUNTS),
    )


def rigid(steps: int) -> Elasticity:
    """Return the settings of an arm without springs."""
    empty = np.zeros(0)
    springs = Springs(
        stiffness=empty,
        damping=empty,
        play=empty,
        hysteresis=empty,
        mobility=empty,
        loop_gain=0.0,
        loop_damping=0.0,
        loop_decay=0.0,
        loop_limit=empty,
        sensor_factor=empty,
        sensor_offset=empty,
        sensor_noise=empty,
    )
    return Elasticity(steps, 0, 0, 0, springs, Base(np.zeros((0, 0)), np.zeros((0, 0))))


def elastic(
    config: PlantConfig, arm: RigidArm, rotors: np.ndarray, slope: np.ndarray
) -> Elasticity:
    """Return the settings of an arm with springs, or on a base that gives way.

    The drives have the inertias `rotors` (n,) [kg m^2]; `slope` (n,) [N m s/rad] is that
    of their friction near rest.

    Raises:
        BlfDscError: a spring without a motor.
    """
    joint, actuator = config.joint, config.actuator
    n, K = len(config.joints), stiffness_of(config)
    _check_motors(config, rotors)
    M, mobility = _at_start(config, arm)
    motors = np.where(K > 0.0, 1.0 / np.where(K > 0.0, rotors, 1.0), 0.0)
    free = np.diag(mobility)[-n:]  # of each link, with all others free
    blocks = math.ceil(config.sample_time / _BLOCK)
    fastest = _highest_frequency(config, mobility, motors)
    rate = float((slope * np.where(K > 0.0, motors, free)).max())
    step = min(_STEP, _PHASE / max(fastest, 1.0), _DECAY / max(rate, 1.0))
    steps = min(math.ceil(config.sample_time / step), MOST_STEPS)
    steps = math.ceil(steps / blocks)
    half = 0.5 * config.sample_time / (steps * blocks)
    springs = Springs(
        stiffness=K,
        damping=2.0 * joint.damping_ratio * np.sqrt(K / (motors + free)),
        play=0.5 * np.array(joint.backlash or np.zeros(n)),
        hysteresis=np.array(joint.hysteresis or np.zeros(n)),
        mobility=motors,
        loop_gain=actuator.loop_gain,
        loop_damping=actuator.loop_damping,
        loop_decay=lag(actuator.loop_lag, half)[0],
        loop_limit=actuator.loop_limit * np.array(actuator.torque_limit),
        sensor_factor=np.array(config.sensor.torque_factor or np.ones(n)),
        sensor_offset=np.array(config.sensor.torque_offset or np.zeros(n)),
        sensor_noise=np.array(config.sensor.torque_noise or np.zeros(n)),
    )
    mounts = mounts_of(config)
    return Elasticity(steps, blocks, n, mounts, springs, _base_of(config, M))


def _check_motors(config: PlantConfig, rotors: np.ndarray) -> None:
    """Raise BlfDscError if a spring has no motor, with an inertia (n,) [kg m^2]."""
    springs = zip(config.joints, stiffness_of(config), rotors, strict=True)
    missing = [
        name for name, stiffness, rotor in springs if stiffness > 0.0 and rotor <= 0.0
    ]
    if missing:
        raise BlfDscError(
            f'joint.stiffness: {", ".join(missing)} has no inertia on the side of the '
            'motor: give truth.rotor_inertia'
        )


def _at_start(config: PlantConfig, arm: RigidArm) -> tuple[np.ndarray, np.ndarray]:
    """Return M and M^-1 of base and links at the initial position."""
    m = mounts_of(config) + len(config.joints)
    q, rest, bias = np.zeros((3, m))
    q[mounts_of(config) :] = config.initial.position
    mobility = np.zeros((m, m))
    fill_mobility(arm.bodies, arm.memory, 0.0, q, rest, mobility, bias)
    return motion_of(arm.memory, bodies_of(arm.bodies)).M.copy(), mobility


def _highest_frequency(
    config: PlantConfig, mobility: np.ndarray, motors: np.ndarray
) -> float:
    """Return an upper limit [rad/s] of the frequencies of springs and loops, in any posture."""
    n, K, actuator = len(config.joints), stiffness_of(config), config.actuator
    links = np.abs(mobility[-n:, -n:]) * np.sqrt(np.outer(K, K))
    square = links.sum(axis=1) + (1.0 + actuator.loop_gain) * K * motors
    if actuator.loop_lag > 0.0:  # the loop's damping and its lag
        square += actuator.loop_damping * K * motors / actuator.loop_lag
    return math.sqrt(_POSTURES * square.max())


def _base_of(config: PlantConfig, M: np.ndarray) -> Base:
    """Return springs and dampers with which all modes of base and arm have one frequency."""
    mounts = mounts_of(config)
    omega = 2.0 * np.pi * config.base.frequency
    block = M[:mounts, :mounts]
    damping = 2.0 * config.base.damping_ratio * omega * block
    return Base(omega**2 * block, damping)
