# SPDX-License-Identifier: Apache-2.0
"""The simulated plant: its arm, its vectors and its random generator.

`TorqueInput` and `Latency` follow the torques that its node receives.  They are the
counterpart of the controller's checks of joint states: a motor that applies an outdated
torque, or one that is not finite, is as dangerous as a law that commands one.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from blf_dsc_controller.arms.two_link import PARAMETER_NAMES, urdf
from blf_dsc_controller.arms.urdf import Chain, inertia_of, moved, pseudo_inertia
from blf_dsc_controller.compiled.entry import Entry
from blf_dsc_controller.compiled.jit import direct
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
from sim_plant.elastic import REST, run_elastic_plant
from sim_plant.kernels import (
    OBSERVE,
    STEP,
    TRUTH,
    drawn,
    generator,
    is_due,
    is_repeat,
    lag,
    plant_views,
    run_plant,
)
from sim_plant.layout import (
    SIDES,
    VELOCITY_SOURCES,
    Disturbance,
    Drives,
    Encoders,
    Events,
    Load,
    PlantSettings,
    state_size,
)
from sim_plant.springs import (
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
_MOST_STEPS = 1000
_CURRENT = 0.1  # A/N m, of motors with their gears, roughly that of cobots


LARGEST = 1e4
"""Largest valid torque [N m] of a command.

A step with 1e6 N m makes the arm diverge.
"""


class Plant:
    """A sampled arm: call `measure()`, then `step(torque)`, in turn.

    It starts at `position` (n,) [rad] with `velocity` (n,) [rad/s]; `seed` determines
    the noise, so the same seed repeats the run.

    Attributes:
        is_compiled: whether compiled loops can step it, from `arm`, `settings` and `state`.
    """

    is_compiled = True

    def __init__(
        self,
        settings: PlantSettings,
        position: ArrayLike,
        velocity: ArrayLike,
        seed: int = 0,
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
        self._noise = np.zeros(3 * self.joints)
        self.rng = generator(seed)
        if settings.springs > 0:
            self._now.acting.sample[0] = -1.0
            self._run(*self._arguments(REST, self._truth))
        self._now.reading.sample[0] = self._now.acting.sample[0] = -1.0
        self._initial = self.state.copy()

    @functools.cached_property
    def kernel(self) -> Entry:
        """The kernel of `step`, `measure` and `truth`, for a compiled loop."""
        return Entry(self._compiled, *self._arguments(STEP, self._truth))

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
            self.rng.standard_normal(out=self._noise[drawn(self._settings)])
        self._run(*self._arguments(OBSERVE, self._truth))
        return self._measurement

    def noise_of(self, samples: int) -> np.ndarray:
        """Draw the noise (samples, 3n) of this sample and of those that follow.

        It is for a compiled loop. A reading that is made already, or repeated, has none.
        """
        k = self.sample + np.arange(samples)
        is_new = k != self._now.reading.sample[0]
        due = is_new & ~is_repeat(self._settings.encoders, k)
        noise = np.zeros((samples, 3 * self.joints))
        columns = drawn(self._settings)
        shape = np.count_nonzero(due), columns.stop - columns.start
        noise[due, columns] = self.rng.standard_normal(shape)
        return noise

    def step(self, torque: np.ndarray) -> None:
        """Apply the commanded torque (n,) [N m] and advance to the next sample."""
        self._run(*self._arguments(STEP, torque))

    def change(self, settings: PlantSettings) -> None:
        """Switch to settings with the same number of joints, period and delay."""
        self.arm = settings.arm
        self.settings = pack(settings)
        self._settings, self._now = plant_views(self.arm, self.settings, self.state)
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

    def save(self) -> tuple[np.ndarray, Mapping[str, Any]]:
        """Return a copy of everything that changes, with the generator's state."""
        return self.state.copy(), self.rng.bit_generator.state

    def restore(self, saved: tuple[np.ndarray, Mapping[str, Any]]) -> None:
        """Restore what was saved by a plant with the same settings."""
        self.state[:], self.rng.bit_generator.state = saved


class TorqueInput:
    """The last valid `torque` (n,) [N m], and counts of rejected commands.

    `problem` describes the last rejected command; `stale_steps` counts the steps for
    which the torque was too old.
    """

    def __init__(self, n: int) -> None:
        self.torque = np.zeros(n)
        self.problem = ''
        self.rejected = 0
        self.stale_steps = 0
        self._taken_at = 0

    def take(self, size: int, torque: NDArray[np.float64], sample: int) -> bool:
        """Store a command of `size` values, `torque` (n,), at a sample of the plant.

        Returns whether it is valid; if not, `problem` describes why.
        """
        if size == self.torque.size and (np.abs(torque) <= LARGEST).all():
            self.torque[:] = torque
            self._taken_at = sample
            return True
        self.rejected += 1
        got = f'{torque} N m' if size == self.torque.size else f'{size} values'
        needed = f'{self.torque.size} of at most {LARGEST:g} N m are needed'
        self.problem = f'command rejected: got {got}, but {needed}'
        return False

    def is_stale(self, sample: int, limit: int) -> bool:
        """Return whether the torque is older than `limit` samples, and count it."""
        stale = sample - self._taken_at > limit
        self.stale_steps += stale
        return stale

    def renew(self, sample: int) -> None:
        """Measure the age of the torque from `sample` on."""
        self._taken_at = sample


