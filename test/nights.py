# SPDX-License-Identifier: Apache-2.0
"""Cases of a test that `make test` leaves out, for `pytest.mark.parametrize`."""

import pytest


def at_night(*cases):
    """Return cases, tuples of several arguments or one argument each, for the night only."""
    return [
        pytest.param(
            *(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.nightly
        )
        for case in cases
    ]


def one_by_day(of, cases):
    """Return one in `of` cases, the first among them, for every run, and the others by night."""
    cases = [*cases]
    others = (case for k, case in enumerate(cases) if k % of)
    return [*cases[::of], *at_night(*others)]
