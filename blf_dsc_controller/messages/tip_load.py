# SPDX-License-Identifier: Apache-2.0
"""What the tip of an arm holds, as somebody says it: to drives, or to the law."""

from __future__ import annotations

from math import inf
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.errors import BlfDscError

TAKEN_UP = 0.05
"""Time [s] in which a tip takes up a load, if nothing else is said."""


class TipLoad(NamedTuple):
    """A load in the frame of the tip."""

    mass: float  # kg
    centre: tuple[float, ...]  # (3,) m

    @property
    def moments(self) -> NDArray[np.float64]:
        """Mass and first moments (4,) [kg, kg m]."""
        return self.mass * np.array((1.0, *self.centre))

    @classmethod
    def of(cls, moments: NDArray[np.float64]) -> TipLoad:
        """Return the load with these mass and first moments."""
        mass = float(moments[0])
        if mass <= 0.0:
            return cls(0.0, (0.0, 0.0, 0.0))
        return cls(mass, tuple((moments[1:] / mass).tolist()))

    @classmethod
    def given(cls, mass: Any, centre: Any) -> TipLoad:
        """Return the load that somebody gives as arguments.

        Raises:
            BlfDscError: it is no load.
        """
        try:
            m, c = float(mass), np.asarray(centre, float)
        except (TypeError, ValueError):
            m, c = -1.0, np.zeros(0)
        if not 0.0 <= m < inf or c.shape != (3,) or not np.isfinite(c).all():
            raise BlfDscError(
                f'load: got {mass!r} kg at {centre!r} m, but a mass of at least 0 and three '
                'coordinates are needed'
            )
        return cls(m, tuple(c.tolist()))
