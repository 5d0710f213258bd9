# SPDX-License-Identifier: Apache-2.0
"""What was identified, as text: tables with units and 95 % intervals, and notes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from blf_dsc_controller.analysis.output import aligned
from blf_dsc_controller.identification.identified import (
    IDLE,
    Identified,
    mass_and_centre,
)
from blf_dsc_controller.identification.left_out import KINDS
from blf_dsc_controller.identification.problems import unexplained_joints
from blf_dsc_controller.identification.ripple import Ripples, listed_cycles
from blf_dsc_controller.identification.stiffness import LARGEST_TWIST
from blf_dsc_controller.identification.values import (
    COULOMB,
    JOINT_TERMS,
    OFFSET,
    ROTOR_INERTIA,
    VISCOUS,
    base_matrix,
    units_of,
)
from blf_dsc_controller.identification.windows import SMOOTHING, WINDOW
from blf_dsc_controller.numerics.intervals import TWO_SIDED
from blf_dsc_controller.run import Floats, joint_units

UNSEEN = 0.5
"""Share of the prior's variance; parameters that keep more are not shown."""

_LASTING = 3.0 * WINDOW  # s; noise is correlated over one window
_LATE = 0.01  # s, longest plausible delay
_LARGE_OFFSET = 0.1  # of the torque
_ALL_WRONG = 1.0  # of the torque, error of a joint that the model does not explain

_NOTHING = 1e-3  # of half of its interval, value that is printed as 0 ...
_ROUNDING = 1e-9  # ... and value of a URDF
_OF_REPEATED = (
    'the motion repeats, and with it the error of model and friction, which may look like a '
    'ripple: use only what a minute of motion that does not repeat shows, too'
)
_FELT = 0.005  # of the torque, and of the largest: what the model leaves out is told
_LEFT_OUT = (
    'friction that fades with speed',
    'friction that builds up along a distance at reversals',
    'friction that differs with the direction',
    'friction that grows with the torque',
    'joints whose torque is measured with another gain',
    'joints that are elastic behind their encoders',
)  # of KINDS
_REMEDIES = {
    'gain': (
        ', but cover fewer than 95 % of the true values. MASSES AND FRICTION ARE KNOWN UP TO '
        'THESE GAINS ONLY: what all gains have in common cannot be known from torques. Calibrate '
        'the sensors, as with a known weight'
    ),
    'elasticity': '; positions of motors and links, --map theta=, would show their stiffness',
}


def interval(value: float, deviation: float, digits: str = '.4g') -> str:
    """Return a value with its 95 % interval; 0 if it is nothing beside that."""
    half = TWO_SIDED * deviation
    return f'{_beside(half, value, _NOTHING):{digits}} +- {half:.2g}'


def _beside(half: float, value: float, nothing: float) -> float:
    """Return a value, or 0 if it is less than that share of a half width."""
    return 0.0 if abs(value) < nothing * half else value


def header_of(found: Identified) -> str:
    """Return where the recording is from, and how velocities were found."""
    joints = len(found.chain.joints)
    return (
        f'{found.source}: {found.duration:.1f} s of {joints} joints; velocities from positions, '
        f'smoothed over {1e3 * SMOOTHING:.0f} ms'
    )


def load_table(found: Identified) -> Iterator[str]:
    """Yield the load that was picked up, if any."""
    if found.carried is None:
        return
    values, deviations = found.load
    mass, *centre = _mass_and_centre(values, deviations)
    if values[0] < TWO_SIDED * deviations[0]:
        yield f'load: none that shows ({mass} kg)'
        return
    yield (
        f'load {found.carried.when}: {mass} kg, its centre at {", ".join(centre)} mm '
        f'in {found.chain.tip}'
    )


def _mass_and_centre(values: Floats, deviations: Floats) -> Iterator[str]:
    """Yield mass [kg] and centre [mm] of values in kg and m (4,), with their intervals."""
    yield interval(values[0], deviations[0], '.3f')
    for value, deviation in zip(1e3 * values[1:], 1e3 * deviations[1:], strict=True):
        yield interval(value, deviation, '.1f')


