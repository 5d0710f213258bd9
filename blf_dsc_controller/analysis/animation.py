# SPDX-License-Identifier: Apache-2.0
"""The moving arm, as data for the page's animation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from blf_dsc_controller.analysis.panels import colour
from blf_dsc_controller.analysis.subject import Subject

_RATE = 50.0  # pictures a second
_MOST = 6000  # pictures
_DIGITS = 4


def animation(subjects: Sequence[Subject]) -> list[dict[str, Any]]:
    """Angles and link lengths of each arm, at a rate that the eye can follow.

    Joint 1 is measured from the horizontal, each further joint from the link before it. Lengths
    that the bag does not tell are those of the first link.
    """
    return [_arm(one, colour(k)) for k, one in enumerate(subjects)]


def _arm(subject: Subject, shade: str) -> dict[str, Any]:
    run = subject.run
    pictures = int(min(_MOST, max(2.0, run.duration * _RATE)))
    times = np.linspace(0.0, run.duration, pictures)
    rows = np.minimum(np.searchsorted(run.time, times), run.time.size - 1)
    reference = run.reference if run.reference is not None else np.empty((0, len(run.joints)))
    return {
        'name': subject.name,
        'colour': shade,
        'lengths': lengths(subject),
        'time': times.round(_DIGITS).tolist(),
        'angles': np.nan_to_num(run.position[rows]).round(_DIGITS).tolist(),
        'reference': np.nan_to_num(reference[rows] if reference.size else reference)
        .round(_DIGITS)
        .tolist(),
    }


def lengths(subject: Subject) -> list[float]:
    """Length of each link [m]."""
    told: dict[str, float] = {}
    for section in subject.sections:
        for name in ('arm.l1', 'arm.l2'):
            if name in section.entries:
                told[name] = float(str(section.entries[name].value))
    first = told.get('arm.l1', 1.0)
    rest = [told.get(f'arm.l{i}', first) for i in range(2, len(subject.run.joints) + 1)]
    return [first, *rest]
