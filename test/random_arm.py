# SPDX-License-Identifier: Apache-2.0
"""Random serial arms as URDFs; arms in motion, as bags of joint states with efforts."""

from __future__ import annotations

from itertools import zip_longest
from math import tanh
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pinocchio

from blf_dsc_controller import PlantConfig
from blf_dsc_controller.arms.inertia import inertia_of, pseudo_inertia
from blf_dsc_controller.arms.urdf import read_chain
from blf_dsc_controller.bags.writer import BagWriter
from blf_dsc_controller.compiled.jit import kernel
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.identification.corrected_urdf import corrected_urdf
from blf_dsc_controller.identification.recording import Recording
from blf_dsc_controller.identification.values import base_matrix
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import (
    Float64MultiArrayEncoder,
    JointStateEncoder,
)
from sim_plant.arm import rigid_arm, rigid_bodies
from sim_plant.plant import plant_of

CONFIG = Path(__file__).parents[1] / 'config'
PANDA = tuple(f'panda_joint{i}' for i in range(1, 8))
UR5E = (
    'shoulder_pan_joint',
    'shoulder_lift_joint',
    'elbow_joint',
    'wrist_1_joint',
    'wrist_2_joint',
    'wrist_3_joint',
)


def words(numbers):
    return ' '.join(repr(float(number)) for number in numbers)


def cloud(random):
    """Return mass, centre and inertia of a random cloud of points, which is always physical."""
    points = random.normal(size=(5, 3)) * random.uniform(0.02, 0.2, 3)
    mass = random.uniform(0.2, 4.0)
    second = (points - points.mean(0)).T @ (points - points.mean(0)) * mass / 5.0
    return mass, points.mean(0), np.trace(second) * np.eye(3) - second


def link(name, random):
    """Return a link that is a random cloud of points, or one without a body."""
    if random is None:
        return f'<link name="{name}" />'
    mass, centre, I = cloud(random)
    entries = zip(
        ('ixx', 'ixy', 'ixz', 'iyy', 'iyz', 'izz'), I[np.triu_indices(3)], strict=True
    )
    return (
        f'<link name="{name}"><inertial>'
        f'<origin xyz="{words(centre)}" rpy="{words(random.uniform(-3, 3, 3))}" />'
        f'<mass value="{mass!r}" />'
        f'<inertia {" ".join(f"""{key}="{float(value)!r}" """ for key, value in entries)} />'
        '</inertial></link>'
    )


def joint(name, kind, parent, child, random):
    xyz = words(random.uniform(-0.4, 0.4, 3))
    rpy = words(random.uniform(-3.0, 3.0, 3))
    return (
        f'<joint name="{name}" type="{kind}"><origin xyz="{xyz}" rpy="{rpy}" />'
        f'<parent link="{parent}" /><child link="{child}" />'
        f'<axis xyz="{words(random.normal(size=3))}" />'
        '<limit lower="-1.5" upper="2.5" velocity="2.0" effort="30.0" /></joint>'
    )


def random_urdf(n, seed):
    """Return the URDF of a chain from `base` to `tip`, and its joints j1 ..

    Jn of all kinds.

    Each joint is followed by a fixed joint, and links with mass branch off.
    """
    random = np.random.default_rng(seed)
    text, at = [link('base', random)], 'base'
    for i in range(1, n + 1):
        kind = random.choice(('revolute', 'continuous', 'prismatic'), p=(0.5, 0.2, 0.3))
        text += [link(f'l{i}', random), joint(f'j{i}', kind, at, f'l{i}', random)]
        text += [
            link(f'aside{i}', random),
            joint(f'a{i}', 'fixed', f'l{i}', f'aside{i}', random),
        ]
        text += [
            link(f'flange{i}', None),
            joint(f'f{i}', 'fixed', f'l{i}', f'flange{i}', random),
        ]
        at = f'flange{i}'
    text += [link('tip', None), joint('tip_joint', 'fixed', at, 'tip', random)]
    text += [link('tool', random), joint('tool_joint', 'fixed', 'tip', 'tool', random)]
    random.shuffle(text)
    return f'<robot name="arm">{"".join(text)}</robot>', tuple(
        f'j{i}' for i in range(1, n + 1)
    )


def pinocchio_model(text, joints):
    """Return the arm with these joints; all others are fixed at 0."""
    model = pinocchio.buildModelFromXML(text)
    others = [model.getJointId(name) for name in model.names[1:] if name not in joints]
    return pinocchio.buildReducedModel(model, others, pinocchio.neutral(model))


def configuration(model, q):
    """Return pinocchio's configuration, with cosine and sine of continuous joints."""
    return pinocchio.integrate(model, pinocchio.neutral(model), q)