def bodies_table(found: Identified) -> str:
    """Return masses and centres before and after."""
    rows = [('body', 'mass [kg]', 'centre of mass [mm]')]
    for i, joint in enumerate(found.chain.joints):
        at = slice(10 * i, 10 * i + 4)
        mass, *after = _mass_and_centre(
            *mass_and_centre(found.values[at], found.covariance[at, at], np.eye(4))
        )
        before = joint.inertia[1:4] / joint.inertia[0]
        centre = [
            f'{1e3 * old:.1f} -> {new}' for old, new in zip(before, after, strict=True)
        ]
        rows.append(
            (joint.link, f'{joint.inertia[0]:.3f} -> {mass}', ', '.join(centre))
        )
    return aligned(rows)


def joints_table(found: Identified) -> str:
    """Return rotors and friction of each joint, with their units."""
    terms = found.parts.terms
    shown = np.flatnonzero(terms.any(axis=1))
    rows = [('joint', *(JOINT_TERMS[k] for k in shown))]
    for i, joint in enumerate(found.chain.joints):
        units = units_of(joint.kind)
        cells = [
            f'{interval(terms[k, i], found.deviations.terms[k, i])} {units[k]}'
            if terms[k, i]
            else ''
            for k in shown
        ]
        rows.append((joint.name, *cells))
    return aligned(rows)


def stiffness_table(found: Identified) -> Iterator[str]:
    """Yield the stiffness of each joint, if positions of motors and links are known."""
    compliance = found.compliance
    if compliance is None or not compliance.is_twist:
        return
    rows = [('joint', 'stiffness between motor and link', '95 % interval')]
    values, least, most = compliance.stiffness
    for i, joint in enumerate(found.chain.joints):
        unit = joint_units(joint.kind).of('N m/rad')
        is_bound = 0.0 < least[i] < np.inf
        bound = f': above {least[i]:.3g} {unit}' if is_bound else ''
        cells = f'cannot be known{bound}', ''
        if compliance.is_negative[i]:
            cells = 'cannot be known: it twists against its torque', ''
        elif compliance.is_known[i]:
            cells = f'{values[i]:.5g} {unit}', f'{least[i]:.5g} to {most[i]:.5g}'
        rows.append((joint.name, *cells))
    yield aligned(rows)


def ripple_table(found: Identified) -> Iterator[str]:
    """Yield the ripple of each joint with its 95 % interval, and the parameter to learn it by."""
    rows = [('joint', 'torque ripple: its amplitude, and periods per turn')]
    for joint, own in zip(found.chain.joints, found.ripples, strict=True):
        slides = joint.kind == 'prismatic'
        cells = _ripple_cells(own, units_of(joint.kind)[OFFSET], ' rad/m' * slides)
        rows.append((joint.name, cells))
    lines = [aligned(rows)]
    if cycles := listed_cycles(found.ripples):
        lines += [
            'the controller learns to compensate it with this parameter:',
            f'learning.ripple_cycles: [{", ".join(map(str, cycles))}]',
        ]
        if any(each.found and each.repeats for each in found.ripples):
            lines.append(_OF_REPEATED)
    yield '\n'.join(lines)


def _ripple_cells(own: Ripples, torque: str, cycles: str) -> str:
    """Return the ripples of one joint, in units of its torque and of N."""
    if not own.is_known:
        return 'cannot be known: the joint moved too little'
    if not own.found:
        first, last = own.seen
        return (
            f'none above {own.least:.2g} {torque} at {first:.3g} to {last:.3g}{cycles}'
        )
    return '; '.join(
        f'{interval(each.amplitude, each.amplitude_deviation, ".3g")} {torque} at '
        f'{interval(each.cycles, each.cycles_deviation)}{cycles}'
        for each in own.found
    )


