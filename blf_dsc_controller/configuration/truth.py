# SPDX-License-Identifier: Apache-2.0
"""Deviations of the simulated arm and its drives from the URDF, unknown to the controller."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from blf_dsc_controller.configuration.schema import parameter

_fixed = partial(parameter, read_only='the plant is built once, when the node starts')


@dataclass(frozen=True)
class Deviation:
    """Deviations of masses from those of the URDF.

    A changed body stays physically consistent: its mass distribution is only scaled and shifted.
    """

    mass_factor: float = _fixed(1.0, 'factor on all masses and inertias', above=0.0)
    mass_deviation: float = _fixed(
        0.0, 'largest random deviation of each mass, as a fraction', at_least=0.0, below=1.0
    )
    centre_deviation: float = _fixed(
        0.0, 'largest random deviation of each centre of mass, along each axis', 'm', at_least=0.0
    )
    seed: int = _fixed(0, 'seed of the random deviations', at_least=0)

    def changes(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the factor on the mass (n,) and the shift of mass (n, 3) [m] of each body."""
        random = np.random.Generator(np.random.PCG64(np.random.SeedSequence(self.seed)))
        drawn = random.uniform(-1.0, 1.0, (n, 4))
        factors = self.mass_factor * (1.0 + self.mass_deviation * drawn[:, 0])
        return factors, self.centre_deviation * drawn[:, 1:]


@dataclass(frozen=True)
class Truth(Deviation):
    """Deviations of the true arm from its URDF."""

    rotor_factor: float = _fixed(1.0, 'factor on the inertias of the drives', at_least=0.0)
