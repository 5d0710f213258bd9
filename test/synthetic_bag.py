# SPDX-License-Identifier: Apache-2.0
"""Bags of a made-up run in which every number is known in advance."""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.bags.writer import BagWriter
from blf_dsc_controller.messages.codecs import Float64MultiArrayEncoder, JointStateEncoder
from blf_dsc_controller.messages.topics import (
    BOUND,
    COMMANDS,
    JOINT_STATES,
    MONITOR,
    REFERENCE,
    TIMING,
    TRACKING_ERROR,
    TRUTH,
)

START = 1_000_000_000  # ns
MILLISECOND = 1_000_000  # ns
JOINTS = ('shoulder', 'elbow')
PARAMETERS = ('(m1+m2)*l1^2', 'm2*l2^2', 'm2*l1*l2')
TRUE = np.array([1.0, 0.32, 0.4])
BOUND_RAD = 0.002
LIMIT_NM = 20.0
LATCH_S = 1.5
TIME_CONSTANT_S = 1.0  # of the parameter error from the latch on


def relative_error(time):
    """Return the parameter error relative to the norm of the true parameters."""
    return 0.5 * np.exp(-np.maximum(time - LATCH_S, 0.0) / TIME_CONSTANT_S)


class Synthetic:
    """Signals of the run, as arrays over its samples (n = 2 joints)."""

    def __init__(self, samples):
        self.stamp = START + MILLISECOND * np.arange(samples)
        self.time = 1e-3 * np.arange(samples)
        wave = np.array([np.sin(2 * np.pi * self.time), np.cos(2 * np.pi * self.time)]).T
        self.reference = 1.5 + 0.3 * wave
        self.error = wave * [0.0008, -0.0005]
        self.position = self.reference + self.error
        self.torque = wave * [8.0, 3.0]
        self.estimate = TRUE * (1.0 - relative_error(self.time))[:, np.newaxis]
        self.latched = (self.time >= LATCH_S).astype(float)
        self.disturbance = 0.1 + 0.1 * wave

    def messages(self, *, with_timing=False):
        """Yield every message as (topic, stamp, bytes)."""
        columns = (*PARAMETERS, *(f'disturbance {joint}' for joint in JOINTS))
        states = JointStateEncoder(JOINTS[::-1])  # in a different joint order than elsewhere
        commands = Float64MultiArrayEncoder(2)
        reference = JointStateEncoder(JOINTS, ('position', 'velocity'))
        tracking = JointStateEncoder(JOINTS)
        learning = JointStateEncoder(
            (*columns, 'bias elbow', 'lambda_min', 'latched', 'compute_time'), ('position',)
        )
        truth = JointStateEncoder((*columns, 'position elbow'), ('position',))
        timing = JointStateEncoder(('latency', 'lateness', 'late_steps'), ('position',))
        zero = np.zeros(2)
        bound = JointStateEncoder(JOINTS, ('position', 'effort'))
        yield BOUND, START, bound.encode(START, [BOUND_RAD] * 2, (), [LIMIT_NM] * 2)
        for k, stamp in enumerate(self.stamp.tolist()):
            yield JOINT_STATES, stamp, states.encode(stamp, self.position[k, ::-1], zero, zero)
            yield COMMANDS, stamp, commands.encode(self.torque[k])
            yield REFERENCE, stamp, reference.encode(stamp, self.reference[k], zero)
            yield TRACKING_ERROR, stamp, tracking.encode(stamp, self.error[k], zero, self.torque[k])
            vector = [*self.estimate[k], *(0.9 * self.disturbance[k]), 0.1, 0.004]
            yield MONITOR, stamp, learning.encode(stamp, [*vector, self.latched[k], 1e-9 * k])
            if k % 10 == 0:
                yield TRUTH, stamp, truth.encode(stamp, [*TRUE, *self.disturbance[k], 1.0])
            if with_timing:
                yield TIMING, stamp, timing.encode(stamp, [1e-6 * k, 0.0, k // 100])


def write(path, messages, rename=lambda topic: topic.resolved, **options):
    """Write messages into a bag, with their stamps as times of receipt."""
    handles = {}
    with BagWriter(path, flush_interval=None, **options) as bag:
        for topic, stamp, raw in messages:
            if topic not in handles:
                handles[topic] = bag.add_topic(rename(topic), topic.type, [topic.offered])
            bag.write(handles[topic], raw, stamp)
    return path
