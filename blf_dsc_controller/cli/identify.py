# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc excite` and `identify`: a motion that shows an arm, and the URDF that explains it."""

from __future__ import annotations

import textwrap
from argparse import Namespace
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile

import numpy as np

from blf_dsc_controller.analysis.metrics import aligned
from blf_dsc_controller.bags.content import NameMap
from blf_dsc_controller.cli.main import make_room
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import CONTROLLER, dump, load, locate
from blf_dsc_controller.configuration.robot import Robot
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.identification.corrected_urdf import corrected_urdf
from blf_dsc_controller.identification.exciting_reference import ExcitationProblem, search
from blf_dsc_controller.identification.identify import Identified, identify_bag, mass_and_centre
from blf_dsc_controller.identification.prior import JOINT_TERMS, base_matrix, parts
from blf_dsc_controller.identification.recording import HOP

_TWO_SIDED = 1.96  # standard deviations of a 95 % interval
_UNSEEN = 0.5  # of the prior's variance; parameters that keep more are not shown
_LASTING = 0.05  # of the motion, longest correlation length of noise
_POOR = 0.2  # of the torque, largest accepted error on the part held back
_LEAST_GRAVITY, _MOST_GRAVITY = 0.4, 1.6  # of the URDF's; beyond, it is missing or double
_DIGITS = 4  # decimals of an angle [rad] in the file
_WIDTH = 98
_PANEL = (9.0, 2.2)  # inches


def identify(options: Namespace) -> None:
    """Identify the arm, print what changed, and write the corrected URDF and the page."""
    if not (options.out or options.report or options.payload):
        raise BlfDscError('nothing to write: give --out, --report or --payload')
    for path in (options.out, options.report):
        if path:
            make_room(path, force=options.force)
    robot = Robot(
        urdf=options.urdf,
        base=options.base,
        tip=options.tip,
        gravity=tuple(options.gravity),
        payload=options.rated_payload,
    )
    pick_up = options.payload is True
    found = identify_bag(
        options.bag,
        robot,
        options.namespace,
        NameMap.parse(options.map),
        options.effort,
        options.gains,
        None if pick_up else options.payload,
        pick_up=pick_up,
    )
    header = [f'{found.source}, {found.duration:.1f} s of {len(found.chain.joints)} joints']
    kept = [*_load(found), *_joints(found), *_errors(found), *problems_of(found, options.effort)]
    print('\n'.join([*header, *_links(found), *_base(found), *kept]))
    if options.out:
        note = '\n'.join(['Inertias and friction by blf_dsc identify:', *header, *kept])
        bodies, (viscous, coulomb) = found.parts.bodies, found.dynamics
        corrected = corrected_urdf(robot.text, found.chain, bodies, viscous, coulomb, note)
        options.out.write_text(corrected, encoding='utf-8')
        print(f'wrote {options.out}')
    if options.report:
        tables = (_load(found), _links(found), _joints(found), _errors(found), _base(found))
        facts = [*header, *problems_of(found, options.effort)]
        _write_page(found, options.report, facts, ['\n'.join(table).strip() for table in tables])
        print(f'wrote {options.report}')


def _write_page(found: Identified, path: Path, facts: Sequence[str], tables: Sequence[str]) -> None:
    """Write the page: some facts, measured and predicted torques with their residual, tables."""
    from blf_dsc_controller.analysis.figures import draw_panels  # slow: the libraries
    from blf_dsc_controller.analysis.panels import INK, MUTED, ORANGE, Line, Mark, Panel
    from blf_dsc_controller.analysis.report import write_page

    jumps = np.flatnonzero(np.diff(found.time) > 2.0 * np.median(np.diff(found.time))) + 1
    t = np.insert(found.time, jumps, np.nan)  # breaks the lines at gaps and rest
    begin, end = found.held_back
    held_back = Mark(begin, 'held back', MUTED, until=end)
    panels = []
    for i, joint in enumerate(found.chain.joints):
        measured, predicted = found.measured[:, i], found.predicted[2, :, i]
        residual = measured - predicted
        lines = [
            Line('measured', t, np.insert(measured, jumps, np.nan)),
            Line('predicted', t, np.insert(predicted, jumps, np.nan), INK, dashed=True),
            Line('residual', t, np.insert(residual, jumps, np.nan), ORANGE),
        ]
        unit = 'N' if joint.kind == 'prismatic' else 'N m'
        panels.append(Panel('Motion', joint.name, unit, lines, marks=(held_back,)))
    with TemporaryDirectory() as folder:
        picture = Path(folder, 'torques.png')
        draw_panels(picture, 'Torques: measured, predicted, residual', panels, 1, _PANEL)
        shown = {'lines': facts, 'picture': picture, 'tables': [*filter(None, tables)]}
        write_page(path, 'identified.html', 'Identified arm', **shown)


