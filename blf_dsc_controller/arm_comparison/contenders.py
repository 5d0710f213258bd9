# SPDX-License-Identifier: Apache-2.0
"""The laws that are compared, their tuned gains, and the figures of one run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.arm_comparison.baselines import simulate_baseline
from blf_dsc_controller.configuration.arm_defaults import over_postures
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import LoopConfig
from blf_dsc_controller.configuration.robot import parameters_of
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.law.state import sample_of
from blf_dsc_controller.simulation.loop import simulate_law
from blf_dsc_controller.simulation.metrics import torque_error

PICK_UP = 15.0  # s
DURATION = 30.0  # s
INTERVALS = {
    'first 3 s': (0.0, 3.0),
    '8 to 15 s': (8.0, PICK_UP),
    'pick-up': (PICK_UP, 17.0),
    'from 20 s': (20.0, DURATION),
}
_BEFORE = PICK_UP - 0.01  # s, when the model is evaluated for the first time
_STIFFEST = 4.0  # least slope limit of the barrier, as a multiple of its weight


class Gain(NamedTuple):
    """One tuned number: its name, its range, and whether it multiplies each joint's inertia m."""

    name: str
    least: float
    most: float
    inertial: bool = False


class Contender(NamedTuple):
    """A law and its tuned gains; without any, all gains follow from the URDF."""

    label: str
    gains: tuple[Gain, ...] = ()
    law: str = 'blf_dsc'  # or one of BASELINES
    learns: bool = True
    friction: bool = True  # compensates the friction that the controller knows


BASELINES = ('computed_torque', 'pd_gravity')

_DAMPING = Gain('feedback.damping_rate', 10.0, 200.0)
_ADAPTATION = Gain('learning.adaptation_gain', 0.01, 30.0)
_FEEDBACK = (
    _DAMPING,
    Gain('surface.gain', 5.0, 300.0),
    Gain('surface.mu', 2.0, 100.0),
    Gain('barrier.weight', 100.0, 1e4, inertial=True),
    Gain('disturbance.gain', 100.0, 3e4, inertial=True),
)
_SLOTINE_LI = (
    _DAMPING,
    Gain('comparison.surface_gain', 5.0, 300.0),
    Gain('comparison.integral_gain', 100.0, 3e4, inertial=True),
    _ADAPTATION,
)
_PD = (Gain('position', 100.0, 3e4), Gain('velocity', 10.0, 200.0))
_PID = (*_PD, Gain('integral', 100.0, 3e6))

CONTENDERS = {
    'proposed': Contender('proposed, gains from the URDF'),
    'no_learning': Contender('the same without learning', learns=False),
    'slotine_li': Contender('Slotine-Li, the same gains', law='slotine_li'),
    'proposed_tuned': Contender('proposed, tuned', (*_FEEDBACK, _ADAPTATION)),
    'no_learning_tuned': Contender('without learning, tuned', _FEEDBACK, learns=False),
    'slotine_li_tuned': Contender('Slotine-Li with integrator, tuned', _SLOTINE_LI, 'slotine_li'),
    'computed_torque': Contender('computed torque', _PD, BASELINES[0], friction=False),
    'computed_torque_i': Contender('+ integrator', _PID, BASELINES[0], friction=False),
    'computed_torque_if': Contender('+ integrator, friction', _PID, BASELINES[0]),
    'pd_gravity': Contender('PD + gravity', _PD, BASELINES[1], friction=False),
    'pd_gravity_i': Contender('+ integrator', _PID, BASELINES[1], friction=False),
    'pd_gravity_if': Contender('+ integrator, friction', _PID, BASELINES[1]),
}


class Figures(NamedTuple):
    """Figures of one run: largest true error of any joint in each of INTERVALS, torque, model."""

    errors: tuple[float, ...]  # rad
    ratio: float  # largest error of the whole run, relative to the bound
    roughness: float  # rms change of the torque from sample to sample, relative to its limit
    model: tuple[float, ...]  # torque error on another motion: before the pick-up, at the end


