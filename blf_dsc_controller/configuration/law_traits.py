# SPDX-License-Identifier: Apache-2.0
"""What other parameters ask of a law: whether it keeps the bound, and whether it learns."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

from blf_dsc_controller.configuration import law_file
from blf_dsc_controller.configuration.checked import Checked


class Traits(NamedTuple):
    """What a law does."""

    has_barrier: bool  # it keeps the error inside the bound
    learns: bool  # its estimate is that of latched windows (`law.learning`)


_PACKAGED = {
    'blf_dsc': Traits(has_barrier=True, learns=True),
    'model_based': Traits(has_barrier=True, learns=False),
    'backstepping': Traits(has_barrier=False, learns=False),
    'slotine_li': Traits(has_barrier=False, learns=False),
}

LAWS = tuple(_PACKAGED)
"""Laws of the package; the first is the default."""


def traits_of(config: Checked) -> Traits:
    """Return what the law of a configuration does; that of a file says so itself."""
    if not law_file.is_file(config.law):
        return _PACKAGED[config.law]
    gains = dataclasses.asdict(getattr(config, law_file.GROUP))
    law = law_file.load_law(config.law)(**gains)
    return Traits(bool(law.has_barrier), bool(getattr(law, 'learns', False)))
