# SPDX-License-Identifier: Apache-2.0
"""What other parameters ask of a law: its gains, whether it keeps the bound, and learns."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

from blf_dsc_controller.configuration import law_file
from blf_dsc_controller.configuration.schema import format_value, suggestion
from blf_dsc_controller.errors import BlfDscError


class Traits(NamedTuple):
    """What a law does."""

    has_barrier: bool  # it keeps the error inside the bound
    learns: bool  # its estimate is that of latched windows (`law.learning`)


OWN = 'blf_dsc'
"""The law of the package: gains follow from an arm for it."""

PAPER = 'paper'
"""The same as printed, with the same feedback."""

LAWS = (OWN, *law_file.PACKAGED)
"""Laws that are found by their name; the first is the default."""


def traits_of(name: str, gains: Any) -> Traits:
    """Return what a law does; that of a file, which has a group of gains, says so itself."""
    if not law_file.has_file(name):
        return Traits(has_barrier=True, learns=True)
    law = law_file.load_law(name)(**dataclasses.asdict(gains))
    return Traits(bool(law.has_barrier), bool(getattr(law, 'learns', False)))


def has_exact_rows(given: Mapping[str, Any]) -> bool:
    """Whether the rows that are learned from hold in any motion, by given parameters.

    Loads and contacts show in such rows only; the paper's (24) are not.
    """
    return bool(given.get('law', OWN) != PAPER)


def gains_of(law: str) -> type | None:
    """Return the group of the gains that only this law has; None: it has none.

    Raises BlfDscError if there is no such law.
    """
    if law == OWN:
        return None
    if law_file.has_file(law):
        return law_file.gains_of(law_file.load_law(law))
    raise BlfDscError(
        f'law: got {format_value(law)}, but expected one of {", ".join(LAWS)}, or a '
        f'Python file{suggestion(law, LAWS)}'
    )
