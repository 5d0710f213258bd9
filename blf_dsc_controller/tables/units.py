# SPDX-License-Identifier: Apache-2.0
"""Units in the names of columns: `q_1 [deg]`, `tau_1_Nmm`, `time (ms)`."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

from blf_dsc_controller.errors import BlfDscError


def _table(text: str) -> dict[str, float]:
    """Return the factors of units from lines that begin with one, and name its units."""
    lines = map(str.split, text.splitlines())
    return {unit: float(factor) for factor, *units in lines for unit in units}


_TIME = _table("""\
1 s sec secs second seconds
1e-3 ms msec millisecond milliseconds
1e-6 us usec microsecond microseconds
1e-9 ns nsec nsecs nanosec nanosecs nanosecond nanoseconds
60 min mins minute minutes
3600 h hr hour hours""")
_POSITION = _table("""\
1 rad radian radians m
1e-3 mrad mm
1e-2 cm
0.017453292519943295 deg degs degree degrees °
6.283185307179586 rev revs turn turns""")
_TORQUE = _table("""\
1 nm n
1e-3 nmm mnm
1e-2 ncm
1e3 knm kn""")
_CURRENT = _table("""\
1 a amp amps ampere arms % percent
1e-3 ma
0.1 ‰""")
# units of other quantities, or without a known size
_OTHERS = _table("""\
nan count counts tick ticks inc increments raw digits v volt gon
nan lbfin lbin ftlb lbft kgcm kgfcm ozin""")
_OF = {
    'time': _TIME,
    'q': _POSITION,
    'tau': _TORQUE | _CURRENT,
    'theta': _POSITION,
    'other': _OTHERS,
}
_EXPECTED = {
    'time': 's, ms, us, ns, min or h',
    **dict.fromkeys(('q', 'theta'), 'rad, mrad, deg, rev (or m, cm, mm)'),
    'tau': 'N m, N cm, N mm, kN m (or N, kN), or A, mA or % with --gains',
}
_BRACKETED = re.compile(r'\s*[\[({<]\s*([^\[\](){}<>]+?)\s*[\])}>]\s*$')
_INDEX = re.compile(r'[\s_\[(]*\d+[\])]?$')
_LAST_WORD = re.compile(r'[\s_]+([^\s_]+)$')
_SHORT = 2  # letters; a last word without brackets that is shorter is no unit


class Named(NamedTuple):
    """A name, and the unit at its end, as it stands there; empty if it has none."""

    stem: str
    unit: str


def split_unit(name: str, kind: str) -> Named:
    """Return the name of a column of time, q, tau or theta without its unit.

    Other words in brackets, such as `(measured)`, belong to the name.
    """
    bracketed = _BRACKETED.search(name)
    if bracketed and _is_unit(_normal(bracketed[1])):
        return Named(name[: bracketed.start()], bracketed[1])
    index = _INDEX.search(name)
    head = name[: index.start()] if index else name
    word = _LAST_WORD.search(head)
    if word and len(word[1]) >= _SHORT and _normal(word[1]) in _OF[kind]:
        return Named(head[: word.start()] + name[len(head) :], word[1])
    return Named(name, '')


def _is_unit(word: str) -> bool:
    return '/' in word or any(word in units for units in _OF.values())


def factor_of(path: Path, unit: str, kind: str) -> float:
    """Return the unit of time, q, tau or theta in s, rad (m), N m (N), A or %; empty: 1.

    Raises:
        BlfDscError: it is not known.
    """
    if not unit:
        return 1.0
    factor = _OF[kind].get(_normal(unit))
    if factor is None:
        raise BlfDscError(
            f'{path}: the unit {unit!r} of {kind} is not known; expected {_EXPECTED[kind]}: '
            'convert the values, or correct the name of the column'
        )
    return factor


def is_of_drive(unit: str) -> bool:
    """Return whether a unit of tau is that of currents, or a share of a rated torque."""
    return _normal(unit) in _CURRENT


def _normal(unit: str) -> str:
    """Return a unit in lower case, without what separates its factors."""
    return re.sub(r'[\s.·*⋅-]', '', unit.replace('µ', 'u').replace('μ', 'u')).lower()
