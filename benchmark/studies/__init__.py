# SPDX-License-Identifier: Apache-2.0
"""Studies of random arms behind the tables, as files of `blf_dsc monte-carlo`."""

from __future__ import annotations

from pathlib import Path

from blf_dsc_controller.studies import monte_carlo

FREE = 0.3
"""Bound [rad] that no law leaves unless its arm oscillates."""


def path_of(name: str) -> Path:
    """Return the file of a study."""
    return Path(__file__).with_name(f'{name}.yaml')


def load_study(name: str) -> monte_carlo.Study:
    """Read a study."""
    return monte_carlo.load_study(path_of(name))
