# SPDX-License-Identifier: Apache-2.0
"""The law of a configuration, and how its settings differ from those of `blf_dsc`.

blf_dsc       (28): filtered surface, barrier, composite learning, d^3     `law.blf_dsc`
paper         the same without what `blf_dsc` does otherwise, or some of it
model_based   (16): the same with P^ = P and the disturbance known
backstepping  (35): linear surface, adaptation by the tracking error       `law.backstepping`
slotine_li    the same without position gain, robust term and leakage
FILE.py       a law of a user's own                                        its `LAW`
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from blf_dsc_controller.compiled.layout import filled, size_of
from blf_dsc_controller.configuration import law_file, law_gains
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.factory.inertia import least_inertias
from blf_dsc_controller.law.backstepping import Backstepping
from blf_dsc_controller.law.blf_dsc import BlfDsc
from blf_dsc_controller.law.interface import Law
from blf_dsc_controller.law.prediction import FILTERED
from blf_dsc_controller.law.state import STATE, Settings


def law_of(config: ControllerConfig) -> Law:
    """Return the law of a configuration, with its own gains."""
    if config.law in ('backstepping', 'slotine_li'):
        return Backstepping()
    if law_file.is_file(config.law):
        gains = getattr(config, law_file.GROUP)
        law: Law = law_file.load_law(config.law)(**dataclasses.asdict(gains))
        return law
    return BlfDsc()


def of_law(config: ControllerConfig, settings: Settings) -> Settings:
    """Return the settings with what a law does otherwise than `blf_dsc`."""
    changes = {
        'paper': _of_paper,
        'model_based': _of_model_based,
        'backstepping': _of_backstepping,
        'slotine_li': _of_slotine_li,
    }
    if law_file.is_file(config.law):
        return _of_file(config, settings)
    if config.law not in changes:
        return settings
    return changes[config.law](config, settings)


def _of_paper(config: ControllerConfig, settings: Settings) -> Settings:
    """Return the settings of the law as printed, as far as its gains leave it."""
    gains: law_gains.Paper = getattr(config, law_file.GROUP)
    settings = _chosen(gains, settings)._replace(
        row=_chosen(gains, settings.row),
        adaptation=_chosen(gains, settings.adaptation),
        disturbance=_chosen(gains, settings.disturbance),
        surface=_chosen(gains, settings.surface),
        excitation=_chosen(gains, settings.excitation),
    )
    if settings.row.prediction == FILTERED and gains.change_detection:
        return settings
    # Lambda is a heuristic: its rows contradict each other on any arm.
    return settings._replace(
        excitation=settings.excitation._replace(change_detection=0, starts_full=1)
    )


def _chosen(gains: object, settings: Any) -> Any:
    """Return settings of a part with the gains that are named as its fields."""
    others = settings._asdict().items()
    kept = {name: value for name, value in others if name not in vars(gains)}
    return filled(type(settings), gains, **kept)


def _of_model_based(_config: ControllerConfig, settings: Settings) -> Settings:
    """Return the settings of (16): everything is known, nothing adapts."""
    nothing = np.zeros(settings.n)
    columns = settings.initial_estimate[settings.p :]
    return settings._replace(
        initial_estimate=np.concatenate((settings.truth.parameters, columns)),
        truth=settings.truth._replace(feed_forward=1),
        feedback=settings.feedback._replace(robust_gain=nothing),
        disturbance=settings.disturbance._replace(gain=nothing),
        adaptation=settings.adaptation._replace(adaptation_gain=np.zeros(settings.m)),
    )


def _of_linear_surface(config: ControllerConfig, settings: Settings) -> Settings:
    """Return the settings that laws with a linear surface share; they learn if configured so."""
    gains: law_gains.LinearSurface = getattr(config, law_file.GROUP)
    nothing = np.zeros(settings.n)
    Gamma = settings.adaptation.adaptation_gain.copy()
    if gains.adaptation_gain and config.learning.enabled:
        Gamma[: settings.p] = gains.adaptation_gain
    return settings._replace(
        compensation=STATE,
        surface=settings.surface._replace(gain=np.array(gains.surface_gain)),
        feedback=settings.feedback._replace(
            gain=np.array(gains.feedback_gain or settings.feedback.gain),
            robust_gain=nothing,
            damping_rate=0.0 if gains.feedback_gain else settings.feedback.damping_rate,
        ),
        disturbance=settings.disturbance._replace(gain=nothing, bumpless=0),
        excitation=settings.excitation._replace(change_detection=0),
        adaptation=_chosen(gains, settings.adaptation)._replace(
            weight=gains.learning_weight, adaptation_gain=Gamma
        ),
    )


def _of_backstepping(config: ControllerConfig, settings: Settings) -> Settings:
    """Return the settings of (35)."""
    gains: law_gains.Backstepping = getattr(config, law_file.GROUP)
    linear = _of_linear_surface(config, settings)
    return linear._replace(
        barrier=linear.barrier._replace(weight=np.array(gains.position_gain)),
        robust_gain=np.array(gains.robust_gain),
    )


def _of_slotine_li(config: ControllerConfig, settings: Settings) -> Settings:
    """Return the settings of Slotine and Li's law: (35) without its extra terms."""
    nothing = np.zeros(settings.n)
    gains: law_gains.SlotineLi = getattr(config, law_file.GROUP)
    integral = np.array(gains.integral_gain or nothing)
    linear = _of_linear_surface(config, settings)
    return linear._replace(
        barrier=linear.barrier._replace(weight=nothing),
        disturbance=linear.disturbance._replace(gain=integral),
    )


def _of_file(config: ControllerConfig, settings: Settings) -> Settings:
    """Return the settings of a law of a file: its memory, and the inertias to scale gains by."""
    memory = law_file.memory_of(law_file.load_law(config.law))
    return settings._replace(
        joint_inertia=least_inertias(config),
        memory=size_of(memory)(settings) if memory else 0,
    )
