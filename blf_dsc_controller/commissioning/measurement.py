# SPDX-License-Identifier: Apache-2.0
"""The run of a motion, with the configuration that it had."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.analysis.recorded import recorded_run
from blf_dsc_controller.bags.content import read_content
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.run import Run
from blf_dsc_controller.supervision.supervisor import Reason


class Measured(NamedTuple):
    """The run of a motion, with the configuration that it had."""

    run: Run
    config: ControllerConfig


def measured_in(bag: str | Path, config: ControllerConfig | None = None) -> Measured:
    """Return what a bag has.

    Raises BagError if it cannot be read, or has no configuration; BlfDscError if it is of other
    joints than `config`.
    """
    content = read_content(bag)
    recorded = content.controller_config()
    if config is not None:
        check_joints(str(bag), recorded.joints, config)
    return Measured(recorded_run(content, np.asarray), recorded)


OSCILLATES = Reason.OSCILLATION, Reason.VELOCITY
"""Reasons of the stop of an arm that oscillates: it may be too fast before it is found."""


def oscillation_in(run: Run) -> str:
    """Return how the arm oscillated when it stopped; empty if it did not."""
    for stop in run.stops:
        if stop.reason in OSCILLATES:
            return stop.text
    return ''


@contextmanager
def named(name: str) -> Iterator[None]:
    """Let an error begin with the name of a run, if it has one."""
    try:
        yield
    except BlfDscError as error:
        if not name:
            raise
        raise BlfDscError(f'{name}: {error}') from error


def check_joints(name: str, joints: Sequence[str], config: ControllerConfig) -> None:
    """Raise BlfDscError if a run of this name is of other joints than the configuration."""
    if tuple(joints) != config.joints:
        raise BlfDscError(
            f'{name} is of the joints {", ".join(joints)}, the configuration of '
            f'{", ".join(config.joints)}: give runs and the configuration of the same arm'
        )
