# SPDX-License-Identifier: Apache-2.0
"""The newest values in messages of the topics; anybody may have sent these."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import isfinite
from typing import Any

import numpy as np

from blf_dsc_controller.analysis.report import LEVELS
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import (
    JointStateDecoder,
    joint_state_layout,
    typestore,
)
from blf_dsc_controller.messages.errors import MessageError
from blf_dsc_controller.run import Floats

LONGEST = 300
"""Characters of a text that are shown, at most."""


def state_in(raw: bytes) -> tuple[str, str]:
    """Return level and text of the controller's state; BlfDscError if there are none."""
    try:
        status: Any = typestore().deserialize_cdr(raw, topics.STATE.type)
        return LEVELS[int(status.level)], str(status.message)[:LONGEST]
    except Exception as error:  # libraries raise nearly anything
        raise BlfDscError(
            f'a message of {topics.STATE.resolved} holds no state: {error!r}'
        ) from error


def newest(
    messages: Iterable[bytes], names: Sequence[str]
) -> tuple[int, Floats] | None:
    """Return stamp [ns] and values (3, m) of the last message with any of these names.

    Missing values are NaN. None: no message has one.
    """
    for raw in reversed([*messages]):
        theirs = joint_state_layout(raw).names
        if set(theirs).isdisjoint(names):
            continue
        decoder = JointStateDecoder(theirs, ())
        stamp = decoder.decode(raw)
        known = dict(zip(theirs, decoder.values.reshape(3, -1).T, strict=True))
        values = np.transpose([known.get(name, (np.nan,) * 3) for name in names])
        return stamp, values
    return None


def check_positions(joints: Sequence[str], position: Floats) -> None:
    """Raise MessageError unless the arm can be drawn at these positions (n,)."""
    odd = [
        joint
        for joint, value in zip(joints, position.tolist(), strict=True)
        if not isfinite(value)
    ]
    if odd:
        raise MessageError(f'no position of {", ".join(odd)} in the joint states')