def base_table(found: Identified) -> Iterator[str]:
    """Yield the base parameters before and after, and which of them the recording shows."""
    parameters = found.parameters
    K = base_matrix(parameters, len(found.chain.joints))[: len(parameters.combinations)]
    before = K @ found.prior.mean
    after = K @ found.values
    prior = np.sum((K @ found.prior.D) ** 2, axis=1)
    posterior = np.einsum('ia,ab,ib->i', K, found.covariance, K)
    yield 'base parameters (all that torques can show), in kg, kg m, kg m^2:'
    for k, name in enumerate(parameters.combinations):
        half = TWO_SIDED * posterior[k] ** 0.5
        old = _beside(half, before[k], _ROUNDING)
        new = _beside(half, after[k], _NOTHING)
        unseen = posterior[k] > UNSEEN * prior[k]
        is_same = abs(after[k] - before[k]) < half
        source = 'from the URDF' if is_same else 'hardly more than the URDF'
        mark = f'  NOT SHOWN by this recording: {source}' if unseen else ''
        yield f'{old:10.4g} -> {new:10.4g} +- {half:<8.2g}  {name}{mark}'


def errors_table(found: Identified) -> str:
    """Return the torque errors of the part held back."""
    score = found.score
    shares = 100.0 * score.errors / score.torque
    rows = [['joint', 'URDF', 'corrected', 'with all terms', 'rms torque']]
    for i, joint in enumerate(found.chain.joints):
        errors = [f'{share:.2f}' for share in shares[:, i]]
        unit = joint_units(joint.kind).torque
        rows.append([joint.name, *errors, f'{score.torque[i]:.3g} {unit}'])
    rows.append(['all', *(f'{total:.2f}' for total in score.total), ''])
    begin, end = score.held_back
    title = (
        f'torque error from {begin:.1f} to {end:.1f} s, a part that was held back while the model '
        'was chosen and fitted\n[% of rms torque]; the values below are a fit to the whole motion:'
    )
    return f'{title}\n{aligned(rows)}'


def notes_of(found: Identified) -> Iterator[str]:
    """Yield what else was found, and what follows from it."""
    coupling = found.parts.coupling
    if coupling.any():
        deviations = found.deviations.coupling
        inertia, viscous, coulomb = map(interval, coupling, deviations)
        units = units_of(found.chain.joints[-1].kind)
        yield (
            f'one motor drives {found.joints[-2]} and {found.joints[-1]}: inertia {inertia} '
            f'{units[ROTOR_INERTIA]}, viscous friction {viscous} {units[VISCOUS]} and Coulomb '
            f'friction {coulomb} {units[COULOMB]} act on both'
        )
    if found.reversed:
        yield (
            f'the efforts of {", ".join(found.reversed)} have the opposite sign, and were '
            'reversed: give --gains with -1 for them to confirm this'
        )
    yield from _delay_notes(found)
    yield from _joint_notes(found)
    yield from _doubt_notes(found)
    yield from _stiffness_notes(found)
    wider = [f'{name} {width:g}' for name, width in found.widths.items() if width > 1.0]
    if wider:
        yield (
            'the recording contradicts the URDF more than expected, so the URDF was trusted less: '
            f'its standard deviations were multiplied by {", ".join(wider)}'
        )
    urdf, corrected, _ = found.score.total
    if corrected > urdf:
        yield (
            'the corrected URDF alone predicts worse than the original: terms for which a URDF has '
            'no place, above all offsets and rotors, are large here; use the .yaml of --out'
        )
    if found.rest:
        yield f'{found.rest:.1f} s in which no joint moves were left out'


def _delay_notes(found: Identified) -> Iterator[str]:
    delay = found.parts.delay[0]
    text = interval(1e3 * delay, 1e3 * found.deviations.delay[0], '.2f')
    yield f'delay of the torques relative to the positions: {text} ms'
    if abs(delay) > _LATE:
        late = 'torques' if delay > 0.0 else 'positions'
        yield (
            f'a delay of {1e3 * delay:.0f} ms is long: are the {late} filtered, or stamped when '
            'they were received? What remains of the delay distorts the inertias'
        )


