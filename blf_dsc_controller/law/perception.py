# SPDX-License-Identifier: Apache-2.0
"""What a controller finds after it has sent a torque: the load in the tip, and contacts.

Nothing here acts on the torque of its sample, but a contact can stop the learning.
"""

from __future__ import annotations

from math import sqrt

from blf_dsc_controller.arms.model import ArmModel
from blf_dsc_controller.compiled.jit import inner, kernel
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.law import (
    contact,
    external_torque,
    payload,
    prediction,
    window,
)
from blf_dsc_controller.law.contact import Residual, TipLoad
from blf_dsc_controller.law.innovation import Prior
from blf_dsc_controller.law.state import (
    Sample,
    Settings,
    Signals,
    State,
    sample_of,
    settings_of,
    signals_of,
    state_of,
)
from blf_dsc_controller.numerics.intervals import TWO_SIDED

CONTACT, DISTANCE = 0, 1  # in `sample.contact`


@inner
def update_covariance(settings: Settings, state: State) -> None:
    """Pass the covariance of theta to `external_torque`: of the prior, then of each full window."""
    if state.external.variance[0] == 0.0:
        external_torque.begin(settings.external, state.external, settings.information)
        return
    if state.change.changes[0] != state.external.tare_changes[0]:
        external_torque.forget_tare(state.external)
    latch = state.latch
    is_full = window.is_full(settings.window, state.window) and latch.latched[0] == 1.0
    if is_full and latch.latch_time[0] != state.external.latch_time[0]:
        excess = max(1.0, latch.residual[0] / settings.excitation.residual_floor)
        external_torque.update_covariance(
            state.external,
            latch.factor,
            settings.external.row_variance * excess,
            latch.latch_time[0],
        )


@inner
def fill_coulomb(settings: Settings, state: State, coulomb: Array) -> None:
    """Write the Coulomb friction of each joint, learned or assumed, to `coulomb` (n,) [N m]."""
    friction_settings = settings.friction
    for i in range(coulomb.size):
        coulomb[i] = friction_settings.reversals.initial[i]
        if friction_settings.coulomb == 1:
            coulomb[i] = state.estimate[friction_settings.first_coulomb + i]


@inner
def update_external_torque(
    settings: Settings, state: State, signals: Signals, dt: float
) -> float:
    """Compute r of the last sample, `dt` [s]; return its distance from what explains it.

    Detects whether r is a contact, once theta^ has settled.
    """
    observer_settings, observer, workspace = (
        settings.external,
        state.external,
        signals.scratch.external,
    )
    update_covariance(settings, state)
    fill_coulomb(settings, state, workspace.coulomb)
    external_torque.update_torque(observer, state.estimate)
    begins = external_torque.follow_reversals(
        observer_settings, observer, signals.dqr, dt
    )
    samples = int(state.samples[0])
    interval = settings.window.row_interval
    if begins or samples <= 1 or samples % interval == interval // 4:
        external_torque.update_spread(
            observer_settings, observer, workspace, state.estimate
        )
    distance = external_torque.whiten_torque(observer, workspace)
    if external_torque.is_settled(observer, dt):
        distance = update_contact(settings, state, signals, distance, dt)
    touched = contact.is_touched(state.contact)
    external_torque.update_noise(observer_settings, observer, workspace, touched)
    return distance


@inner
def update_contact(
    settings: Settings, state: State, signals: Signals, distance: float, dt: float
) -> float:
    """Detect whether r is a contact; return its unexplained distance.

    `distance` is that of r from zero, `dt` [s] the length of the sample.
    """
    tip = settings.payload
    mass, deviation = payload.held_mass(state.payload)
    load = TipLoad(tip.columns, tip.scale, mass, deviation)
    external, white = state.external, signals.scratch.external.white
    residual = Residual(external.filtered, external.spread, white, distance)
    return contact.update(
        settings.contact, state.contact, signals.scratch.contact, residual, load, dt
    )


@inner
def fill_sample(
    settings: Settings,
    state: State,
    signals: Signals,
    distance: float,
    sample: Sample,
) -> None:
    """Write r (n,) [N m] with its 95 % interval, and the contact, to the telemetry sample."""
    observer, workspace = state.external, signals.scratch.external
    for i in range(observer.torque.size):
        sample.external[i] = observer.torque[i]
        deviation = sqrt(
            external_torque.residual_variance(settings.external, observer, workspace, i)
        )
        sample.external_interval[i] = TWO_SIDED * deviation
    sample.contact[CONTACT] = 1.0 if contact.is_touched(state.contact) else 0.0
    sample.contact[DISTANCE] = distance


@kernel
def sense(
    model: ArmModel,
    settings_vector: Array,
    state_vector: Array,
    signals_vector: Array,
    sample_vector: Array,
    dt: float,
) -> bool:
    """Compute the external torque of the last sample, `dt` [s]; return whether a contact begins.

    While it lasts, and until the filters have settled, nothing is learned.
    """
    settings = settings_of(settings_vector, model)
    state = state_of(state_vector, settings)
    signals = signals_of(signals_vector, settings)
    was_touched = contact.is_touched(state.contact)
    distance = update_external_torque(settings, state, signals, dt)
    is_touched = contact.is_touched(state.contact)
    if is_touched and settings.contact.freezes == 1:
        state.frozen[0] = prediction.SETTLED / settings.row.filter_pole
    fill_sample(settings, state, signals, distance, sample_of(sample_vector, settings))
    return is_touched and not was_touched


@kernel
def estimate_payload(
    model: ArmModel,
    settings_vector: Array,
    state_vector: Array,
    signals_vector: Array,
    dt: float,
) -> None:
    """Estimate the load in the tip by the row of the last sample, `dt` [s] long.

    Rows of a contact are left out.
    """
    settings = settings_of(settings_vector, model)
    state = state_of(state_vector, settings)
    signals = signals_of(signals_vector, settings)
    if state.frozen[0] > 0.0:  # the row is of a contact
        return
    shapes = signals.scratch.payload.shapes
    for i in range(settings.n):
        weight = prediction.motion_weight(settings.row, signals.dqr[i], i)
        shapes[i] = weight * state.friction.shape_lags[1, 2, i]
    payload.add_row(
        settings.payload,
        state.payload,
        signals.scratch.payload,
        Prior(settings.initial_estimate, settings.row_information),
        payload.Sample(
            signals.row.Xu,
            shapes,
            state.friction.shape_lags[0, 2],
            signals.dqr,
            int(state.samples[0]),
            state.change.changes[0],
            dt,
        ),
    )
