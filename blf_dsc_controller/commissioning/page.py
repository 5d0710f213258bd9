# SPDX-License-Identifier: Apache-2.0
"""The result of a commissioning in words: tables and sentences."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from blf_dsc_controller.analysis.output import aligned
from blf_dsc_controller.commissioning.better_known import FAR_ABOVE, known_friction
from blf_dsc_controller.commissioning.commissioned import CREEPING, Commissioned
from blf_dsc_controller.commissioning.findings import LONGEST_LAG
from blf_dsc_controller.commissioning.observer_pole import ENOUGH, POLES
from blf_dsc_controller.commissioning.planned import Planned
from blf_dsc_controller.commissioning.proof import Errors
from blf_dsc_controller.commissioning.strength import LITTLE
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.tool_bound import ANGLE, POSITION
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.numerics.digits import two_digits
from blf_dsc_controller.run import unit_of_all
from blf_dsc_controller.warnings.expected_errors import expectation

_DECIMALS = 6  # of a position
_SOFTER = 0.8  # of the stiffness of the measurement, from which it is said


def description(planned: Planned) -> str:
    """Return in a sentence how far and how fast a motion goes."""
    made = planned.excitation
    units = planned.config.units
    posture = ', '.join(f'{q:.3g}' for q in np.round(planned.posture, _DECIMALS) + 0.0)
    fastest = int(made.speed.argmax())
    return (
        f'{planned.duration:.3g} s around [{posture}] {unit_of_all(units, "rad")}; the tool '
        f'travels {1e3 * made.travel:.2g} mm, the fastest joint moves at {made.speed[fastest]:.2g} '
        f'{units[fastest].of("rad/s")}'
    )


# what it is, whether it was measured or chosen, and its unit for a joint that turns
_COLUMNS = (
    ('', '', ''),  # the joint
    ('inertia', 'measured', 'kg m^2'),
    ('as assumed', '', 'kg m^2'),
    ('damping', 'measured', 'N m s/rad'),
    ('friction', 'measured', 'N m'),
    ('resonance', 'measured', 'Hz'),
    ('stiffness', 'chosen', 'N m/rad'),
    ('damping', 'chosen', 'N m s/rad'),
    ('its lag', 'chosen', 'ms'),
)


def table(found: Commissioned) -> str:
    """Return what was measured and chosen for each joint, beside what was assumed."""
    names, origins, units = zip(*_COLUMNS, strict=True)
    of_all = [unit_of_all(found.before.units, unit) for unit in units]
    rows: list[Sequence[str]] = [names, origins, of_all]
    gains = found.choice.gains
    lags = np.broadcast_to(gains.damping_lag, gains.damping.shape)
    for j, joint in enumerate(found.joints):
        peaks = [
            each.frequency for each in found.findings.resonances if each.joint == j
        ]
        rows.append(
            (
                joint,
                _known(found.findings.inertia[j]),
                f'{found.assumed[j]:.3g}',
                f'{found.findings.damping[j]:.3g}',
                f'{found.findings.friction[j]:.2g}',
                f'{min(peaks):.0f}' if peaks else '-',
                f'{gains.stiffness[j]:.3g}',
                f'{gains.damping[j]:.3g}',
                f'{1e3 * lags[j]:g}' if lags[j] else '-',
            )
        )
    return aligned(rows)


def sentences(found: Commissioned, *, is_simulated: bool = False) -> Iterator[str]:
    """Yield what was found, what limits the gains, and what to do about it.

    Gains of an arm that `is_simulated` cannot be proven: --prove is for a robot.
    """
    yield from _of_states(found)
    yield from _of_hidden(found, is_simulated=is_simulated)
    yield from _of_friction(found, is_simulated=is_simulated)
    yield from _of_margin(found)
    yield from _of_lags(found)
    yield from _of_observer(found)
    yield from _of_factors(found)
    if found.has_margin:
        yield f'errors to expect with these gains: {expectation(found.config)}'
        yield from _of_bound(found)
    yield (
        f'measured in {len(found.responses)} runs: with another load, or far from their postures, '
        'measure again'
    )


def not_measured(name: str, reason: BlfDscError) -> str:
    """Return that the run of this name, with a load, is missing, and what to do."""
    return (
        f'{name}: not measured: {reason}. The margin is that without this load: commission once '
        'more with the file that is written, whose gains may hold it, or give less robot.payload'
    )


def _of_states(found: Commissioned) -> Iterator[str]:
    """Yield how often joint states come, in which steps, and how late they and torques are."""
    arm = found.findings
    states = f'joint states at {arm.rate:.4g} Hz, jitter {1e3 * arm.jitter:.3f} ms'
    coarsest = int(arm.resolution.argmax())
    step = float(arm.resolution[coarsest])
    unit = found.before.units[coarsest].of('mrad')
    steps = f'; positions in steps of {1e3 * step:.2g} {unit}' if step else ''
    yield f'{states}, {100.0 * arm.lost:.2g} % lost{steps}'
    if not np.isnan(arm.drive_lag):
        yield (
            f'a torque takes {1e3 * arm.drive_lag:.2g} ms to its motion, sampling included, and '
            f'velocities are {max(round(1e3 * arm.velocity_lag, 2), 0.0):.2g} ms old'
        )


def _of_margin(found: Commissioned) -> Iterator[str]:
    """Yield what limits the gains: a frequency, inertia or noise."""
    choice, limit = found.choice, found.choice.margin
    yield (
        f'the gains are limited near {two_digits(limit.frequency)} Hz by '
        f'{found.joints[limit.joint]}: there the modulus margin is {limit.value:.2g}; that of the '
        f'gains it was measured with is {choice.measured.value:.2g} at '
        f'{two_digits(choice.measured.frequency)} Hz'
    )
    if not found.has_margin:
        yield (f'NO GAINS HAVE THE MARGIN of {found.aim:g}: {found.why_no_margin}')
    if choice.by_inertia.any():
        names = ', '.join(np.array(found.joints)[choice.by_inertia])
        yield (
            f'{names}: limited by inertia; with these delays a rigid joint is not stable with more'
        )
    doubt = _doubt_at(found)
    if doubt > LITTLE:
        yield (
            f'noise costs {doubt:.2g} of the margin: a larger --torque may show that the arm '
            'is stable with more'
        )


def _of_lags(found: Commissioned) -> Iterator[str]:
    """Yield whose damping lags, and what the gains owe to that."""
    if not found.has_lags:
        return
    choice = found.choice
    lags = ', '.join(
        f'{joint} {1e3 * lag:g} ms'
        for joint, lag in zip(
            found.joints, np.asarray(choice.gains.damping_lag), strict=True
        )
        if lag
    )
    raised = choice.factors / choice.without_lag
    yield (
        f'the damping of {lags} lags (feedback.joint_damping_lag): it drives resonances less, '
        f'and with the same margin the damping of the joints is {raised.min():.3g} to '
        f'{raised.max():.3g} times what it would be without'
    )


def _of_observer(found: Commissioned) -> Iterator[str]:
    """Yield how fast the load observer is, and what limits it."""
    if found.observer is None:
        return
    pole, limit, why_none, noise_hides = found.observer
    where = f'near {two_digits(limit.frequency)} Hz, by {found.joints[limit.joint]}'
    if why_none:
        yield f'NO LOAD OBSERVER: {why_none}. Set robot.effort and robot.torque_loop as they are'
        return
    if pole == 0.0:
        slowest = f'the slowest pole, {POLES[0]:g} rad/s'
        yield 'NO LOAD OBSERVER: ' + (
            f'noise, friction or backlash hide whether the arm is stable with {slowest}'
            if noise_hides
            else f'with {slowest}, it would leave a modulus margin of {limit.value:.2g} {where}, '
            'or too little for a load'
        )
        return
    if noise_hides:
        limited = (
            'noise, friction or backlash hide whether it is stable with a faster one'
        )
    elif pole == POLES[-1]:
        limited = 'a faster one gains little'
    else:
        limited = f'a faster one less than {ENOUGH:g}, or too little for a load'
    yield (
        f'the load observer has a pole of {pole:g} rad/s, which leaves a modulus margin of '
        f'{limit.value:.2g} {where}: {limited}'
    )


def _of_factors(found: Commissioned) -> Iterator[str]:
    """Yield how to raise gains that are far above those of the measurement."""
    most = float(found.choice.factors.max())
    if most > FAR_ABOVE:
        joint = found.joints[int(found.choice.factors.argmax())]
        yield (
            f'{joint} gets {two_digits(most)} times the gains it was measured with: raise '
            'feedback.stiffness from 0.25 to 1 in steps, or measure again with this file at 0.25'
        )


def _of_hidden(found: Commissioned, *, is_simulated: bool) -> Iterator[str]:
    """Yield of which joints no inertia is seen, why, and how much there may be."""
    first, last = 'prove the gains (--prove), or ', ', and prove the gains (--prove)'
    if is_simulated:
        first = last = ''
    names = np.array(found.joints)
    hidden = np.isnan(found.findings.inertia)
    unfit = hidden & found.findings.unfit.any(axis=0)
    stuck = hidden & ~unfit
    if stuck.any():
        yield (
            f'friction hides the inertia of {", ".join(names[stuck])}: that of the URDF is used, '
            'and the margin is that of joints that stick, not that of joints that slide: '
            f'{first}take half of feedback.stiffness and a wider bound'
        )
    if unfit.any():
        yield (
            f'{", ".join(names[unfit])}: an inertia would fit best with a lag of '
            f'{1e3 * LONGEST_LAG:g} ms, the longest that is tried, so it is not believed and '
            'that of the URDF is used: friction or noise hide it, or the drives are as late. '
            f'Measure again with a larger --torque or --travel{last}'
        )
    unseen = ', '.join(
        f'{joint} {more:.2g} {units.inertia}'
        for joint, more, units in zip(
            found.joints, found.unseen, found.before.units, strict=True
        )
        if more > 0.0
    )
    if unseen:
        yield f'so much more inertia would not show, and the errors to expect count it: {unseen}'


def _of_friction(found: Commissioned, *, is_simulated: bool) -> Iterator[str]:
    """Yield where friction adds damping that is gone in steady motion, or is not in the file."""
    names = np.array(found.joints)
    hidden = np.isnan(found.findings.inertia)
    rubbing = ~hidden & (found.findings.damping > found.choice.gains.damping)
    if rubbing.any():
        remedy = '' if is_simulated else ', so prove the gains (--prove)'
        yield (
            f'friction damps {", ".join(names[rubbing])} more than the gains do while excited, and '
            f'less in a steady motion: the true margin is smaller{remedy}'
        )
    if found.coulomb is not None:
        measured = ', '.join(f'{each:.2g}' for each in found.coulomb)
        yield (
            f'friction of {measured} {unit_of_all(found.before.units, "N m")} is written as '
            'robot.coulomb: the last runs and the gains have it compensated'
        )
        return
    known = known_friction(found.before)
    more = [
        f'{joint} {measured:.2g} {unit} instead of {assumed:g}'
        for joint, (_, unit, _), measured, assumed, floor in zip(
            found.joints,
            found.before.units,
            found.findings.friction,
            known,
            found.before.learning.residual_floor,
            strict=True,
        )
        if measured > assumed + floor
    ]
    if more:
        yield (
            f'more friction than robot.coulomb: {"; ".join(more)}. The errors to expect count it, '
            f'{CREEPING:g} times as much of joints that hardly slid'
        )


def _of_bound(found: Commissioned) -> Iterator[str]:
    """Yield which bounds are wider than they were, and what softer gains mean for others."""
    for name, wider in _wider(found).items():
        if wider:
            yield (
                f'{name} is widened for these errors: {"; ".join(wider)}; a smaller '
                'robot.payload needs less'
            )
    share = found.choice.gains.stiffness / found.start.stiffness
    if share.min() < _SOFTER:
        yield (
            f'the gains are down to {share.min():.2g} of the stiffness that it was measured with '
            f'({found.joints[int(share.argmin())]}): unexpected errors, such as by more '
            'friction, grow by as much; a bound that was given for the stiffer gains may be too '
            'narrow'
        )


def _wider(found: Commissioned) -> dict[str, list[str]]:
    """Return by the name of a bound what is wider than it was: of the tool, or of each joint."""
    after, before = found.config.barrier, found.before.barrier
    if before.bounds_tool:
        bounds = {
            POSITION: ('m', after.tool_bound, before.tool_bound),
            ANGLE: ('rad', after.tool_angle_bound, before.tool_angle_bound),
        }
        return {
            name: [f'{wide:g} {unit} instead of {usual:g}'] if wide > usual else []
            for name, (unit, wide, usual) in bounds.items()
        }
    wider = [
        f'{joint} {wide:g} {unit} instead of {usual:g}'
        for joint, (unit, _, _), wide, usual in zip(
            found.joints, found.config.units, after.bound, before.bound, strict=True
        )
        if wide > usual
    ]
    return {'barrier.bound': wider}


def errors_table(config: ControllerConfig, errors: Errors) -> str:
    """Return the largest errors of a proof beside those to expect, for each joint."""
    unit = unit_of_all(config.units, 'mrad')
    rows: list[Sequence[str]] = [('', 'error', 'expected'), ('', unit, unit)]
    rows += [
        (joint, two_digits(1e3 * measured), two_digits(1e3 * expected))
        for joint, measured, expected in zip(config.joints, *errors, strict=True)
    ]
    return aligned(rows)


def _doubt_at(found: Commissioned) -> float:
    """Return what noise takes from the margin where it is least."""
    limit = found.choice.margin
    doubt = found.loops.singular_values(found.choice.gains)[limit.posture].doubt
    at = found.responses[limit.posture].frequency
    return float(doubt[int(np.abs(at - limit.frequency).argmin())])


def _known(value: float) -> str:
    return '-' if np.isnan(value) else f'{value:.3g}'