def _joint_notes(found: Identified) -> Iterator[str]:
    """Yield what is odd with joints: one note for all that share it."""
    torque = found.score.torque
    share = found.score.errors[2] / torque
    names = found.joints
    units = [units_of(joint.kind)[OFFSET] for joint in found.chain.joints]
    offsets = found.parts.terms[OFFSET]
    is_still = np.isin(names, found.still)
    is_idle = (share > _ALL_WRONG) & (torque < IDLE * torque.max()) & ~is_still
    for i in np.flatnonzero(found.clipped):
        yield (
            f'the torque of {names[i]} is clipped, as by a limit: {100.0 * found.clipped[i]:.0f} % '
            'of its rows were left out'
        )
    notes = {
        ', for which a URDF has no place: calibrate the torque sensors, or let the controller '
        'learn them (learning.bias)': [
            f'{names[i]} has an offset of {offsets[i]:.2g} {units[i]}'
            for i in np.flatnonzero(np.abs(offsets) > _LARGE_OFFSET * torque)
        ],
        ': these are torques, not noise, and may have shifted values beyond their intervals': [
            f'{"that of" if k else "the residual of"} {names[i]}{"" if k else " lasts"} '
            f'({found.lasting[i]:.2g} s)'
            for k, i in enumerate(np.flatnonzero(found.lasting > _LASTING))
        ],
        ' did not move: rotors and friction of these are guesses': found.still,
        ', so the error in % means little there': [
            f'{names[i]} hardly needs a torque ({torque[i]:.2g} {units[i]})'
            for i in np.flatnonzero(is_idle)
        ],
        ' are not explained: do not trust the values there before sign, unit and zero are those '
        'of the URDF': [
            f'{100.0 * share[i]:.0f} % of the torque of {names[i]}'
            for i in np.sort(unexplained_joints(found))
        ],
    }
    yield from (', '.join(joints) + what for what, joints in notes.items() if joints)


def _doubt_notes(found: Identified) -> Iterator[str]:
    """Yield what the model leaves out, and which values are not known."""
    share = found.left_out / found.score.torque
    relevant = found.left_out > _FELT * found.score.torque.max()
    for kind, words, shares, is_felt in zip(
        KINDS, _LEFT_OUT, share, relevant & (share > _FELT), strict=True
    ):
        if is_felt.any():
            i = int(np.argmax(shares * is_felt))
            yield (
                f'the recording shows {words}, more than the model has terms for: up to '
                f'{100.0 * shares[i]:.1f} % of the torque, of {found.joints[i]}. Intervals allow '
                f'for it{_REMEDIES.get(kind, "")}'
            )
    values, deviations = found.parts.terms, found.deviations.terms
    for term in (ROTOR_INERTIA, VISCOUS, COULOMB):
        unknown = np.flatnonzero(TWO_SIDED * deviations[term] > values[term])
        if unknown.size:
            yield (
                f'{JOINT_TERMS[term]} of {", ".join(found.joints[i] for i in unknown)} cannot be '
                'known from this recording: the interval contains zero'
            )


def _stiffness_notes(found: Identified) -> Iterator[str]:
    """Yield what is wrong with the positions of motors and links."""
    compliance = found.compliance
    if compliance is None:
        return
    names = np.array(found.joints)
    if not compliance.is_twist:
        i = int(np.argmax(compliance.largest))
        yield (
            f'the position of the motor of {names[i]} differs by up to {compliance.largest[i]:.2g} '
            f"from its link's, more than the {LARGEST_TWIST:g} by which elastic gears twist: are "
            'positions of motors divided by the ratios of their gears? The stiffness of joints '
            'was not computed'
        )
        return
    notes = {
        ': motors and links have the same positions, as where a robot has one encoder and '
        'reports it twice': compliance.largest == 0.0,
        ' twist against their torques: are the positions of motors (theta) and links (q) '
        'exchanged?': compliance.is_negative,
        ' twist so exactly by their torques that the robot computes one position from the '
        'other: their stiffness is the one that it assumes': compliance.is_computed,
    }
    for what, which in notes.items():
        if which.any():
            yield ', '.join(names[which]) + what
