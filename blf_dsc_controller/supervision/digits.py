# SPDX-License-Identifier: Apache-2.0
"""Numbers in sentences: with two digits and never an exponent, so 120 and not 1.2e+02."""

from __future__ import annotations

from collections.abc import Sequence

from blf_dsc_controller.run import Floats, JointUnits


def two_digits(value: float) -> str:
    """Return a number with two digits, without an exponent."""
    return f'{float(f"{value:.2g}"):g}'


def largest_error(errors: Floats, units: Sequence[JointUnits]) -> str:
    """Return the largest of errors (n,) [rad or m] with its unit, mrad or mm."""
    worst = int(errors.argmax())
    return f'{two_digits(1e3 * errors[worst])} {units[worst].of("mrad")}'