class Latency:
    """Time from a published state to its torque, and the number of late steps.

    A torque does not identify its state. It is matched with the oldest state that has
    had no torque yet, so that a late torque counts with its full delay. Times are in s;
    `late_steps` counts the steps taken before a torque for their state had arrived.
    """

    def __init__(self) -> None:
        self.late_steps = 0
        self._since: float | None = None
        self._longest = 0.0

    def state_published(self, now: float) -> None:
        """Start waiting, unless an older state has had no torque yet."""
        if self._since is None:
            self._since = now

    def torque_received(self, now: float) -> None:
        """Stop waiting."""
        if self._since is not None:
            self._longest = max(self._longest, now - self._since)
            self._since = None

    def step(self, now: float) -> float:
        """End a sample.

        Return its longest wait, or the wait of the oldest state so far.
        """
        if self._since is not None:
            self.late_steps += 1
            return now - self._since
        longest, self._longest = self._longest, 0.0
        return longest


def parameter_order(names: Sequence[str], config: PlantConfig) -> np.ndarray:
    """Return the index in P of each parameter of a model.

    All -1 if the model has others.
    """
    true = parameter_names_of(config)
    known = set(names) == set(true)
    return np.array([true.index(name) if known else -1 for name in names])


def plant_of(config: PlantConfig) -> Plant:
    """Return the plant of a configuration, at sample 0.

    Raises:
        BlfDscError: its physics is MuJoCo's, which is missing or cannot read the arm.
    """
    if config.physics == 'mujoco':
        from sim_plant.mujoco_plant import MujocoPlant  # its base is in this module

        return MujocoPlant(config)
    start = config.initial
    return Plant(plant_settings(config), start.position, start.velocity, config.seed)


def plant_settings(config: PlantConfig) -> PlantSettings:
    """Return the settings of a configured plant.

    Raises:
        BlfDscError: a joint has a spring, but no motor.
    """
    arm = arm_of(config)
    n = len(config.joints)
    T = config.sample_time
    sensor = config.sensor
    actuator = config.actuator
    events = config.events
    robot = config.robot
    friction = config.disturbance
    decay, mean_decay = lag(actuator.time_constant, T)
    overcomes_friction = robot.drive_compensates == 'gravity_and_friction'
    bodies = drive_bodies(config)
    omega = events.sloshing_frequency
    return PlantSettings(
        arm=arm,
        n=n,
        p=arm.p,
        period_ns=config.sample_time_ns,
        events=len(events.begin),
        bodies_size=bodies.size,
        memory_size=motion_size(arm) if bodies.size else 0,
        encoders=filled(
            Encoders,
            sensor,
            velocity_source=VELOCITY_SOURCES[sensor.velocity],
            side=SIDES[sensor.side],
            eccentricity=np.array(sensor.eccentricity or np.zeros(n)),
        ),
        disturbance=filled(
            Disturbance,
            friction,
            ripple=actuator.ripple * np.array(actuator.torque_limit),
            ripple_frequency=actuator.ripple_cycles,
            warm_samples=friction.warm_time / T,
        ),
        drives=filled(
            Drives,
            actuator,
            decay=decay,
            mean_decay=mean_decay,
            friction=config.drive.friction if overcomes_friction else 0.0,
            effort_is_whole=int(robot.effort != 'commanded'),
            effort_scale=_CURRENT if robot.effort == 'current' else 1.0,
            step=actuator.rate_limit * T,
            jump=actuator.reflex_rate * T,
            bodies=bodies,
        ),
        load=filled(
            Load,
            config.load,
            sensor,
            stiffness=omega**2,
            damping=2.0 * events.sloshing_damping * omega,
            gravity=np.array(
                robot.gravity if robot.urdf else (0.0, 0.0, -config.arm.gravity)
            ),
        ),
        schedule=_schedule_of(config),
        **_elasticity_of(config, arm)._asdict(),
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
    load = given.load_share * np.array(config.actuator.torque_limit)
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
    return min(max(1, math.ceil(config.sample_time * rate / _RESOLVED)), _MOST_STEPS)


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
        rigid_bodies(chain, robot.gravity, inertias, np.zeros(len(chain.joints)))
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
