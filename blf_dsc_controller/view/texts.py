# SPDX-License-Identifier: Apache-2.0
"""Texts on the page: what touches the arm, the numbers of a moment, and the events."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from blf_dsc_controller.analysis.panels import ALARM
from blf_dsc_controller.messages.named_values import load_text
from blf_dsc_controller.view.snapshot import Snapshot


def contact_text(joint: str, torque: float, interval: float) -> str:
    """Return the external torque of a contact, and how much of it is no contact."""
    return (
        f'external torque on {joint}: {torque:+.3g} N m, of which model error and noise '
        f'explain at most {interval:.2g} N m'
    )


def contact_of(joints: Sequence[str], now: Snapshot) -> str:
    """Return what touches the arm; empty if nothing does."""
    k = now.felt_at
    if k is None:
        return ''
    return contact_text(joints[k], float(now.external[k]), float(now.interval[k]))


def caption(now: Snapshot, contact: str) -> str:
    """Return the caption: time, contact, tool, load and excitation."""
    tool = ''
    if np.isfinite(now.tool[0]):
        error, bound = (1e3 * each for each in now.tool[:2])
        tool = f', tool {error:.2f} of {bound:.2f} mm'
    held = f', held: {load_text(now.load)}' if np.isfinite(now.load[0]) else ''
    excited = f', lambda_min {now.lambda_min:.2g}' if now.lambda_min > 0.0 else ''
    felt = f', <b style="color:{ALARM}">{escape(contact)}</b>' if contact else ''
    return (
        f'<div style="margin:4px">t = {now.time:.2f} s{felt}{tool}{held}{excited}</div>'
    )


def event_list(events: Sequence[tuple[float, str, str]]) -> str:
    """Return the lines of events, the last one first."""
    return ''.join(
        f'<div style="margin:4px">{t:.2f} s <b>{escape(kind)}</b> {escape(text)}</div>'
        for t, kind, text in reversed(events)
    )
