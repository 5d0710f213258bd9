# SPDX-License-Identifier: Apache-2.0
"""Numbers in sentences: with two digits and never an exponent, so 120 and not 1.2e+02."""

from __future__ import annotations


def two_digits(value: float) -> str:
    """Return a number with two digits, without an exponent."""
    return f'{float(f"{value:.2g}"):g}'
