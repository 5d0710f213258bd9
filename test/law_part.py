# SPDX-License-Identifier: Apache-2.0
"""A part of the law on its own: its state or scratch, for a few joints."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace
from typing import Any, TypeVar

import numpy as np

from blf_dsc_controller.compiled.layout import size_of, view_of

T = TypeVar('T')

_view_of, _size_of = cache(view_of), cache(size_of)  # each makes a function


def part(layout: type[T], **sizes: Any) -> T:
    """Return an empty state or scratch; `sizes` are n, m, and settings of other parts."""
    given = SimpleNamespace(**sizes)
    empty: T = _view_of(layout)(np.zeros(_size_of(layout)(given)), given)
    return empty
