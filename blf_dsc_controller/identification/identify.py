# SPDX-License-Identifier: Apache-2.0
"""Inertias, rotors and friction identified from a recording, with the URDF as the prior.

In four steps: the efforts are checked; the model is selected by cross-validation within
the first four fifths of the motion; its values are fitted to these, and scored on the
rest; then they are fitted to all of the motion.  If this leaves much of the torques, or
of that of one joint, other zeros and directions of the joints are tried.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.configuration.robot import Robot
from blf_dsc_controller.identification.conventions import (
    Convention,
    converted,
    likely_conventions,
    simpler,
)
from blf_dsc_controller.identification.identified import Identified, Score
from blf_dsc_controller.identification.joint_alone import errors_alone, fit_alone
from blf_dsc_controller.identification.plausibility import outside_range, shares
from blf_dsc_controller.identification.problem import Effort, Problem, problem_of
from blf_dsc_controller.identification.problems import (
    convention_problem,
    is_usable,
    load_problem,
    mounting_problem,
    unexplained_joints,
)
from blf_dsc_controller.identification.recording import Recording
from blf_dsc_controller.identification.regression import Fit, fitted
from blf_dsc_controller.identification.ripple import ripples_of
from blf_dsc_controller.identification.scoring import nearest_friction, scored
from blf_dsc_controller.identification.selection import Selected, select
from blf_dsc_controller.identification.stiffness import compliance_of
from blf_dsc_controller.identification.wider_model import doubt
from blf_dsc_controller.identification.windows import COLUMNS, HOP, STILL

STAGES = READING, CHECKING, SELECTING, FITTING, INTERVALS, OTHERS = (
    'reading',
    'checking efforts',
    'selecting terms',
    'fitting',
    'intervals',
    'trying other loads, zeros and directions',
)
"""What takes time, in this order."""

_GOOD = 2.0  # % of the torque, error with which nothing else is looked for
_BETTER = 0.5  # times the error, at most, with joints or loads that are not as given
_SHOWN = 2.0  # deviations of its mass, least mass of such a load
_AS_GOOD = 1.1  # times that error, at most, without what is not needed


def tell_nobody(_stage: str) -> None:
    """Take no note of the stage that begins."""


def identify_arm(
    recording: Recording,
    robot: Robot,
    effort: Effort = 'torque',
    picked_up: float | None = None,
    *,
    find_signs: bool = True,
    begin: Callable[[str], None] = tell_nobody,
) -> Identified:
    """Identify the arm of a recording, and the load picked up at that time [s]; NaN: find it.

    One that is found may be put down again, or be carried at the start only.

    Raises:
        BlfDscError: the recording is too short or has no motion.
    """
    trained = partial(
        _trained,
        recording=recording,
        robot=robot,
        effort=effort,
        picked_up=picked_up,
        find_signs=find_signs,
    )
    first = trained(begin=begin)
    found = _completed(first, begin)
    begin(OTHERS)
    explained = found.score
    gravity = first.problem.other_gravity
    if gravity is not None:
        mounted = trained(robot=replace(robot, gravity=tuple(gravity.tolist())))
        if _left(mounted.score) < _BETTER * _left(explained):
            found = found._replace(
                other=mounting_problem(gravity),
                reversed=_named(recording.joints, mounted.problem.reversed),
            )
            explained = mounted.score
    is_good = explained.total[2] < _GOOD
    unexplained = unexplained_joints(found)
    if is_good and (found.other or not unexplained.size):
        return found
    if picked_up is None and not is_good:
        load = _better_load(found.score, trained(picked_up=np.nan))
        if load:
            return found._replace(other=load)
    if effort == 'without-gravity':
        return found
    better = _better_convention(
        explained,
        likely_conventions(first.problem, robot.gravity, unexplained.tolist()),
        lambda convention: trained(recording=converted(recording, convention)),
    )
    if better is None:
        return found
    return found._replace(other=convention_problem(found.joints, found.score, *better))


class _Trained(NamedTuple):
    """An arm fitted to the first four fifths of a recording, and scored on the rest."""

    problem: Problem
    selected: Selected
    fit: Fit
    score: Score


def _better_load(score: Score, trained: _Trained) -> str:
    """Return what to say of the load that was found if it explains the torques far better."""
    error = float(trained.score.total[2])
    carried = trained.problem.carried
    if carried is None or not error < _BETTER * score.total[2]:
        return ''
    changing = _completed(trained)
    mass, deviation = (float(each[0]) for each in changing.load)
    if mass < _SHOWN * deviation or not is_usable(changing):
        return ''
    return load_problem(score, carried, mass, error)


def _better_convention(
    explained: Score,
    likely: Sequence[Convention],
    trained_as: Callable[[Convention], _Trained],
) -> tuple[Convention, Score] | None:
    """Return the first of likely ones that explains the torques far better, and its score.

    Signs and offsets that are not needed are left out of it.
    """
    for convention in likely:
        other = trained_as(convention)
        # zeros that are not needed are left out below, so ranges mean nothing yet
        if _left(other.score) < _BETTER * _left(explained) and is_usable(
            _completed(other)._replace(outside=())
        ):
            break
    else:
        return None
    score = other.score
    most = _AS_GOOD * _left(score)
    for i in range(len(convention)):
        for without in simpler(convention, i):
            trained = trained_as(without)
            if _left(trained.score) < most:
                convention, score = without, trained.score
                break
    return convention, score


def _left(score: Score) -> float:
    """Return what is left of the torques held back, each joint by its own torque."""
    return float(np.sqrt(np.mean(score.shares**2)))


def _trained(
    *,
    recording: Recording,
    robot: Robot,
    effort: Effort,
    picked_up: float | None,
    find_signs: bool,
    begin: Callable[[str], None] = tell_nobody,
) -> _Trained:
    """Return the arm that is fitted to a part of the recording: enough to compare others."""
    begin(CHECKING)
    problem = problem_of(recording, robot, effort, picked_up, find_signs=find_signs)
    windows = problem.windows
    begin(SELECTING)
    selected = select(problem.rows, windows.fit, problem.prior)
    begin(FITTING)
    trained = fitted(selected.rows, windows.fit, selected.prior, selected.found)
    score = scored(selected.rows, windows, problem.prior, trained.values)
    return _Trained(problem, selected, trained, score)


def _completed(
    trained: _Trained, begin: Callable[[str], None] = tell_nobody
) -> Identified:
    """Return the arm that is fitted to all of the recording, with its intervals."""
    problem, selected, fit, score = trained
    recording = problem.recording
    windows = problem.windows
    moving = windows.moving
    model = problem.parameters.model
    fits = fit_alone(fit.rows, windows.fit, problem.prior, COLUMNS)
    final = fitted(selected.rows, moving, selected.prior, selected.found)
    rows = final.rows
    gravity, inertia = shares(rows, moving, problem.P, final.theta[: rows.p])
    compliance = None
    if recording.twist is not None:
        compliance = compliance_of(rows, recording.twist, moving, final, problem.prior)
    begin(INTERVALS)
    covariance, torques = doubt(problem, selected.prior, final)
    return Identified(
        source=recording.source,
        duration=recording.duration,
        chain=problem.chain,
        parameters=problem.parameters,
        prior=problem.prior,
        values=final.values,
        covariance=covariance,
        left_out=torques,
        dynamics=nearest_friction(rows, windows, final.values),
        score=score,
        alone=errors_alone(rows, windows.test, fits),
        distances=selected.distances,
        widths=selected.widths,
        outside=tuple(outside_range(rows, problem.chain.joints)),
        still=_named(recording.joints, rows.speed < STILL),
        reversed=_named(recording.joints, problem.reversed),
        lasting=final.problem.lasting,
        rest=(rows.time.size - moving.size) * HOP,
        clipped=rows.clipped[moving].mean(axis=0),
        gravity=gravity,
        inertia=inertia,
        other='',
        carried=problem.carried,
        compliance=compliance,
        ripples=ripples_of(rows, moving, model, selected.distances, final.theta),
    )


def _named(joints: tuple[str, ...], which: np.ndarray) -> tuple[str, ...]:
    return tuple(joints[i] for i in np.flatnonzero(which))
