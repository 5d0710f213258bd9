# SPDX-License-Identifier: Apache-2.0
"""Texts on the page: what touches the arm, the numbers of a moment, and the events."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from blf_dsc_controller.analysis.panels import ALARM
from blf_dsc_controller.arms.urdf import Joint
from blf_dsc_controller.messages.named_values import load_text
from blf_dsc_controller.run import joint_units
from blf_dsc_controller.view.snapshot import Snapshot


def contact_of(joints: Sequence[Joint], now: Snapshot) -> str:
    """Return the external torque of a contact, and how much of it is none; empty without one."""
    k = now.felt_at
    if k is None:
        return ''
    unit = joint_units(joints[k].kind).torque
    return (
        f'external torque on {joints[k].name}: {now.external[k]:+.3g} {unit}, of which model '
        f'error and noise explain at most {now.interval[k]:.2g} {unit}'
    )


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
