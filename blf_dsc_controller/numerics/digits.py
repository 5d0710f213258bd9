# SPDX-License-Identifier: Apache-2.0
"""Numbers in sentences: with two digits and never an exponent, so 120 and not 1.2e+02."""

from __future__ import annotations

from collections.abc import Sequence

from blf_dsc_controller.run import Floats, JointUnits


def two_digits(value: float) -> str:
    """Return a number with two digits, without an exponent."""
    return f'{float(f"{value:.2g}"):g}'


def largest_error(
    errors: Floats, units: Sequence[JointUnits], joints: Sequence[str] = ()
) -> str:
    """Return the largest of errors (n,) [rad or m] in mrad or mm, or in each if both occur.

    With names of the joints it says whose they are.
    """
    told = []
    for kind in dict.fromkeys(units):
        worst = max(
            (i for i, each in enumerate(units) if each == kind), key=errors.__getitem__
        )
        owner = f' of {joints[worst]}' if joints else ''
        told.append(f'{two_digits(1e3 * errors[worst])} {kind.of("mrad")}{owner}')
    return ' and '.join(told)
