# SPDX-License-Identifier: Apache-2.0
"""The settings of a configured plant, and what of its arm they are made from."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from blf_dsc_controller.arms.inertia import inertia_of, moved, pseudo_inertia
from blf_dsc_controller.arms.two_link import PARAMETER_NAMES, urdf
from blf_dsc_controller.arms.urdf import Chain
from blf_dsc_controller.compiled.layout import filled, pack
from blf_dsc_controller.configuration.plant import Deviation, PlantConfig
from blf_dsc_controller.configuration.robot import parameters_of
from sim_plant.arm import (
    Arm,
    PointMassArm,
    RigidArm,
    motion_size,
    rigid_arm,
    rigid_bodies,
)
from sim_plant.kernels import lag
from sim_plant.layout import (
    SIDES,
    VELOCITY_SOURCES,
    Disturbance,
    Drives,
    Encoders,
    Events,
    Load,
    PlantSettings,
)
from sim_plant.springs import (
    MOST_STEPS,
    Elasticity,
    apparent_rotors,
    elastic,
    is_elastic,
    mounts_of,
    on_base,
    rigid,
    stiffness_of,
)

_RESOLVED = 1.5  # decay within a step; the integrator is stable up to 3.3
_CURRENT = 0.1  # A/N m, of motors with their gears, roughly that of cobots


def parameter_order(names: Sequence[str], config: PlantConfig) -> np.ndarray:
    """Return the index in P of each parameter of a model.

    All -1 if the model has others.
    """
    true = parameter_names_of(config)
    known = set(names) == set(true)
    return np.array([true.index(name) if known else -1 for name in names])


def plant_settings(config: PlantConfig) -> PlantSettings:
    """Return the settings of a configured plant.

    Raises:
        BlfDscError: a joint has a spring, but no motor.
    """
    arm = arm_of(config)
    drives = _drives_of(config)
    return PlantSettings(
        arm=arm,
        n=len(config.joints),
        p=arm.p,
        period_ns=config.sample_time_ns,
        events=len(config.events.begin),
        bodies_size=drives.bodies.size,
        memory_size=motion_size(arm) if drives.bodies.size else 0,
        encoders=_encoders_of(config),
        disturbance=_disturbance_of(config),
        drives=drives,
        load=_load_of(config),
        schedule=_schedule_of(config),
        **_elasticity_of(config, arm)._asdict(),
    )


def _encoders_of(config: PlantConfig) -> Encoders:
    """Return what the encoders measure, and how well."""
    sensor = config.sensor
    n = len(config.joints)
    return filled(
        Encoders,
        sensor,
        velocity_source=VELOCITY_SOURCES[sensor.velocity],
        side=SIDES[sensor.side],
        eccentricity=np.array(sensor.eccentricity or np.zeros(n)),
    )


def _disturbance_of(config: PlantConfig) -> Disturbance:
    """Return friction and torque ripple."""
    given = config.disturbance
    actuator = config.actuator
    return filled(
        Disturbance,
        given,
        ripple=actuator.ripple * np.array(actuator.torque_limit),
        ripple_frequency=actuator.ripple_cycles,
        warm_samples=given.warm_time / config.sample_time,
    )


def _drives_of(config: PlantConfig) -> Drives:
    """Return how the drives apply torques, what they compensate, and report as effort."""
    actuator = config.actuator
    robot = config.robot
    T = config.sample_time
    decay, mean_decay = lag(actuator.time_constant, T)
    overcomes_friction = robot.drive_compensates == 'gravity_and_friction'
    return filled(
        Drives,
        actuator,
        decay=decay,
        mean_decay=mean_decay,
        friction=config.drive.friction if overcomes_friction else 0.0,
        effort_is_whole=int(robot.effort != 'commanded'),
        effort_scale=_CURRENT if robot.effort == 'current' else 1.0,
        step=actuator.rate_limit * T,
        jump=actuator.reflex_rate * T,
        bodies=drive_bodies(config),
    )


def _load_of(config: PlantConfig) -> Load:
    """Return how a load sloshes, and the gravity on it."""
    robot = config.robot
    events = config.events
    omega = events.sloshing_frequency
    gravity = robot.gravity if robot.urdf else (0.0, 0.0, -config.arm.gravity)
    return filled(
        Load,
        config.load,
        config.sensor,
        stiffness=omega**2,
        damping=2.0 * events.sloshing_damping * omega,
        gravity=np.array(gravity),
    )


def _elasticity_of(config: PlantConfig, arm: Arm) -> Elasticity:
    """Return the springs of an arm, and the integrator's steps."""
    slope = _friction_slope(config)
    if not isinstance(arm, RigidArm) or not is_elastic(config):
        return rigid(_steps_of(config, arm, slope))
    return elastic(config, arm, true_rotors(config), slope)


