# SPDX-License-Identifier: Apache-2.0
"""Random serial arms as URDFs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio

from blf_dsc_controller.arms.urdf import read_chain

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


def link(name, random):
    """Return a link with the inertia of a random cloud of points, which is always physical."""
    if random is None:
        return f'<link name="{name}" />'
    points = random.normal(size=(5, 3)) * random.uniform(0.02, 0.2, 3)
    mass = random.uniform(0.2, 4.0)
    second = (points - points.mean(0)).T @ (points - points.mean(0)) * mass / 5.0
    I = np.trace(second) * np.eye(3) - second
    entries = zip(('ixx', 'ixy', 'ixz', 'iyy', 'iyz', 'izz'), I[np.triu_indices(3)], strict=True)
    return (
        f'<link name="{name}"><inertial>'
        f'<origin xyz="{words(points.mean(0))}" rpy="{words(random.uniform(-3, 3, 3))}" />'
        f'<mass value="{mass!r}" />'
        f'<inertia {" ".join(f"""{key}="{float(value)!r}" """ for key, value in entries)} />'
        '</inertial></link>'
    )


def joint(name, kind, parent, child, random):
    xyz, rpy = words(random.uniform(-0.4, 0.4, 3)), words(random.uniform(-3.0, 3.0, 3))
    return (
        f'<joint name="{name}" type="{kind}"><origin xyz="{xyz}" rpy="{rpy}" />'
        f'<parent link="{parent}" /><child link="{child}" />'
        f'<axis xyz="{words(random.normal(size=3))}" />'
        '<limit lower="-1.5" upper="2.5" velocity="2.0" effort="30.0" /></joint>'
    )


def random_urdf(n, seed):
    """Return the URDF of a chain from `base` to `tip`, and its joints j1 .. jn of all kinds.

    Each joint is followed by a fixed joint, and links with mass branch off.
    """
    random = np.random.default_rng(seed)
    text, at = [link('base', random)], 'base'
    for i in range(1, n + 1):
        kind = random.choice(('revolute', 'continuous', 'prismatic'), p=(0.5, 0.2, 0.3))
        text += [link(f'l{i}', random), joint(f'j{i}', kind, at, f'l{i}', random)]
        text += [link(f'aside{i}', random), joint(f'a{i}', 'fixed', f'l{i}', f'aside{i}', random)]
        text += [link(f'flange{i}', None), joint(f'f{i}', 'fixed', f'l{i}', f'flange{i}', random)]
        at = f'flange{i}'
    text += [link('tip', None), joint('tip_joint', 'fixed', at, 'tip', random)]
    text += [link('tool', random), joint('tool_joint', 'fixed', 'tip', 'tool', random)]
    random.shuffle(text)
    return f'<robot name="arm">{"".join(text)}</robot>', tuple(f'j{i}' for i in range(1, n + 1))


def pinocchio_model(text, joints):
    """Return the arm with these joints; all others are fixed at 0."""
    model = pinocchio.buildModelFromXML(text)
    others = [model.getJointId(name) for name in model.names[1:] if name not in joints]
    return pinocchio.buildReducedModel(model, others, pinocchio.neutral(model))


def configuration(model, q):
    """Return pinocchio's configuration, with cosine and sine of continuous joints."""
    return pinocchio.integrate(model, pinocchio.neutral(model), q)


PANDA_TEXT, UR5E_TEXT = ((CONFIG / f'{name}.urdf').read_text() for name in ('panda', 'ur5e'))
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
