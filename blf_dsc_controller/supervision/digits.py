# SPDX-License-Identifier: Apache-2.0
"""Numbers of messages."""

from __future__ import annotations


def two_digits(value: float) -> str:
    """Return a number with two digits, without an exponent."""
    return f'{float(f"{value:.2g}"):g}'
