# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc identify`: a bag and a URDF in, the corrected URDF and a table of its changes out."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterator

import numpy as np

from blf_dsc_controller.bags.content import NameMap
from blf_dsc_controller.cli.output import make_room
from blf_dsc_controller.configuration.robot import Robot
from blf_dsc_controller.identification.corrected_urdf import corrected_urdf
from blf_dsc_controller.identification.identify import Identified, identify_bag
from blf_dsc_controller.identification.prior import JOINT_TERMS, columns_of

_TWO_SIDED = 1.96  # standard deviations of a 95 % interval
_UNSEEN = 0.5  # of the prior's variance; parameters that keep more are not shown
_POOR = 0.2  # of the torque, largest accepted error on the part held back


def identify(options: Namespace) -> None:
    """Identify the arm, print what changed and write the corrected URDF."""
    make_room(options.out, force=options.force)
    robot = Robot(
        urdf=options.urdf,
        base=options.base,
        tip=options.tip,
        gravity=tuple(options.gravity),
        payload=options.payload,
    )
    found = identify_bag(options.bag, robot, options.namespace, NameMap.parse(options.map))
    header = [f'{found.source}, {found.duration:.1f} s of {len(found.chain.joints)} joints']
    kept = [*_joints(found), *_errors(found)]
    print('\n'.join([*header, *_links(found), *_base(found), *kept]))
    note = '\n'.join(['Inertias and friction by blf_dsc identify:', *header, *kept])
    _, viscous, coulomb, _ = found.joint_terms
    corrected = corrected_urdf(robot.text, found.chain, found.inertias, viscous, coulomb, note)
    options.out.write_text(corrected, encoding='utf-8')
    print(f'wrote {options.out}')


def _links(found: Identified) -> Iterator[str]:
    names = [joint.link for joint in found.chain.joints]
    width = max(map(len, names))
    yield ''
    yield f'{"body":{width}}  mass [kg]                     centre of mass [mm]'
    variance = np.diag(found.covariance)
    for i, (name, joint) in enumerate(zip(names, found.chain.joints, strict=True)):
        at = 10 * i
        m = found.values[at]
        # c = h / m:  dc = (dh - c dm) / m
        c = found.values[at + 1 : at + 4] / m
        D = np.column_stack((-c, np.eye(3))) / m
        spread = np.diag(D @ found.covariance[at : at + 4, at : at + 4] @ D.T)
        before = joint.inertia[1:4] / joint.inertia[0]
        centre = ', '.join(
            f'{1e3 * a:.1f} -> {1e3 * b:.1f} +- {1e3 * s:.2g}'
            for a, b, s in zip(before, c, _TWO_SIDED * np.sqrt(spread), strict=True)
        )
        mass = f'{joint.inertia[0]:.3f} -> {m:.3f} +- {_TWO_SIDED * np.sqrt(variance[at]):.2g}'
        yield f'{name:{width}}  {mass:28}  {centre}'


def _joints(found: Identified) -> Iterator[str]:
    n = len(found.chain.joints)
    names = [joint.name for joint in found.chain.joints]
    width = max(map(len, names))
    spread = _TWO_SIDED * np.sqrt(np.diag(found.covariance)[10 * n : -1].reshape(-1, n))
    yield ''
    yield f'{"joint":{width}}' + ''.join(f'  {term:24}' for term in JOINT_TERMS).rstrip()
    for i, name in enumerate(names):
        terms = (
            f'{value:.4g} +- {s:.2g}'
            for value, s in zip(found.joint_terms[:, i], spread[:, i], strict=True)
        )
        yield f'{name:{width}}' + ''.join(f'  {term:24}' for term in terms).rstrip()
    delay, s = found.values[-1], _TWO_SIDED * np.sqrt(found.covariance[-1, -1])
    yield f'delay of the torques relative to the positions: {1e3 * delay:.2f} +- {1e3 * s:.2g} ms'


def _base(found: Identified) -> Iterator[str]:
    P = found.parameters
    n = len(found.chain.joints)
    K = columns_of(P, n)[: len(P.combinations)]
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
    share = 100.0 * found.errors / found.torque
    total = 100.0 * np.sqrt(np.sum(found.errors**2, axis=1) / np.sum(found.torque**2))
    width = max(len(joint.name) for joint in found.chain.joints)
    yield f'{"joint":{width}}      URDF  corrected  with rotors and offsets'
    for joint, (before, after, full) in zip(found.chain.joints, share.T, strict=True):
        yield f'{joint.name:{width}}  {before:8.2f}  {after:9.2f}  {full:8.2f}'
    yield f'{"all":{width}}  {total[0]:8.2f}  {total[1]:9.2f}  {total[2]:8.2f}'
    for name in found.still:
        yield f'{name} did not move: its rotor and friction are guesses'
    if total[2] > min(100.0 * _POOR, total[0]):
        yield (
            'DO NOT USE this URDF: it does not explain the torques held back. Are the efforts in '
            'N m (not currents) and do they include gravity, is --gravity given in the base '
            'frame, and was the load the same throughout?'
        )
