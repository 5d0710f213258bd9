# SPDX-License-Identifier: Apache-2.0
"""From a configuration to what runs: the model, the packed settings, the controller."""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.core import barrier, models
from blf_dsc_controller.core.controller import Controller
from blf_dsc_controller.core.reference import sinusoids_vector
from blf_dsc_controller.core.settings import LAWS, TORQUE_SOURCES, UPDATES, Settings, pack

COLUMN_GAIN = 1.0  # Gamma of the disturbance columns [1/s per kappa]


def model_of(config: ControllerConfig) -> models.Model:
    """Model named by `model`, with the geometry that the controller is told."""
    return models.two_link_arm(config.arm.l1, config.arm.gravity)


def estimate_names(config: ControllerConfig) -> tuple[str, ...]:
    """Name of each entry of theta^: the model's parameters, then the disturbance columns."""
    columns = tuple(f'bias {joint}' for joint in config.joints) if config.learning.bias else ()
    return model_of(config).parameter_names + columns


def settings_of_config(config: ControllerConfig) -> Settings:
    """Translate the configuration's words into the paper's symbols."""
    model = model_of(config)
    learning = config.learning
    columns = len(estimate_names(config)) - model.p
    per_joint = zip(
        config.barrier.bound, config.barrier.weight, config.barrier.slope_limit, strict=True
    )
    return Settings(
        n=model.n,
        p=model.p,
        m=model.p + columns,
        model=model.code,
        law=LAWS.index(config.law),
        update=UPDATES.index(learning.update),
        torque_source=TORQUE_SOURCES.index(learning.torque_source),
        window=round(learning.window / config.sample_time),
        interval=learning.interval,
        time_constant=config.surface.time_constant,
        boundary_layer=config.feedback.boundary_layer,
        eta=config.disturbance.leakage,
        kappa=learning.weight,
        rho=learning.regularization,
        sigma=learning.excitation_threshold,
        learning_start=learning.window + learning.settling_time,
        pole=learning.filter_pole,
        radius=learning.radius,
        bound=np.array(config.barrier.bound),
        weight=np.array(config.barrier.weight),
        slope_limit=np.array(config.barrier.slope_limit),
        knee=np.array([barrier.knee(*joint) for joint in per_joint]),
        K=np.array(config.surface.gain),
        mu=np.array(config.surface.mu),
        Kp=np.array(config.feedback.gain),
        d2=np.array(config.feedback.damping),
        gamma=np.array(config.disturbance.gain),
        torque_limit=np.array(config.torque.limit),
        Gamma=np.array(learning.adaptation_gain + (COLUMN_GAIN,) * columns),
        initial_estimate=np.array(learning.initial_estimate + (0.0,) * columns),
        constants=np.array(model.constants),
    )


def controller_of(config: ControllerConfig) -> Controller:
    """Controller of a configuration, compiled and at rest."""
    reference = config.reference
    return Controller(
        pack(settings_of_config(config)),
        sinusoids_vector(
            reference.offset, reference.amplitude, reference.frequency, reference.phase
        ),
    )