def _interval(value: float, deviation: float, digits: str = '.4g') -> str:
    return f'{value:{digits}} +- {_TWO_SIDED * deviation:.2g}'


def _load(found: Identified) -> Iterator[str]:
    if found.picked_up is None:
        return
    (m, *centre), (m_spread, *spread) = found.load
    at = ', '.join(_interval(1e3 * c, 1e3 * s, '.1f') for c, s in zip(centre, spread, strict=True))
    yield ''
    yield (
        f'load from {found.picked_up:.1f} s on: {_interval(m, m_spread, ".3f")} kg, its '
        f'centre at {at} mm in {found.chain.tip}'
    )


def _links(found: Identified) -> Iterator[str]:
    rows = [('body', 'mass [kg]', 'centre of mass [mm]')]
    for i, joint in enumerate(found.chain.joints):
        at = slice(10 * i, 10 * i + 4)
        (m, *c), (m_spread, *spread) = mass_and_centre(
            found.values[at], found.covariance[at, at], np.eye(4)
        )
        before = joint.inertia[1:4] / joint.inertia[0]
        centre = ', '.join(
            f'{1e3 * old:.1f} -> {_interval(1e3 * new, 1e3 * s, ".1f")}'
            for old, new, s in zip(before, c, spread, strict=True)
        )
        mass = f'{joint.inertia[0]:.3f} -> {_interval(m, m_spread, ".3f")}'
        rows.append((joint.link, mass, centre))
    yield from ('', aligned(rows))


def _joints(found: Identified) -> Iterator[str]:
    names = [joint.name for joint in found.chain.joints]
    of, spread = found.parts, parts(np.sqrt(np.diag(found.covariance)))
    shown = np.flatnonzero(of.terms.any(axis=1))
    rows = [('joint', *(JOINT_TERMS[k] for k in shown))]
    for name, *each in zip(names, of.terms[shown].T, spread.terms[shown].T, strict=True):
        values = zip(*each, strict=True)
        rows.append((name, *(_interval(v, s) if v else '' for v, s in values)))
    yield from ('', aligned(rows))
    if of.coupling.any():
        inertia, viscous, coulomb = map(_interval, of.coupling, spread.coupling)
        yield (
            f'one motor drives {names[-2]} and {names[-1]}: inertia {inertia} kg m^2, viscous '
            f'friction {viscous} and Coulomb friction {coulomb} act on both'
        )
    delay = _interval(1e3 * of.delay[0], 1e3 * spread.delay[0], '.2f')
    yield f'delay of the torques relative to the positions: {delay} ms'


def _base(found: Identified) -> Iterator[str]:
    P = found.parameters
    K = base_matrix(P, len(found.chain.joints))[: len(P.combinations)]
    before, after = K @ found.prior, K @ found.values
    prior, posterior = (
        np.einsum('ia,ab,ib->i', K, C, K) for C in (found.prior_covariance, found.covariance)
    )
    yield ''
    yield 'base parameters (all that torques can show), in kg, kg m, kg m^2:'
    unseen = posterior > _UNSEEN * prior
    for k, name in enumerate(P.combinations):
        mark = '  NOT SHOWN by this bag: from the URDF' if unseen[k] else ''
        value = f'{before[k]:10.4g} -> {after[k]:10.4g} +- {_TWO_SIDED * posterior[k] ** 0.5:<8.2g}'
        yield f'{value}  {name}{mark}'


