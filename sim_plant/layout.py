# SPDX-License-Identifier: Apache-2.0
"""Settings and state of the plant: one flat vector each, in parts by what they describe."""

from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.layout import Array, Cell, Passed, size_of, view_of
from sim_plant.arm import Arm

MEASURED = 0
DIFFERENCED = 1
VELOCITY_SOURCES = {'measured': MEASURED, 'differenced': DIFFERENCED}
LINK = 0
MOTOR = 1
BOTH = 2
SIDES = {'link': LINK, 'motor': MOTOR, 'both': BOTH}


class Encoders(NamedTuple):
    """Quality of the encoders, the same on every joint but for their eccentricity."""

    side: int  # of the springs: LINK, MOTOR, or BOTH: the motors apart
    position_noise: float  # rad, standard deviation
    velocity_noise: float  # rad/s, standard deviation; not used when differenced
    resolution: float  # rad, 0 = none
    velocity_source: int  # MEASURED or DIFFERENCED
    velocity_pole: float  # rad/s, 0 = no filter
    # samples after which the last reading is sent once more; 0: never
    repeat_every: int
    eccentricity: Annotated[Array, 'n']  # rad


class Disturbance(NamedTuple):
    """Disturbance of each joint.

    Constant, viscous and coulomb as they are without events.
    """

    constant: Annotated[Array, 'n']  # N m
    amplitude: Annotated[Array, 'n']  # N m
    frequency: Annotated[Array, 'n']  # rad/s
    phase: Annotated[Array, 'n']  # rad
    viscous: Annotated[Array, 'n']  # N m s/rad
    coulomb: Annotated[Array, 'n']  # N m
    coulomb_velocity: float  # rad/s, at which tanh reaches three quarters
    stribeck: float  # additional friction near rest, relative to Coulomb friction
    stribeck_velocity: float  # rad/s
    ripple: Annotated[Array, 'n']  # N m
    ripple_frequency: float  # rad/rad
    load_share: float  # additional Coulomb friction, relative to the load on the gear
    load_asymmetry: float  # of this share: more where the motor drives the load
    warm_factor: float  # friction in the end, relative to that at the start
    warm_samples: float  # samples in which 63 % of this change has happened


class Springs(NamedTuple):
    """Springs between motors and links, and the loop of the drives around them.

    A joint without stiffness is rigid: its motor is part of its link.
    """

    stiffness: Annotated[Array, 'springs']  # N m/rad; 0: none
    damping: Annotated[Array, 'springs']  # N m s/rad
    play: Annotated[Array, 'springs']  # rad, to either side
    hysteresis: Annotated[Array, 'springs']  # N m, of dry friction within the spring
    mobility: Annotated[Array, 'springs']  # of the motor, 1/(kg m^2)
    loop_gain: float
    loop_damping: float  # s
    loop_decay: float  # of the loop's lag in half a step
    loop_limit: Annotated[Array, 'springs']  # of the motors, N m; 0: none
    # of the joint torque sensors, which loop and reading share
    sensor_factor: Annotated[Array, 'springs']
    sensor_offset: Annotated[Array, 'springs']  # N m
    sensor_noise: Annotated[Array, 'springs']  # of the reading, N m


class Base(NamedTuple):
    """Springs and dampers beneath the arm, of the coordinates of `on_base`."""

    stiffness: Annotated[Array, 'mounts', 'mounts']
    damping: Annotated[Array, 'mounts', 'mounts']


class Drives(NamedTuple):
    """Properties of the drives of all joints, what they add, and the jump at which they stop.

    The lag is solved exactly for a held command; the torque applied in a sample is its
    mean.
    """

    torque_limit: Annotated[Array, 'n']  # N m, 0 = none
    delay: int  # samples
    decay: float  # of the lag over a sample, exp(-T / time constant); 0: no lag
    mean_decay: float  # its mean over the sample
    torque_noise: float  # standard deviation, relative to the torque
    friction: float  # share of viscous and Coulomb friction that they compensate
    effort_is_whole: int  # 1: the measured effort contains what they add
    effort_scale: float  # of the measured effort: 1, or A/N m of a current
    step: float  # N m from one command to the next that their driver lets pass; 0: any
    jump: float  # N m from one torque to the next at which they stop; 0: none
    # RigidBodies of their model; empty: they add nothing
    bodies: Annotated[Array, 'bodies_size']


class Load(NamedTuple):
    """Load that acts all the time, and spring and damper of a sloshing one, per kg."""

    payload: float  # kg, point mass at the tip
    torque: Annotated[Array, 'n']  # N m, pushes the joints
    force: Annotated[Array, 3]  # N, pushes the tip, in the frame of the base
    offset: Annotated[Array, 'n']  # rad, measured minus true position
    stiffness: float  # omega^2, 1/s^2
    damping: float  # 2 zeta omega, 1/s
    gravity: Annotated[Array, 3]  # g, m/s^2


class Events(NamedTuple):
    """Contribution of each event to load and friction; times are in samples."""

    begin: Annotated[Array, 'events']
    end: Annotated[Array, 'events']  # infinite: permanent
    ramp: Annotated[Array, 'events']
    payload: Annotated[Array, 'events']
    sloshing: Annotated[Array, 'events']
    torque: Annotated[Array, 'events', 'n']
    force: Annotated[Array, 'events', 3]
    viscous: Annotated[Array, 'events', 'n']
    coulomb: Annotated[Array, 'events', 'n']
    offset: Annotated[Array, 'events', 'n']


