# SPDX-License-Identifier: Apache-2.0
"""Telemetry of each sample: messages as (topic, bytes), and the columns of a `Run`.

The nodes publish the messages; the offline loop writes them into a bag. Vectors of
named values are sent as JointState with the values in `position`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import chain
from operator import attrgetter
from typing import TypeAlias

import numpy as np

from blf_dsc_controller.arms.model import regressors_at
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.law_traits import traits_of
from blf_dsc_controller.configuration.tool_bound import tool_of
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.factory import (
    columns_of,
    estimate_names,
    model_of,
    prior_covariance,
)
from blf_dsc_controller.law.state import Sample, Settings, sample_of
from blf_dsc_controller.law.tip_wrench import TipWrench
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import (
    Float64MultiArrayEncoder,
    JointStateEncoder,
    WrenchEncoder,
    encode_clock,
)
from blf_dsc_controller.run import Floats, LearnedArm, Run, Series, Stamps

Message: TypeAlias = tuple[topics.Topic, bytes]

DECIMATION = 10
"""Number of samples from one message of the plant's truth to the next."""


def monitored(
    config: ControllerConfig, estimates: Sequence[str]
) -> dict[str, Sequence[str]]:
    """Return the parts of a `Sample` that `~/monitor` has, each with the names of its values.

    `estimates` are those of theta^, as returned by `factory.estimate_names`.
    """
    names: dict[str, Sequence[str]] = {
        'estimate': estimates,
        'disturbance': disturbance_names(config.joints),
        'lambda_min': (topics.LAMBDA_MIN,),
        'latched': (topics.LATCHED,),
        'changes': (topics.MODEL_CHANGES,),
    }
    if config.learning.weighing:
        names['load'] = topics.LOAD
    if config.contact.enabled:
        names['contact'] = topics.CONTACT
    if config.truth.parameters:
        names['lyapunov'] = topics.LYAPUNOV_TERMS
    return names