PANDA_TEXT, UR5E_TEXT = (
    (CONFIG / f'{name}.urdf').read_text() for name in ('panda', 'ur5e')
)
ARMS = {
    'one': (*random_urdf(1, 11), 'base', 'tip'),
    'two': (*random_urdf(2, 12), 'base', 'tip'),
    'three': (*random_urdf(3, 13), 'base', 'tip'),
    'six': (*random_urdf(6, 14), 'base', 'tip'),
    'nine': (*random_urdf(9, 15), 'base', 'tip'),
    'panda': (PANDA_TEXT, PANDA, 'panda_link0', 'panda_hand_tcp'),
    'ur5e': (UR5E_TEXT, UR5E, 'world', 'tool0'),
}
"""URDF, joints, base and tip of each arm."""


def chain_of(name):
    text, joints, base, tip = ARMS[name]
    return read_chain(text, base, tip, joints)


# In motion.

PANDA_CHAIN = chain_of('panda')
GRAVITY = (0.0, 0.0, -9.81)
PERIOD = 0.001  # s


class Truth(NamedTuple):
    """The true values that a URDF lacks: n bodies, rotors and friction."""

    inertias: np.ndarray  # (n, 10)
    rotors: np.ndarray  # (n,) kg m^2
    viscous: np.ndarray  # (n,) N m s/rad
    coulomb: np.ndarray  # (n,) N m


def changed(chain, random, share=0.3, centre=0.01):
    """Return inertias (n, 10), scaled at random by `share`, moved at random by `centre` [m]."""
    bodies = []
    for joint in chain.joints:
        T = np.eye(4)
        T[:3, 3] = centre * random.normal(size=3)
        J = T @ pseudo_inertia(joint.inertia) @ T.T
        bodies.append(inertia_of(np.exp(share * random.normal()) * J))
    return np.array(bodies)


def truth_of(chain, seed):
    random = np.random.default_rng(seed)
    efforts = np.array([min(joint.effort, 100.0) for joint in chain.joints])
    return Truth(
        changed(chain, random),
        efforts / 400.0 * random.uniform(0.5, 1.5, efforts.size),
        0.02 * efforts * random.uniform(0.5, 1.5, efforts.size),
        0.02 * efforts * random.uniform(0.5, 1.5, efforts.size),
    )


def holding(truth, mass, centre=(0.0, 0.0, 0.0)):
    """Return the truth of a Panda with a ball [kg] in its tip, `centre` [m] from there."""
    T = PANDA_CHAIN.tip_placement.copy()
    T[:3, 3] += T[:3, :3] @ centre
    bodies = truth.inertias.copy()
    bodies[-1] += inertia_of(T @ (mass * np.diag((2e-4, 2e-4, 2e-4, 1.0))) @ T.T)
    return truth._replace(inertias=bodies)


class Reference(NamedTuple):
    """Sums of sinusoids: offset + sum amplitude sin(frequency t + phase)."""

    offset: np.ndarray  # (n,) rad
    amplitude: np.ndarray  # (k, n) rad
    frequency: np.ndarray  # (k, n) rad/s
    phase: np.ndarray  # (k, n) rad

    def at(self, t):
        """Return position, velocity and acceleration (..., 3, n) at times (...) [s]."""
        w = self.frequency
        angle = np.multiply.outer(t, self.frequency) + self.phase
        sines = self.amplitude * np.sin(angle)
        cosines = self.amplitude * np.cos(angle)
        motion = (
            sines.sum(-2) + self.offset,
            (w * cosines).sum(-2),
            -(w**2 * sines).sum(-2),
        )
        return np.stack(motion, -2)


def reference_of(chain, seed, tones=3):
    random = np.random.default_rng(seed)
    n = len(chain.joints)
    limits = np.clip([(joint.lower, joint.upper) for joint in chain.joints], -2.0, 2.0)
    amplitude = random.uniform(0.5, 1.0, (tones, n))
    amplitude *= 0.35 * np.ptp(limits, axis=1) / amplitude.sum(0)
    frequency = random.uniform(0.5, 4.0, (tones, n))
    return Reference(
        limits.mean(1), amplitude, frequency, random.uniform(0.0, 6.3, (tones, n))
    )


@kernel
def fill_states(arm, viscous, coulomb, motion, gains, work, states):
    """Follow `motion` (N, 3, n) by PD, torques held for a period.

    Fill states (N, 3, n).

    The rows of `work` (8, n) are zero at first.
    """
    q = work[0]
    dq = work[1]
    torque = work[2]
    # Runge-Kutta
    qs = work[3]
    dqs = work[4]
    ddq = work[5]
    q_step = work[6]
    dq_step = work[7]
    for i in range(q.size):
        q[i], dq[i] = motion[0, 0, i], motion[0, 1, i]
    for k in range(motion.shape[0]):
        for i in range(q.size):
            states[k, 0, i] = q[i]
            states[k, 1, i] = dq[i]
            states[k, 2, i] = torque[i]
            q_error = motion[k, 0, i] - q[i]
            dq_error = motion[k, 1, i] - dq[i]
            torque[i] = gains[i] * (30.0 * q_error + 3.0 * dq_error)
            q_step[i] = dq_step[i] = 0.0
        for share, weight in ((0.0, 1.0), (0.5, 2.0), (0.5, 2.0), (1.0, 1.0)):
            for i in range(q.size):
                qs[i] = q[i] + share * PERIOD * dqs[i]
                dqs[i] = dq[i] + share * PERIOD * ddq[i]
                ddq[i] = (
                    torque[i] - viscous[i] * dqs[i] - coulomb[i] * tanh(dqs[i] / 0.005)
                )
            arm.accelerate(0.0, qs, dqs, ddq, ddq)
            for i in range(q.size):
                q_step[i] += weight * PERIOD / 6.0 * dqs[i]
                dq_step[i] += weight * PERIOD / 6.0 * ddq[i]
        for i in range(q.size):
            q[i] += q_step[i]
            dq[i] += dq_step[i]


