# SPDX-License-Identifier: Apache-2.0
"""Why an identified arm is not to be used: its efforts, its mounting, its joints, its errors."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from blf_dsc_controller.identification.conventions import Convention, signs_and_offsets
from blf_dsc_controller.identification.identified import IDLE, Identified, Score
from blf_dsc_controller.identification.plausibility import GRAVITY, INERTIA
from blf_dsc_controller.identification.recording import Indices
from blf_dsc_controller.identification.values import OFFSET
from blf_dsc_controller.identification.windows import Carried
from blf_dsc_controller.numerics.intervals import TWO_SIDED
from blf_dsc_controller.run import Floats

_POOR = 0.2  # of the torque, largest accepted error on the part held back
_GOOD = 0.02  # likewise, error that is accepted whatever else is possible
_UNEXPLAINED = 0.2  # of the torque of a joint, error with which its values mean little
_FAR = 3.0  # times the error of a model of a joint alone: this one is wrong
_LARGE = 0.1  # of the torque of a joint, error that is a fault ...
_NOTHING_EXPLAINED = 0.6  # of the torque of a joint, error that is a fault
_OFFSET = 0.7  # of the torque of a joint, offset that is as large as the rest
_TENFOLD = 10.0  # change of a mass
_KNOWN = 0.1  # of all masses, half an interval that says nothing of a body
_HEAVY = 0.01  # of all masses, that of a body that is no dummy
_AGREE = np.log(1.1)  # of factors of gravity and inertia
_SCALED = np.log(1.3)  # of the same factor, that is asked
_RELEVANT = 0.02  # ... if it is so much of the largest torque


def problems_of(found: Identified, effort: str) -> Iterator[str]:
    """Yield why the efforts or the result are doubtful."""
    if found.other:
        yield found.other
        return
    yield from _size_problems(found, effort)
    # better than the URDF, and not much worse than models of joints alone
    urdf, _, total = found.score.total
    alone = 100.0 * np.sqrt(np.sum(found.alone**2) / np.sum(found.score.torque**2))
    if not total <= min(100.0 * _POOR, max(100.0 * _GOOD, _FAR * alone), urdf):
        yield (
            'DO NOT USE this URDF: it does not explain the torques held back. Are the efforts in '
            'N m or N (currents need --gains), is --gravity given in the base frame, are the '
            'zeros and directions of the joints those of the URDF, and was the load the same '
            'throughout?'
        )
    yield from _joint_problems(found)
    yield from _value_problems(found)


def verdict_of(found: Identified, effort: str) -> str:
    """Return whether the result can be used, and up to what."""
    urdf, _, total = found.score.total
    left = f'{total:.3g} % of the torque is left on motion held back, {urdf:.3g} % by the URDF'
    problems = len(list(problems_of(found, effort)))
    if problems:
        return f'REFUSED for {problems} reason(s), given below: {left}'
    agree = abs(np.log(found.inertia / found.gravity)) < _AGREE
    if agree and abs(np.log(found.gravity)) > _SCALED:
        return (
            f'ACCEPTED IF EFFORTS ARE IN N m: gravity and inertia are both {found.gravity:.2g} '
            "times the URDF's, as with another unit or gain of the torques: --gains would "
            f'correct it. {left}'
        )
    return (
        f'ACCEPTED: {left}. Masses and friction are known up to a common factor of the torque '
        'sensors'
    )


def mounting_problem(gravity: Floats) -> str:
    """Return which gravity (3,) [m/s^2] in the base would explain the torques."""
    words = ' '.join(f'{value:.3g}' for value in gravity)
    return (
        f'ANOTHER MOUNTING: the torques show gravity along ({words}) in the base frame: give '
        f'--gravity {words}, or correct the mounting in the URDF'
    )


def load_problem(score: Score, carried: Carried, mass: float, error: float) -> str:
    """Return which load [kg], carried for a part of the recording, would explain the torques.

    `score` is that without, and `error` that of the torques held back with it [% of their rms].
    """
    return (
        f'THE LOAD CHANGES: the torque error is {error:.3g} instead of '
        f'{score.total[2]:.3g} % with {mass:.2g} kg {carried.when}. Give '
        '--payload, which weighs them, or a recording in which the load stays the same'
    )


def convention_problem(
    joints: Sequence[str], score: Score, convention: Convention, better: Score
) -> str:
    """Return which zeros and directions of joints would explain the torques `better`."""
    signs, offsets = signs_and_offsets(convention)
    steps, differ = [], []
    if (signs < 0.0).any():
        names = ', '.join(np.array(joints)[signs < 0.0])
        steps.append(f'positions and efforts are negated of {names}')
        differ.append('directions')
    if offsets.any():
        moved = (
            f'{offset:+.5g} rad to {name}'
            for offset, name in zip(offsets, joints, strict=True)
            if offset
        )
        steps.append(f'there is added to the positions: {", ".join(moved)}')
        differ.append('zeros')
    i = int(np.argmax(score.shares - better.shares))
    return (
        f'OTHER {" AND ".join(differ).upper()}: the torque error is '
        f'{better.total[2]:.3g} instead of {score.total[2]:.3g} % (of {joints[i]} '
        f'{100.0 * better.shares[i]:.2g} instead of {100.0 * score.shares[i]:.2g} %) if '
        f'{", and if then ".join(steps)}. So the joints seem to have other '
        f'{" and ".join(differ)} than in the URDF, as in a DH convention: check this, and convert '
        'the recording'
    )


def _size_problems(found: Identified, effort: str) -> Iterator[str]:
    """Yield a problem if the arm is not of the size of the URDF's."""
    least, most = GRAVITY
    share = f"the efforts contain {found.gravity:.2g} of the URDF's"
    if found.gravity < least:
        yield (
            f'GRAVITY IS MISSING: {share}, so that masses in kg cannot be told from them. If they '
            'are currents, give --gains; if the drives compensate it, --effort without-gravity; '
            'if the arm is not mounted upright, --gravity; if joints have other zeros or '
            'directions than in the URDF, as in a DH convention, convert their positions'
        )
    elif found.gravity > most:
        cause = (
            'If they are not in N m or N, give --gains. Are the masses of the URDF far too small, '
            'or is it without its tool?'
        )
        if effort == 'without-gravity':
            cause = 'The efforts are the whole torque: give --effort torque'
        yield f'GRAVITY IS DOUBLE: {share}. {cause}'
    elif np.isnan(found.gravity) and not INERTIA[0] < found.inertia < INERTIA[1]:
        yield (
            f"INERTIA IS NOT OF THIS SIZE: the efforts contain {found.inertia:.2g} of the URDF's. "
            'If they are not in N m or N, give --gains'
        )


