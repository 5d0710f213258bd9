# SPDX-License-Identifier: Apache-2.0
"""What other parameters ask of a law: its gains, whether it keeps the bound, and learns."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

from blf_dsc_controller.configuration import law_file, law_gains
from blf_dsc_controller.configuration.checked import Checked
from blf_dsc_controller.configuration.schema import format_value, suggestion
from blf_dsc_controller.errors import BlfDscError


class Traits(NamedTuple):
    """What a law does."""

    has_barrier: bool  # it keeps the error inside the bound
    learns: bool  # its estimate is that of latched windows (`law.learning`)


_PACKAGED = {
    'blf_dsc': Traits(has_barrier=True, learns=True),
    'paper': Traits(has_barrier=True, learns=True),
    'model_based': Traits(has_barrier=True, learns=False),
    'backstepping': Traits(has_barrier=False, learns=False),
    'slotine_li': Traits(has_barrier=False, learns=False),
}

LAWS = tuple(_PACKAGED)
"""Laws of the package; the first is the default."""

OWN = ('blf_dsc', 'paper')
"""Laws with the feedback and the learning of (28): gains follow from an arm for these."""

GAINS: Mapping[str, type] = {
    'paper': law_gains.Paper,
    'backstepping': law_gains.Backstepping,
    'slotine_li': law_gains.SlotineLi,
}
"""Groups of the gains that one law of the package has, by law."""


def traits_of(config: Checked) -> Traits:
    """Return what the law of a configuration does; that of a file says so itself."""
    if not law_file.is_file(config.law):
        return _PACKAGED[config.law]
    gains = dataclasses.asdict(getattr(config, law_file.GROUP))
    law = law_file.load_law(config.law)(**gains)
    return Traits(bool(law.has_barrier), bool(getattr(law, 'learns', False)))


def has_exact_rows(given: Mapping[str, Any]) -> bool:
    """Whether the rows that are learned from hold in any motion, by given parameters.

    Loads and contacts show in such rows only; the paper's (24) are not.
    """
    usual = law_gains.Paper.prediction
    prediction = given.get(f'{law_file.GROUP}.prediction', usual)
    is_paper: bool = given.get('law', LAWS[0]) == 'paper'
    return not is_paper or bool(prediction == 'filtered')


def gains_of(law: str) -> type | None:
    """Return the group of the gains that only this law has; None: it has none.

    Raises BlfDscError if there is no such law.
    """
    if law in LAWS:
        return GAINS.get(law)
    if law_file.is_file(law):
        return law_file.gains_of(law_file.load_law(law))
    raise BlfDscError(
        f'law: got {format_value(law)}, but expected one of {", ".join(LAWS)}, or a '
        f'Python file{suggestion(law, LAWS)}'
    )
