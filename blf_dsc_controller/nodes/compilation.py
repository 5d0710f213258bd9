# SPDX-License-Identifier: Apache-2.0
"""Saying that the kernels are being compiled, before a wait that would look like a fault."""

from __future__ import annotations

from blf_dsc_controller.core.controller import respond
from blf_dsc_controller.core.kernel import is_compiled
from sim_plant import plant

CONTROLLER = (respond,)
PLANT = (plant.observe, plant.step, plant.truth)

NOTICE = 'compiling the kernels, once for this version: this takes 10 to 60 s'
"""What to say."""

__all__ = ['CONTROLLER', 'NOTICE', 'PLANT', 'is_compiled']