def shake(chain, truth, reference, duration):
    """Return states (N, 3, n) of our own plant: position, velocity, previous torque."""
    arm = rigid_arm(rigid_bodies(chain, GRAVITY, truth.inertias, truth.rotors))
    times = np.arange(round(duration / PERIOD)) * PERIOD
    motion = reference.at(times)
    gains = np.array([min(joint.effort, 100.0) for joint in chain.joints]) / 4.0
    n = len(chain.joints)
    states = np.zeros((times.size, 3, n))
    work = np.zeros((8, n))
    fill_states(arm, truth.viscous, truth.coulomb, motion, gains, work, states)
    return states


def shake_elastic(truth, stiffness, reference, duration):
    """Return states (N, 3, n) of a Panda's motors without friction, behind springs [N m/rad]."""
    none = np.zeros(len(PANDA))
    text = corrected_urdf(PANDA_TEXT, PANDA_CHAIN, truth.inertias, none, none, 'true')
    motion = reference.at(np.arange(round(duration / PERIOD)) * PERIOD)
    given = {
        'robot.urdf': text,
        'robot.tip': 'panda_hand_tcp',
        'robot.rotor_inertia': truth.rotors.tolist(),
        'joint.stiffness': stiffness.tolist(),
        'sensor.side': 'motor',
        'disturbance.viscous': none.tolist(),
        'disturbance.coulomb': none.tolist(),
        'initial.position': motion[0, 0].tolist(),
        'initial.velocity': motion[0, 1].tolist(),
    }
    arm = plant_of(build(PlantConfig, given))
    gains = np.array([min(joint.effort, 100.0) for joint in PANDA_CHAIN.joints]) / 4.0
    states, torque = np.zeros_like(motion), none
    for state, (q, dq, _) in zip(states, motion, strict=True):
        position, velocity, _ = arm.measure().reshape(3, -1)
        state[:] = position, velocity, torque
        torque = gains * (30.0 * (q - position) + 3.0 * (dq - velocity))
        arm.step(torque)
    return states


def measured(states, seed, encoder=2.0 * np.pi / 2**20, noise=0.01):
    """Return the states as measured by encoders and torque sensors.

    Noise is of the rms torque.
    """
    random = np.random.default_rng(seed)
    seen = states.copy()
    seen[:, 0] = np.round(states[:, 0] / encoder) * encoder
    torque = states[:, 2]
    seen[:, 2] += (
        noise * np.sqrt(np.mean(torque**2, axis=0)) * random.normal(size=torque.shape)
    )
    return seen


def recording_of(states, joints=PANDA, period=PERIOD):
    """Return states (N, 3, n) as what `identify` reads from a bag."""
    gap = np.zeros(len(states), dtype=bool)
    return Recording(joints, period, states[:, 0], states[:, 2], gap, 'made up')


def is_covered(found, truth):
    """Return whether each base parameter and friction is within its 95 % interval."""
    true = np.concatenate(
        (truth.inertias.ravel(), truth.rotors, truth.viscous, truth.coulomb)
    )
    at, n = slice(0, true.size), len(truth.rotors)
    G = base_matrix(found.parameters, n)[: found.parameters.model.p + 2 * n, at]
    deviation = np.sqrt(np.diag(G @ found.covariance[at, at] @ G.T))
    return np.abs(G @ (found.values[at] - true)) < 1.96 * deviation


FIELDS = ('position', 'velocity', 'effort')


def write_states(
    path, joints, states, *, period=PERIOD, fields=FIELDS, stamps=(), commands=()
):
    """Write states (N, 3, n), and commands (N, n) 1 us after them, as a bag."""
    encoder = JointStateEncoder(joints, fields)
    encoded = Float64MultiArrayEncoder(len(joints))
    stamps = stamps or [
        1_000_000_000 + round(k * period * 1e9) for k in range(len(states))
    ]
    with BagWriter(path, flush_interval=None) as bag:
        handle = bag.add_topic('/joint_states', topics.JOINT_STATE, [])
        other = (
            bag.add_topic('/arm/commands', topics.COMMANDS.type, [])
            if len(commands)
            else 0
        )
        for stamp, state, command in zip_longest(
            stamps, states[: len(stamps)], commands
        ):
            bag.write(
                handle, bytes(encoder.encode(stamp, *state[: len(fields)])), stamp
            )
            if other:
                bag.write(other, bytes(encoded.encode(command)), stamp + 1000)
    return path