def _joint_problems(found: Identified) -> Iterator[str]:
    """Yield joints whose torque can be explained, but not by this arm."""
    score = found.score
    errors = score.errors[2]
    large = np.maximum(_LARGE * score.torque, _RELEVANT * score.torque.max())
    for i in np.flatnonzero((errors > _FAR * found.alone) & (errors > large)):
        left, alone = 100.0 * errors[i] / score.torque[i], found.alone[i]
        yield (
            f'{found.joints[i]} DOES NOT FIT: {left:.0f} % of its torque is left, though a model '
            f'of this joint alone leaves {100.0 * alone / score.torque[i]:.1f} %. Do the sign and '
            'the unit of its effort, and its axis in the URDF, agree with those of other joints?'
        )


def _value_problems(found: Identified) -> Iterator[str]:
    """Yield values that no recording of this arm should give."""
    if found.outside:
        yield (
            f'OUTSIDE OF ITS RANGE: {"; ".join(found.outside)} in the URDF. Correct zero and '
            'direction, or the limits'
        )
    score = found.score
    largest = score.torque.max()
    for i in unexplained_joints(found):
        share = score.errors[2, i] / score.torque[i]
        if share > _NOTHING_EXPLAINED and score.torque[i] > IDLE * largest:
            yield (
                f'{found.joints[i]} IS NOT EXPLAINED: {100.0 * share:.0f} % of its torque is left. '
                'Are its effort and that of another joint exchanged?'
            )
    offsets = np.abs(found.parts.terms[OFFSET])
    is_large = (offsets > _OFFSET * score.torque) & (score.torque > _RELEVANT * largest)
    for i in np.flatnonzero(is_large):
        yield (
            f'{found.joints[i]} HAS AN OFFSET OF {offsets[i]:.2g} beside a torque of '
            f'{score.torque[i]:.2g} (rms). Calibrate its sensor; a spring or counterbalance, '
            'which is not in the model, looks like this, too'
        )
    masses = found.parts.bodies[:, 0]
    halves = TWO_SIDED * found.deviations.bodies[:, 0]
    before = np.array([joint.inertia[0] for joint in found.chain.joints])
    for joint, mass, half, old in zip(
        found.chain.joints, masses, halves, before, strict=True
    ):
        is_other = not old / _TENFOLD < mass < _TENFOLD * old
        is_unknown = half > max(mass, old, _KNOWN * before.sum())
        if old > _HEAVY * before.sum() and (is_other or is_unknown):
            yield (
                f'THE MASS OF {joint.link} IS {mass:.3g} +- {half:.2g} kg instead of {old:.3g}: '
                'record a motion that does not repeat and has other postures, or correct what '
                'else is odd here'
            )


def unexplained_joints(found: Identified) -> Indices:
    """Return the joints of whose own torque much is left, the worst first."""
    torque = found.score.torque
    shares = found.score.errors[2] / torque
    is_idle = (torque < IDLE * torque.max()) & (shares > 1.0)
    shares[is_idle | np.isin(found.joints, found.still)] = 0.0
    order = np.argsort(-shares)
    return np.asarray(order[shares[order] > _UNEXPLAINED])


def is_usable(found: Identified) -> bool:
    """Whether the model explains the torques held back, and is of the size of the URDF's."""
    return not any(problems_of(found, ''))