def disturbance_names(joints: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the disturbance torques, estimated or true."""
    return tuple(topics.DISTURBANCE + joint for joint in joints)


def external_names(joints: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the torques from outside, and of half of their 95 % intervals."""
    return *joints, *(joint + topics.INTERVAL for joint in joints)


class ControllerTelemetry:
    """Messages of the controller of n joints; `estimates` are the names of theta^ (m,).

    Reference and monitor are sent with every `telemetry.decimation`-th sample, from the
    first one on, and so is the bound while it narrows; one that widens is sent at once.
    """

    def __init__(self, config: ControllerConfig, estimates: Sequence[str]) -> None:
        joints = config.joints
        parts = monitored(config, estimates)
        names = [
            what + joint for what in (topics.RATIO, topics.DISTANCE) for joint in joints
        ]
        self._tool = tool_of(config)
        of_tool = topics.TOOL if self._tool else ()
        names += [*chain.from_iterable(parts.values()), *of_tool, topics.COMPUTE_TIME]
        self._command = Float64MultiArrayEncoder(len(joints))
        self._reference = JointStateEncoder(joints, ('position', 'velocity'))
        self._error = JointStateEncoder(joints)
        self._bound = JointStateEncoder(joints, ('position', 'effort'))
        self._monitor = JointStateEncoder(names, ('position',))
        self._external = None
        if config.contact.enabled:
            self._external = ExternalTelemetry(config)
        self._parts = attrgetter(*parts)
        self._decimation = config.telemetry.decimation
        self.restart()

    def restart(self) -> None:
        """Send everything with the next sample, as with the first one."""
        self._samples, self._slowest = 0, 0.0
        self._sent = np.empty(0)  # bound

    def command(self, torque: np.ndarray) -> Message:
        """Encode the commanded torque (n,) [N m]."""
        return topics.COMMANDS, self._command.encode(torque)

    def bound(self, stamp: int, bound: np.ndarray, torque_limit: np.ndarray) -> Message:
        """Encode the bound k_c (n,) [rad] on the tracking error and the torque limit (n,) [N m]."""
        self._sent = np.array(bound)
        return topics.BOUND, self._bound.encode(
            stamp, position=bound, effort=torque_limit
        )

    def answer(self, stamp: int, torque: np.ndarray) -> Message:
        """Encode a torque (n,) [N m] that is not the law's; the tracking errors are NaN.

        `stamp` [ns] is that of the joint state, or of the last readable one.
        """
        unknown = np.full(torque.size, np.nan)
        return topics.TRACKING_ERROR, self._error.encode(
            stamp, unknown, unknown, torque
        )

    def sample(
        self,
        stamp: int,
        sample: Sample,
        torque_limit: np.ndarray,
        ratio: np.ndarray,
        compute_time: float,
        *,
        subscribed: bool = True,
    ) -> Iterator[Message]:
        """Yield the messages for a joint state: its stamp [ns] and telemetry sample.

        `ratio` is the largest |xi1| / k_c so far (n,). Of the times of updates,
        `compute_time` [s], the largest since the last message is sent. The tracking
        errors come with every sample, if they are `subscribed`: they tell a replay
        which states were used.
        """
        is_due = self._samples % self._decimation == 0
        self._samples += 1
        self._slowest = max(compute_time, self._slowest)  # NaN: not measured
        bound = sample.bound
        if bound.tobytes() != self._sent.tobytes() and (
            is_due or (bound > self._sent).any()
        ):
            yield self.bound(stamp, bound, torque_limit)
        if subscribed:
            error = self._error.encode(stamp, sample.xi1, sample.xi2, sample.torque)
            yield topics.TRACKING_ERROR, error
        if is_due:
            yield topics.REFERENCE, self._reference.encode(stamp, sample.qr, sample.dqr)
            distance = bound - np.abs(sample.xi1)
            of_tool = np.empty(0)
            if self._tool is not None:
                of_tool = self._tool.errors(sample.qr, sample.xi1, bound)
            values = np.concatenate(
                (ratio, distance, *self._parts(sample), of_tool, (self._slowest,))
            )
            yield topics.MONITOR, self._monitor.encode(stamp, values)
            self._slowest = 0.0
            if self._external is not None:
                yield from self._external.sample(stamp, sample)


class ExternalTelemetry:
    """Messages of the torque from outside; of the wrench where `robot.tip` says at which link."""

    def __init__(self, config: ControllerConfig) -> None:
        joints = config.joints
        self._torque = JointStateEncoder(external_names(joints), ('effort',))
        self._wrench = None
        if config.model == 'urdf' and config.robot.tip:
            self._wrench = WrenchEncoder(config.robot.tip)
            self._tip = TipWrench(config.robot.chain(joints))

    def sample(self, stamp: int, sample: Sample) -> Iterator[Message]:
        """Yield the messages of a telemetry sample with its stamp [ns]."""
        torque = sample.external
        interval = sample.external_interval
        yield (
            topics.EXTERNAL_TORQUE,
            self._torque.encode(stamp, effort=np.concatenate((torque, interval))),
        )
        if self._wrench is not None:
            wrench = self._tip.of(sample.qr + sample.xi1, torque, interval)
            yield topics.EXTERNAL_WRENCH, self._wrench.encode(stamp, wrench)


class PlantTelemetry:
    """Messages of the plant of n joints and p true parameters.

    Joint states have the names `published`, by default the joints; other joints stay at
    0.
    """

    def __init__(
        self,
        joints: Sequence[str],
        parameters: Sequence[str],
        published: Sequence[str] = (),
    ) -> None:
        names = tuple(published) or tuple(joints)
        true_state = [
            what + joint
            for what in (topics.POSITION, topics.VELOCITY)
            for joint in joints
        ]
        self._joint_states = JointStateEncoder(names)
        self._places = [names.index(joint) for joint in joints]
        self._published = np.zeros((3, len(names)))
        self._truth = JointStateEncoder(
            (*parameters, *disturbance_names(joints), *true_state), ('position',)
        )
        self._timing = JointStateEncoder(
            (topics.LATENCY, topics.LATENESS, topics.LATE_STEPS), ('position',)
        )

    def joint_states(self, stamp: int, measurement: np.ndarray) -> Message:
        """Encode measured [q, dq, applied torque of the last interval] (3 n,)."""
        self._published[:, self._places] = measurement.reshape(3, -1)
        return topics.JOINT_STATES, self._joint_states.encode(stamp, *self._published)

    def truth(self, stamp: int, truth: np.ndarray) -> Message:
        """Encode the true [P, tau_dist, q, dq] (p + 3 n,)."""
        return topics.TRUTH, self._truth.encode(stamp, truth)

    def timing(
        self, stamp: int, latency: float, lateness: float, late_steps: int
    ) -> Message:
        """Encode the real-time performance of the step up to this sample [s, s, count]."""
        return topics.TIMING, self._timing.encode(
            stamp, (latency, lateness, late_steps)
        )

    def clock(self, stamp: int) -> Message:
        """Encode the plant's time [ns] for /clock."""
        return topics.CLOCK, encode_clock(stamp)


def load_text(load: Sequence[float]) -> str:
    """Return what the tip holds as text, from the values (8,) of LOAD."""
    mass, *centre = load[:4]
    interval, *spread = load[4:]
    if not math.isfinite(mass):
        return 'unknown'
    text = f'{mass:.3f} +- {interval:.2g} kg'
    if mass < -interval:
        return f'{text}: lighter than at the start, so something was held then'
    if not math.isfinite(centre[0]):
        return text
    each = (
        f'{1e3 * c:.1f} +- {1e3 * s:.2g}' for c, s in zip(centre, spread, strict=True)
    )
    return f'{text}, its centre at {", ".join(each)} mm'


def sample_columns(rows: Floats, settings: Settings) -> Sample:
    """Split packed samples (N, s) into columns by name, located by unpacking a row of indices."""
    places = sample_of(np.arange(rows.shape[1], dtype=np.float64), settings)
    return Sample(*(rows[:, part.astype(np.intp)] for part in places))


def learned_arm(config: ControllerConfig) -> LearnedArm | None:
    """Return units, prior and regressor of what is learned of a URDF; None for other models."""
    if config.model != 'urdf':
        return None
    model = model_of(config)
    names = estimate_names(config)
    friction = (column.unit for column in columns_of(config))
    deviations = np.sqrt(np.diag(prior_covariance(config))).tolist()
    return LearnedArm(
        dict(zip(names, (*model.parameter_units, *friction), strict=True)),
        dict(zip(names, deviations, strict=True)),
        partial(regressors_at, model),
    )


def run_of(
    config: ControllerConfig,
    controller: Controller,
    stamps: Stamps,
    measurements: Floats,
    rows: Floats,
) -> Run:
    """Build a run from stamps (N,) [ns], measurements (N, 3 n) and samples (N, s).

    Rows of states that the law did not use are NaN except for bound and torque.
    """
    samples = sample_columns(rows, controller.settings)
    used = ~np.isnan(samples.qr[:, 0])
    position, velocity, _ = np.split(measurements, 3, axis=1)
    tool = tool_of(config)
    external = None
    if config.contact.enabled:
        values = np.hstack((samples.external[used], samples.external_interval[used]))
        external = Series(external_names(config.joints), stamps[used], values)
    parts = monitored(config, estimate_names(config))
    monitor = np.hstack([getattr(samples, part)[used] for part in parts])
    return Run(
        joints=config.joints,
        stamp=stamps,
        received=stamps,
        position=position,
        velocity=velocity,
        torque=samples.torque,
        reference=samples.qr,
        error=samples.xi1,
        bound=samples.bound,
        torque_limit=np.broadcast_to(config.torque.limit, position.shape),
        monitor=Series(
            tuple(chain.from_iterable(parts.values())), stamps[used], monitor
        ),
        external=external,
        arm=learned_arm(config),
        tool=tool.errors if tool else None,
        learns=traits_of(config).learns and config.learning.weight > 0.0,
        sliding=config.robot.sliding(config.joints),
    )


_NOTABLE = 0.1  # relative to the largest component


def rejected_columns(controller: Controller, names: Sequence[str]) -> dict[str, str]:
    """Return why a controller that learns does not estimate columns, by their names.

    Each resembles a combination of others in the current window; these are named,
    largest first.  `names` are those of the m entries of theta^, as returned by
    `factory.estimate_names`.
    """
    state, reasons = controller.state, {}
    upper = np.triu(state.window.running[:-1, :-1])
    Phi = upper + np.triu(upper, 1).T
    kept = np.flatnonzero(state.latch.active > 0.0)
    for column in np.flatnonzero(state.latch.active == 0.0).tolist():
        products = Phi[kept, column]
        parts = np.linalg.lstsq(Phi[np.ix_(kept, kept)], products, rcond=None)[0]
        strength = np.abs(parts) * np.sqrt(np.diag(Phi)[kept])
        order = kept[np.argsort(-strength)].tolist()
        alike = [
            names[k] for k in order[: np.sum(strength >= _NOTABLE * strength.max())]
        ]
        explained = float(np.clip(parts @ products / Phi[column, column], 0.0, 1.0))
        reasons[names[column]] = (
            f'{names[column]} is not estimated: this window cannot distinguish it from '
            f'{" + ".join(alike)} ({100 * explained:.4g} % of it is explained by them). '
            'A reference with more tones can separate them; learning.excitation_threshold sets '
            'how clearly'
        )
    return reasons
