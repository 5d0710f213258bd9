# SPDX-License-Identifier: Apache-2.0
"""How the simulated arm differs from its URDF: what the controller must not take for granted."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from blf_dsc_controller.configuration.schema import parameter

_fixed = partial(parameter, read_only='the plant is built once, when the node starts')


@dataclass(frozen=True)
class Truth:
    """Masses as they are, of an arm whose URDF says otherwise.

    A changed body is always possible: its mass distribution is scaled and shifted as it is.
    """

    mass_factor: float = _fixed(1.0, 'factor on all masses and inertias', above=0.0)
    rotor_factor: float = _fixed(1.0, 'factor on the inertias of the drives', at_least=0.0)
    mass_deviation: float = _fixed(
        0.0, 'largest random deviation of each mass, as a fraction', at_least=0.0, below=1.0
    )
    centre_deviation: float = _fixed(
        0.0, 'largest random deviation of each centre of mass, along each axis', 'm', at_least=0.0
    )
    seed: int = _fixed(0, 'seed of the random deviations', at_least=0)

    def changes(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        """Of each body: the factor on its mass (n,), and the shift of its masses (n, 3) [m]."""
        random = np.random.Generator(np.random.PCG64(np.random.SeedSequence(self.seed)))
        drawn = random.uniform(-1.0, 1.0, (n, 4))
        factors = self.mass_factor * (1.0 + self.mass_deviation * drawn[:, 0])
        return factors, self.centre_deviation * drawn[:, 1:]
