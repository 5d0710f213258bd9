# SPDX-License-Identifier: Apache-2.0
"""How a running loop is doing, in one line."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from tqdm import tqdm

from sim_plant import arm
from sim_plant.configuration import PlantConfig

_FORMAT = '{desc} |{bar}| {n:.1f}/{total:.1f} s [{elapsed}<{remaining}]{postfix}'


class Progress:
    """Progress bar over simulated time, with the largest |xi1| / k_c and the parameter error.

    Args:
        config: of the plant, whose true parameters the estimates are held against.
    """

    def __init__(self, config: PlantConfig) -> None:
        self._truth = np.zeros(3)
        lengths = (config.arm.l1, config.arm.l2)
        masses = (config.arm.m1, config.arm.m2)
        arm.parameters(arm.Arm(*lengths, *masses, config.arm.gravity), self._truth)
        self._bar = tqdm(
            total=config.duration or None,
            desc='closed loop',
            bar_format=_FORMAT if config.duration else None,
            mininterval=0.2,
        )

    def show(self, elapsed: float, ratio: float, estimate: ArrayLike) -> None:
        """Show the simulated time [s], the largest |xi1| / k_c so far, and P^ (3,)."""
        error = np.linalg.norm(np.asarray(estimate) - self._truth) / np.linalg.norm(self._truth)
        self._bar.set_postfix_str(
            f'max|xi1|/bound {ratio:.2f}, parameter error {100 * error:.2f} %', refresh=False
        )
        self._bar.update(min(elapsed, self._bar.total or elapsed) - self._bar.n)

    def close(self) -> None:
        """Leave the bar as it is."""
        self._bar.close()