def _errors(found: Identified) -> Iterator[str]:
    begin, end = found.held_back
    yield ''
    yield f'torque error from {begin:.1f} to {end:.1f} s, which was held back [% of rms torque]:'
    names = [joint.name for joint in found.chain.joints]
    shares = np.vstack(((100.0 * found.errors / found.torque).T, total_errors(found)))
    rows = [['joint', 'URDF', 'corrected', 'with all terms']]
    for name, share in zip((*names, 'all'), shares, strict=True):
        rows.append([name, *(f'{x:.2f}' for x in share)])
    yield aligned(rows)
    if found.rest:
        yield f'{found.rest:.1f} s in which no joint moves were left out'
    moving = found.time.size * HOP
    for name, seconds in zip(names, found.lasting, strict=True):
        if seconds > _LASTING * moving:
            yield (
                f'the residual of {name} lasts ({seconds:.2g} s): it is a torque, not noise, '
                'and may have shifted values beyond their intervals'
            )
    for name in found.still:
        yield f'{name} did not move: its rotor and friction are guesses'


def total_errors(found: Identified) -> np.ndarray:
    """Return the torque errors (3,) of URDF, corrected URDF and all terms [% of rms torque]."""
    total = np.sum(found.errors**2, axis=1) / np.sum(found.torque**2)
    return np.asarray(100.0 * np.sqrt(total))


def problems_of(found: Identified, effort: str) -> Iterator[str]:
    """Yield why the result should not be used."""
    if found.gravity < _LEAST_GRAVITY:
        yield (
            f"GRAVITY IS MISSING: the efforts contain {found.gravity:.2f} of the URDF's. If the "
            'drives compensate it, give --effort without-gravity; if the arm is not mounted '
            'upright, --gravity'
        )
    elif found.gravity > _MOST_GRAVITY:
        cause = (
            'The efforts are the whole torque: give --effort torque'
            if effort == 'without-gravity'
            else 'Are the masses of the URDF far too small, or is it without its tool?'
        )
        yield f"GRAVITY IS DOUBLE: the efforts contain {found.gravity:.2f} of the URDF's. {cause}"
    total = total_errors(found)
    if total[2] > min(100.0 * _POOR, total[0]):
        yield (
            'DO NOT USE this URDF: it does not explain the torques held back. Are the efforts in '
            'N m (currents need --gains), is --gravity given in the base frame, and was the load '
            'the same throughout?'
        )


def excite(options: Namespace) -> None:
    """Search for the reference, and write it as a preset."""
    make_room(options.out, force=options.force)
    TemporaryFile(dir=options.out.parent).close()  # what cannot be written is said at once
    config = load(locate(options.config), CONTROLLER, ControllerConfig)
    if config.model != 'urdf':
        raise BlfDscError(f'{options.config}: got model {config.model}, but a URDF is needed')
    problem = ExcitationProblem(config, options.harmonics, options.radius, options.floor)
    parameters = problem.parameters(search(problem, 0, options.starts))
    for name in ('offset', 'amplitude'):
        parameters[name] = tuple(round(value, _DIGITS) for value in parameters[name])
    before = problem.evaluate({name: getattr(config.reference, name) for name in parameters})
    after = problem.evaluate(parameters)
    about = (
        'The reference that excites the learning most within the limits of joints and torque: a '
        f'window leaves {100.0 * after.left:.0f} % of the deviation of the prior, in the geometric '
        f'mean over all directions, instead of {100.0 * before.left:.0f} % with the configured '
        'reference. First the cosines, then the sines.'
    )
    lines = [*textwrap.wrap(about, _WIDTH), options.line]
    reference = {f'reference.{name}': value for name, value in parameters.items()}
    node = {f'**/{CONTROLLER}': {'reference.type': 'sinusoids', **reference}}
    dump(options.out, node, ''.join(f'# {line}\n' for line in lines))
    print('\n'.join([*lines, f'wrote {options.out}']))
