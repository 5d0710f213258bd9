# SPDX-License-Identifier: Apache-2.0
"""A URDF with corrected inertias and friction; every other byte is unchanged.

The inertia of a body is written to the link that its joint moves, and the links fixed
to that link lose theirs.  Links with joints of their own, such as a gripper's fingers,
keep theirs.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from itertools import combinations_with_replacement
from xml.parsers import expat

import numpy as np

from blf_dsc_controller.arms.inertia import moved, pseudo_inertia, rotational_inertia
from blf_dsc_controller.arms.urdf import Chain
from blf_dsc_controller.run import Floats


def corrected_urdf(
    text: str,
    chain: Chain,
    inertias: Floats,
    viscous: Floats,
    coulomb: Floats,
    note: str,
) -> str:
    """Return the URDF with inertias (n, 10) of the bodies and friction (n,) of the joints.

    `note` is added as a comment at the end.
    """
    parts: dict[tuple[str, str], str] = {}  # of links and joints by name
    for joint, inertia, damping, friction in zip(
        chain.joints, inertias, viscous, coulomb, strict=True
    ):
        parts |= {('link', name): '' for name in joint.fixed}
        parts['link', joint.link] = _inertial(pseudo_inertia(inertia) - joint.held)
        numbers = f'damping="{damping:.12g}" friction="{friction:.12g}"'
        parts['joint', joint.name] = f'<dynamics {numbers} />'
    raw = text.encode()
    for begin, end, part in sorted(_edits(raw, parts, note), reverse=True):
        raw = raw[:begin] + part.encode() + raw[end:]
    return raw.decode()


def _inertial(J: Floats) -> str:
    """Return the `<inertial>` of a pseudo-inertia (4, 4), about the centre of mass in link axes."""
    mass = J[3, 3]
    centre = J[:3, 3] / mass
    T = np.eye(4)
    T[:3, 3] = -centre
    I = rotational_inertia(moved(J, T))
    tensor = ' '.join(
        f'i{"xyz"[a]}{"xyz"[b]}="{I[a, b]:.12g}"'
        for a, b in combinations_with_replacement(range(3), 2)
    )
    xyz = ' '.join(f'{x:.12g}' for x in centre)
    return (
        f'<inertial>\n      <origin xyz="{xyz}" rpy="0 0 0" />\n'
        f'      <mass value="{mass:.12g}" />\n      <inertia {tensor} />\n    </inertial>'
    )


_TAG = re.compile(rb'<(?:[^>"\']|"[^"]*"|\'[^\']*\')*>')
_PART = {'link': 'inertial', 'joint': 'dynamics'}
_Element = tuple[slice, slice]
"""Bytes of the opening and the closing tag of an element; equal if it has only one."""


def _edits(
    raw: bytes, parts: Mapping[tuple[str, str], str], note: str
) -> Iterator[tuple[int, int, str]]:
    """Yield begin and end byte of each edit, and the replacement."""
    elements = _elements(raw)
    for (kind, name), part in parts.items():
        old = elements.get((kind, name, _PART[kind]))
        opening, closing = elements[kind, name, '']
        if old is not None:
            yield old[0].start, old[1].stop, part
        elif part and opening == closing:
            yield opening.stop - 2, opening.stop, f'>\n    {part}\n  </{kind}>'
        elif part:
            yield closing.start, closing.start, f'  {part}\n  '
    end = elements['robot', '', ''][1].start
    yield end, end, f'<!--\n{note.replace("--", "- -")}\n-->\n'


def _elements(raw: bytes) -> dict[tuple[str, str, str], _Element]:
    """Return the elements of a URDF by tag and name of a link or joint, and tag of its child."""
    found: dict[tuple[str, str, str], _Element] = {}
    stack: list[tuple[str, str, slice]] = []
    parser = expat.ParserCreate('utf-8')

    def begin(tag: str, attributes: dict[str, str]) -> None:
        at = parser.CurrentByteIndex
        match = _TAG.match(raw, at)
        name = attributes.get('name', '') if stack else ''
        stack.append((tag, name, slice(at, match.end() if match else at)))

    def end(_: str) -> None:
        at = parser.CurrentByteIndex
        tag, name, opening = stack.pop()
        closing = opening if at == opening.stop else slice(at, raw.index(b'>', at) + 1)
        if len(stack) < 2:
            found[tag, name, ''] = opening, closing
        elif len(stack) == 2:
            found[stack[1][0], stack[1][1], tag] = opening, closing

    parser.StartElementHandler = begin
    parser.EndElementHandler = end
    parser.Parse(raw, True)  # noqa: FBT003 - positional only
    return found