def law_changes(
    contender: Contender, config: ControllerConfig, values: Mapping[str, float]
) -> dict[str, object]:
    """Return the parameters that turn the configured law into a contender with these gains."""
    changes: dict[str, object] = {'law': contender.law}
    if contender.law == 'slotine_li':  # the slope of the proposed law's surface at zero
        slope = np.array(config.surface.gain) / 2.0 + config.surface.mu
        changes['comparison.surface_gain'] = slope.tolist()
    elif not contender.learns:
        changes |= {
            'learning.weight': 0.0,
            'learning.adaptation_gain': [0.0] * len(config.learning.initial_estimate),
            'learning.excitation_threshold': 1e9,
            'learning.change_detection': False,
        }
    for gain in contender.gains:
        group, _, field = gain.name.partition('.')
        present, value = getattr(getattr(config, group), field), values[gain.name]
        per_entry = joint_inertia(config) if gain.inertial else np.ones(np.size(present))
        each = value * per_entry
        changes[gain.name] = each.tolist() if isinstance(present, tuple) else value
        if gain.name == 'barrier.weight':
            limit = np.maximum(config.barrier.slope_limit, _STIFFEST * each)
            changes['barrier.slope_limit'] = limit.tolist()
    return changes


def joint_inertia(config: ControllerConfig) -> np.ndarray:
    """Return m (n,) [kg m^2] of the gains: the least inertia of a joint with the others free."""
    robot, limits = config.robot, (config.limits.position_lower, config.limits.position_upper)
    chain, P0 = robot.chain(config.joints), config.learning.initial_estimate
    return over_postures(chain, parameters_of(robot, chain), robot.payload, P0, *limits)[0]


def run(name: str, loop: LoopConfig, values: Mapping[str, float], unseen: np.ndarray) -> Figures:
    """Run a contender with `values` of its gains by name.

    `unseen` (k, p) are the rows of H on which the learned model is evaluated.
    """
    contender = CONTENDERS[name]
    with np.errstate(all='ignore'):  # a run that diverges has figures too
        if contender.law in BASELINES:
            errors, torques = simulate_baseline(
                loop,
                joint_inertia(loop.controller),
                dict(values),
                computed=contender.law == BASELINES[0],
                friction=contender.friction,
            )
            model: tuple[float, ...] = ()
        else:
            errors, torques, model = _simulate_law(contender, loop, values, unseen)
        time = np.arange(len(errors)) * loop.plant.sample_time
        peaks = [
            np.abs(errors[(time >= begin) & (time < end)]).max(initial=0.0)
            for begin, end in INTERVALS.values()
        ]
        change = np.diff(torques, axis=0) / loop.controller.torque.limit
        rough = np.sqrt(np.mean(change**2, axis=0)).max()
    ratio = np.abs(errors / loop.controller.barrier.bound).max()
    return Figures(tuple(map(float, peaks)), float(ratio), float(rough), model)


def _simulate_law(
    contender: Contender, loop: LoopConfig, values: Mapping[str, float], unseen: np.ndarray
) -> tuple[np.ndarray, np.ndarray, tuple[float, ...]]:
    config = change(loop.controller, law_changes(contender, loop.controller, values))
    record = simulate_law(config, loop.plant)
    settings = record.controller.settings
    n, p = settings.n, settings.p
    columns = sample_of(np.arange(record.samples.shape[1]), settings)
    errors = record.truths[:, p + n : p + 2 * n] - record.samples[:, columns.qr]
    rows = [round(_BEFORE / config.sample_time), -1]
    estimates = record.samples[rows][:, columns.estimate[:p]]
    model = tuple(
        torque_error(unseen, estimate, P)
        for estimate, P in zip(estimates, record.truths[rows, :p], strict=True)
    )
    return errors, record.samples[:, columns.torque], model
