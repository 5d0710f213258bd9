# SPDX-License-Identifier: Apache-2.0
"""The message about joints that swing under the damping of a stop."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


class SwingNames:
    """Names each joint that swings once in a stop."""

    def __init__(self, joints: Sequence[str]) -> None:
        self._joints = joints
        self._named = np.zeros(len(joints), dtype=np.bool_)

    def begin(self) -> None:
        """Begin a stop."""
        self._named[:] = False

    def name(self, has_swung: NDArray[np.bool_]) -> str:
        """Name those joints (n,) that are not named yet, in a text; empty: all are.

        Only the first text of a stop says what that means: the others follow it.
        """
        new = has_swung & ~self._named
        if not new.any():
            return ''
        is_first = not self._named.any()
        self._named |= new
        names = [
            repr(name) for name, is_new in zip(self._joints, new, strict=True) if is_new
        ]
        what = (
            f'joints {", ".join(names)} swing'
            if len(names) > 1
            else f'joint {names[0]} swings'
        )
        if not is_first:
            return f'{what}, too'
        return (
            f'{what} under the damping of the stop, which is taken down there: is a motor lighter '
            'than robot.rotor_inertia, or a torque later than robot.lag?'
        )