def _friction_slope(config: PlantConfig) -> np.ndarray:
    """Return the largest slope (n,) [N m s/rad] of friction, near rest."""
    n = len(config.joints)
    given = config.disturbance
    events = config.events
    viscous, coulomb = (
        np.reshape(each or 0.0, (-1, n) if each else (1, 1)).max(axis=0)
        for each in (events.viscous, events.coulomb)
    )
    share = given.load_share * (1.0 + abs(given.load_asymmetry))
    load = share * np.array(config.actuator.torque_limit)
    slope = (
        (np.array(given.coulomb) + coulomb + load)
        * (1.0 + given.stribeck)
        / given.coulomb_velocity
    )
    slope += np.array(given.viscous) + viscous
    return np.asarray(slope * max(1.0, given.warm_factor))


def _steps_of(config: PlantConfig, arm: Arm, slope: np.ndarray) -> int:
    """Return the integrator's steps per sample that friction near rest needs.

    There it damps a joint at its slope over the inertia, at the initial position.
    """
    n = len(config.joints)
    position = np.array(config.initial.position)
    rest = np.zeros(n)
    ddq = np.zeros((2, n))
    arm.accelerate(0.0, position, rest, rest, ddq[0])
    rate = 0.0
    for i, torque in enumerate(np.eye(n)):
        arm.accelerate(0.0, position, rest, torque, ddq[1])
        rate = max(rate, float(slope[i] * (ddq[1, i] - ddq[0, i])))
    return min(max(1, math.ceil(config.sample_time * rate / _RESOLVED)), MOST_STEPS)


def _schedule_of(config: PlantConfig) -> Events:
    """Return the events with times in samples, and zeros for what is not given."""
    events = config.events
    count = len(config.events.begin)
    n = len(config.joints)

    def values(name: str, *shape: int) -> np.ndarray:
        given = getattr(events, name)
        return (
            np.reshape(given, (count, *shape)) if given else np.zeros((count, *shape))
        )

    def samples(times: np.ndarray) -> np.ndarray:
        return np.rint(times / config.sample_time)

    begin = values('begin')
    duration = values('duration')
    return Events(
        begin=samples(begin),
        end=np.where(duration > 0.0, samples(begin + duration), np.inf),
        ramp=samples(values('ramp')),
        payload=values('payload'),
        sloshing=values('sloshing'),
        force=values('force', 3),
        **{
            name: values(name, n) for name in ('torque', 'viscous', 'coulomb', 'offset')
        },
    )


def steps_of(config: PlantConfig) -> int:
    """Return the number of steps; 0 means until stopped."""
    return round(config.duration / config.sample_time)


def arm_of(config: PlantConfig) -> Arm:
    """Return the arm of a configuration."""
    robot = config.robot
    if not robot.urdf:
        return PointMassArm(*vars(config.arm).values())
    chain = robot.chain(config.joints)
    rotors = true_rotors(config)
    inertias = true_inertias(chain, config.truth)
    parameters = parameters_of(robot, chain)
    seen = apparent_rotors(config, rotors)
    bodies = rigid_bodies(chain, robot.gravity, inertias, seen, parameters)
    bodies.rotor[:] = np.where(stiffness_of(config) > 0.0, 0.0, rotors)
    if config.base.mass > 0.0:
        bodies = on_base(bodies, config.base.mass)
    return rigid_arm(bodies, mounts_of(config))


def true_rotors(config: PlantConfig) -> np.ndarray:
    """Return the inertias (n,) [kg m^2] of the drives of an arm from a URDF."""
    if config.truth.rotor_inertia:
        return np.array(config.truth.rotor_inertia)
    robot = config.robot
    return config.truth.rotor_factor * robot.rotors(robot.chain(config.joints))


def drive_bodies(config: PlantConfig) -> np.ndarray:
    """Return the packed `RigidBodies` by which the drives compensate gravity.

    Empty without.
    """
    robot = config.robot
    if robot.drive_compensates == 'none':
        return np.zeros(0)
    chain = robot.chain(config.joints)
    inertias = robot.drive_inertias(chain, true_inertias(chain, config.drive))
    return pack(
        rigid_bodies(
            chain, robot.known_drive_gravity, inertias, np.zeros(len(chain.joints))
        )
    )


def true_inertias(chain: Chain, truth: Deviation) -> np.ndarray:
    """Return the URDF's inertias (n, 10) with masses scaled and shifted."""
    placement = np.eye(4)
    inertias = np.empty((len(chain.joints), 10))
    for i, (factor, shift) in enumerate(
        zip(*truth.changes(len(inertias)), strict=True)
    ):
        placement[:3, 3] = shift
        J = pseudo_inertia(chain.joints[i].inertia)
        inertias[i] = inertia_of(factor * moved(J, placement))
    return inertias


def parameter_names_of(config: PlantConfig) -> tuple[str, ...]:
    """Return the names of the true parameters P of a configured arm."""
    robot = config.robot
    if not robot.urdf:
        return PARAMETER_NAMES
    return parameters_of(robot, robot.chain(config.joints)).model.parameter_names


def urdf_of(config: PlantConfig) -> str:
    """Return the URDF of a configured arm."""
    if config.robot.urdf:
        return config.robot.text
    arm = config.arm
    return urdf(config.joints, (arm.l1, arm.l2), (arm.m1, arm.m2))
