# SPDX-License-Identifier: Apache-2.0
"""A law that kernels call by the addresses of its methods.

Compiled into `update`, each law makes another kernel of it, for half a minute of CPU
time.  Here the two methods of a law are kernels of their own, in a few seconds, and
`update` gets their addresses with the gains as a vector: their types are the same for
all laws, so that one `update` of each kind of arm serves them all.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numba.core import types

from blf_dsc_controller.compiled.entry import Entry, invoke
from blf_dsc_controller.compiled.jit import uncallable
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.compiled.references import referred
from blf_dsc_controller.law.interface import Law
from blf_dsc_controller.law.mistakes import tell_mistakes
from blf_dsc_controller.law.state import Settings, Signals, State


class CalledLaw(NamedTuple):
    """A law that kernels call by address: its two methods, and its gains as a vector."""

    computes: Entry
    finishes: Entry
    gains: Array

    def compute_demand(
        self, settings: Settings, state: State, signals: Signals, t: float, dt: float
    ) -> None:
        """Call `Law.compute_demand` of the law with its gains."""
        invoke(self.computes, self.gains, settings, state, signals, t, dt)

    def finish(
        self,
        settings: Settings,
        state: State,
        signals: Signals,
        dt: float,
        saturated: bool,
    ) -> None:
        """Call `Law.finish` of the law with its gains."""
        invoke(self.finishes, self.gains, settings, state, signals, dt, saturated)

    def with_gains(self, law: Law) -> CalledLaw:
        """Return the same methods with the gains of a law of the same type."""
        return self._replace(gains=_vector(law))


def is_callable(law: Law) -> bool:
    """Whether all gains of a law are numbers, as `called` needs them."""
    gains: Any = law
    return all(isinstance(gain, (bool, int, float)) for gain in gains)


def called(law: Law, settings: Settings, state: State, signals: Signals) -> CalledLaw:
    """Return a law as kernels call it, compiled for arguments of the types of these.

    Raises:
        BlfDscError: the law of a file cannot be compiled; the text says where and why.
    """
    computes, finishes = _methods(type(law), _source(law))
    arguments = _vector(law), *map(referred, (settings, state, signals))
    return CalledLaw(
        Entry(computes, *arguments, types.float64, types.float64),
        Entry(finishes, *arguments, types.float64, types.boolean),
        _vector(law),
    )


@functools.cache
def _methods(law: type, gains: str) -> list[Callable[..., None]]:
    """Return both methods of a law as kernels that take its gains as a vector."""
    names: dict[str, Any] = {'LAW': law, '__name__': __name__}
    methods = []
    for name, last_arguments in (
        ('compute_demand', 't, dt'),
        ('finish', 'dt, saturated'),
    ):
        arguments = f'settings, state, signals, {last_arguments}'
        exec(  # noqa: S102 - of the gains of a law that is loaded
            f'def {name}(gains, {arguments}):\n    LAW({gains}).{name}({arguments})\n',
            names,
        )
        method = uncallable(names[name], law)
        tell_mistakes(method, law)
        methods.append(method)
    return methods


def _source(law: Any) -> str:
    """Return the gains of a law, of the types that they have, as entries of the vector `gains`."""
    entry_of_type = {bool: 'gains[{}] != 0.0', int: 'int(gains[{}])'}
    return ', '.join(
        entry_of_type.get(type(gain), 'gains[{}]').format(k)
        for k, gain in enumerate(law)
    )


def _vector(law: Any) -> Array:
    """Return the gains of a law as numbers."""
    return np.array([*law], dtype=np.float64)
