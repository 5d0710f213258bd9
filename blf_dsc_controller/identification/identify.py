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
from blf_dsc_controller.identification.ripple import (
    PER_HOP,
    ROWS,
    SAMPLES,
    SHORT,
    Ripples,
    ripples_of,
)
from blf_dsc_controller.identification.scoring import nearest_friction, scored
from blf_dsc_controller.identification.selection import Selected, repeats, select
from blf_dsc_controller.identification.stiffness import Compliance, compliance_of
from blf_dsc_controller.identification.values import parts
from blf_dsc_controller.identification.wider_model import doubt
from blf_dsc_controller.identification.windows import (
    COLUMNS,
    HOP,
    STILL,
    shortened,
)
from blf_dsc_controller.run import Floats

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
        begin=tell_nobody,
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
        likely_conventions(recording, robot, unexplained.tolist()),
        lambda convention: trained(recording=converted(recording, convention)),
    )
    if better is None:
        return found
    return found._replace(other=convention_problem(found.joints, found.score, *better))


class _Trained(NamedTuple):
    """An arm fitted to the first four fifths of a recording, and scored on the rest."""

    recording: Recording
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
    changing = _completed(trained, tell_nobody)
    mass, deviation = (float(each[0]) for each in changing.load)
    if mass < _SHOWN * deviation or not is_usable(changing):
        return ''
    return load_problem(score, carried, mass, error)


def _better_convention(
    explained: Score,
    likely: Sequence[Convention],
    trained_as: Callable[[Convention], _Trained],
) -> tuple[Convention, Score] | None:
    """Return the first of likely ones that explains the torques far better, and its score."""
    for convention in likely:
        other = trained_as(convention)
        is_better = _left(other.score) < _BETTER * _left(explained)
        if not is_better:
            continue
        # zeros that are not needed are left out below, so ranges mean nothing yet
        completed = _completed(other, tell_nobody)._replace(outside=())
        if is_usable(completed):
            return _simplest(convention, other.score, trained_as)
    return None


def _simplest(
    convention: Convention,
    score: Score,
    trained_as: Callable[[Convention], _Trained],
) -> tuple[Convention, Score]:
    """Return the convention without signs and offsets that are not needed, and its score."""
    most = _AS_GOOD * _left(score)
    for i in range(len(convention)):
        for other in simpler(convention, i):
            trained = trained_as(other)
            if _left(trained.score) < most:
                convention, score = other, trained.score
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
    begin: Callable[[str], None],
) -> _Trained:
    """Return the arm that is fitted to a part of the recording: enough to compare others."""
    begin(CHECKING)
    problem = problem_of(recording, robot, effort, picked_up, find_signs=find_signs)
    windows = problem.windows
    begin(SELECTING)
    selected = _selected(problem)
    begin(FITTING)
    trained = fitted(selected.rows, windows.fit, selected.prior, selected.found)
    score = scored(selected.rows, windows, problem.prior, trained.values)
    return _Trained(recording, problem, selected, trained, score)


def _selected(problem: Problem) -> Selected:
    """Return the model of an arm."""
    return select(problem.rows, problem.windows.fit, problem.prior)


def _final_fit(problem: Problem, selected: Selected) -> Fit:
    """Return the fit to all of a recording."""
    moving = problem.windows.moving
    return fitted(selected.rows, moving, selected.prior, selected.found)


def _completed(trained: _Trained, begin: Callable[[str], None]) -> Identified:
    """Return the arm that is fitted to all of the recording, with its intervals."""
    recording, problem, selected, fit, score = trained
    windows = problem.windows
    fits = fit_alone(fit.rows, windows.fit, problem.prior, COLUMNS)
    final = _final_fit(problem, selected)
    rows = final.rows
    dynamics = nearest_friction(rows, windows, final.values)
    size = shares(rows, windows.moving, problem.P, final.theta[: rows.p])
    compliance = _compliance(problem, recording, final)
    begin(INTERVALS)
    doubted = doubt(problem, selected.prior, final)
    return Identified(
        source=recording.source,
        duration=recording.duration,
        chain=problem.chain,
        parameters=problem.parameters,
        prior=problem.prior.mean,
        prior_covariance=problem.prior.D @ problem.prior.D.T,
        values=final.values,
        covariance=doubted.covariance,
        left_out=doubted.torques,
        dynamics=dynamics,
        score=score,
        alone=errors_alone(rows, windows.test, fits),
        distances=selected.distances,
        widths=selected.widths,
        outside=tuple(outside_range(rows, problem.chain.joints)),
        still=_named(recording.joints, rows.speed < STILL),
        reversed=_named(recording.joints, problem.reversed),
        lasting=final.problem.lasting,
        rest=(rows.time.size - windows.moving.size) * HOP,
        clipped=rows.clipped[windows.moving].mean(axis=0),
        gravity=size.gravity,
        inertia=size.inertia,
        other='',
        carried=problem.carried,
        compliance=compliance,
        ripples=ripples_left(problem, selected.distances, final),
    )


def _compliance(problem: Problem, recording: Recording, fit: Fit) -> Compliance | None:
    """Return the compliances of the gears, if there are positions of motors and links."""
    if recording.twist is None:
        return None
    links = fit.values.copy()
    parts(links).terms[:] = 0.0
    parts(links).coupling[:] = 0.0
    theta = problem.prior.G @ links
    moving = problem.windows.moving
    return compliance_of(fit.rows, recording.twist, moving, theta, fit.values[-1])


def ripples_left(problem: Problem, distances: Floats, fit: Fit) -> tuple[Ripples, ...]:
    """Return the ripple of each joint in the torques that a fit leaves.

    `distances` (n,) are those of its contacts.
    """
    length = max(SHORT, SAMPLES * fit.rows.period)
    moving = problem.windows.moving
    model = problem.parameters.model
    parts = max(1, min(PER_HOP, ROWS // moving.size))
    short = shortened(fit.rows, moving, model, distances, length, parts)
    found = ripples_of(short.with_load(fit.theta), fit.theta)
    again = repeats(fit.rows, problem.windows.fit)
    return tuple(each._replace(repeats=again) for each in found)


def _named(joints: tuple[str, ...], which: np.ndarray) -> tuple[str, ...]:
    return tuple(joints[i] for i in np.flatnonzero(which))
