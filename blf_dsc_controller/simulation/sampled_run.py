# SPDX-License-Identifier: Apache-2.0
"""A `Run` of the samples of a simulated loop."""

from __future__ import annotations

from itertools import chain

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import flatten
from blf_dsc_controller.configuration.tool_bound import tool_of
from blf_dsc_controller.factory.estimate import estimate_names, learned_arm
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.samples import sample_columns
from blf_dsc_controller.messages.named_values import external_names, monitored
from blf_dsc_controller.run import Floats, Run, Series, Stamps


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
    position, velocity, effort = np.split(measurements, 3, axis=1)
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
        learns=config.traits.learns and config.learning.enabled,
        effort=effort,
        sliding=config.robot.sliding(config.joints),
        xi2=samples.xi2,
        parameters=flatten(config),
    )