class PlantSettings(NamedTuple):
    """Everything that defines a plant except its seed and its initial state.

    The arm is passed to kernels as is, everything else in one vector.
    """

    arm: Arm
    n: Passed  # joints of the arm
    p: int  # parameters of the arm
    period_ns: int
    steps: int  # of the integrator in a sample, or in a block of it
    blocks: int  # in a sample, in each of which M is held; rigid arms have none
    springs: int  # n, or 0 if joints and base are rigid
    mounts: int  # coordinates of the base; 0: it is rigid
    events: int  # number of events
    bodies_size: int  # of drives.bodies
    memory_size: int  # of their motion
    encoders: Encoders
    disturbance: Disturbance
    drives: Drives
    transmission: Springs
    base: Base
    load: Load
    schedule: Events


class EncoderReading(NamedTuple):
    """The latest reading, and its sample."""

    sample: Cell  # -1 before the first reading
    noise: Annotated[Array, '2 * n']  # standard normal: positions, velocities
    position: Annotated[Array, 'n']  # rad
    velocity: Annotated[Array, 'n']  # rad/s


class DriveState(NamedTuple):
    """Torques on their way from the command to the joint."""

    stopped: Cell  # 1: after a jump
    command: Annotated[Array, 'n']  # the last one that the driver let pass, N m
    ring: Annotated[Array, 'drives.delay', 'n']  # delayed commands, N m
    noise: Annotated[Array, 'n']  # standard normal
    motor: Annotated[Array, 'n']  # at the end of the sample, N m
    applied: Annotated[Array, 'n']  # mean over the sample, N m
    added: Annotated[Array, 'n']  # by the drives, N m
    eased: Annotated[Array, 'n']  # of it, against friction, N m
    sensed: Annotated[Array, 'n']  # noise of the torque sensors, standard normal
    whole: Annotated[Array, 'n']  # torque at the joints, N m
    memory: Annotated[Array, 'memory_size']  # BodyMotion


class Acting(NamedTuple):
    """Sum of load and events in one sample."""

    sample: Cell  # of the sum; -1: none yet
    payload: Cell  # kg
    sloshing: Cell  # kg
    force: Annotated[Array, 3]  # N
    offset: Annotated[Array, 'n']  # rad
    # N m, of the disturbance, less torques that push the joints
    constant: Annotated[Array, 'n']
    viscous: Annotated[Array, 'n']  # N m s/rad, not below zero
    coulomb: Annotated[Array, 'n']  # N m, not below zero


class Memory(NamedTuple):
    """Working memory of a step of the integrator."""

    point: Annotated[Array, '2 * n + 6']
    k: Annotated[Array, 6, '2 * n + 6']
    tip: Annotated[Array, 3]  # m
    tip_velocity: Annotated[Array, 3]  # m/s
    jacobian: Annotated[Array, 3, 'n + mounts']  # m/rad
    pull: Annotated[Array, 3]  # acceleration a of the sloshing load, m/s^2


class Elastic(NamedTuple):
    """Motion of base, links and motors; only of plants with springs or such a base.

    The base's coordinates come before those of the links.
    """

    block: Cell  # of the present sample
    q: Annotated[Array, 'springs + mounts']  # rad, or m
    dq: Annotated[Array, 'springs + mounts']
    dq_before: Annotated[Array, 'springs + mounts']  # at the start of the last block
    theta: Annotated[Array, 'springs']  # rad, of the motors
    dtheta: Annotated[Array, 'springs']
    torque: Annotated[Array, 'springs']  # of the motors, behind their loop, N m
    hysteresis: Annotated[Array, 'springs']  # N m
    # by the springs, mean over the sample, N m
    transmitted: Annotated[Array, 'springs']
    # of the base's springs, by the weight of the arm
    preload: Annotated[Array, 'mounts']


class ElasticMemory(NamedTuple):
    """Working memory of a block of steps."""

    q: Annotated[Array, 'springs + mounts']  # in the middle of the block, as predicted
    dq: Annotated[Array, 'springs + mounts']
    inverse: Annotated[Array, 'springs + mounts', 'springs + mounts']  # of M
    bias: Annotated[Array, 'springs + mounts']  # N m, less what loads the links
    load: Annotated[Array, 'springs + mounts']  # the bias less a sloshing mass, N m
    force: Annotated[Array, 'springs + mounts']  # of motors or springs, N m
    spring: Annotated[Array, 'springs']  # torque by its twist, N m
    touches: Annotated[Array, 'springs']  # 1: outside of the play
    sum: Annotated[Array, 'springs']  # of transmitted torques, N m
    # middle of a kick: velocities of base and links, of motors, and accelerations
    speed: Annotated[Array, 'springs + mounts']
    motor_speed: Annotated[Array, 'springs']
    ddq: Annotated[Array, 'springs + mounts']
    ddtheta: Annotated[Array, 'springs']


class PlantState(NamedTuple):
    """Everything that changes from sample to sample except the random generator."""

    sample: Cell  # k
    # q [rad], dq [rad/s], noise-free; load: y [m], v [m/s]
    x: Annotated[Array, '2 * n + 6']
    sloshes: Cell  # 1: y and v are those of a load
    reading: EncoderReading
    drives: DriveState
    acting: Acting
    memory: Memory
    elastic: Elastic
    elastic_memory: ElasticMemory


settings_of = view_of(PlantSettings)
state_of = view_of(PlantState)
state_size = size_of(PlantState)
