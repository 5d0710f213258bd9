# SPDX-License-Identifier: Apache-2.0
"""The run of a motion, with the configuration that it had."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.bags.content import read_content
from blf_dsc_controller.bags.reader import recorded_run
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.run import Run


class Measured(NamedTuple):
    """The run of a motion, with the configuration that it had."""

    run: Run
    config: ControllerConfig


def measured_in(bag: str | Path) -> Measured:
    """Return what a bag has.

    Raises BagError if it cannot be read, or has no configuration.
    """
    content = read_content(Path(bag))
    return Measured(recorded_run(content, np.asarray), content.controller_config())
