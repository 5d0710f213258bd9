# SPDX-License-Identifier: Apache-2.0
"""The proof of commissioned gains: raised in three steps, along the arm's own reference.

Half of the gains first, then three quarters, with bounds that soft gains keep; then all of
them, with the configured bounds.  An oscillation ends it, whatever the file says.  The errors of
the last step are compared with those that the linear loop lets expect.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.analysis.recorded import read_run
from blf_dsc_controller.commissioning.chosen import as_parameters, with_gains
from blf_dsc_controller.commissioning.run_parameters import undisturbed_parameters
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import Value, change
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.factory.settings import settings_of_config
from blf_dsc_controller.reference.approach import reference_of
from blf_dsc_controller.reference.terms import sampled
from blf_dsc_controller.warnings.expected_errors import expected_errors

Floats = NDArray[np.float64]

SHARES = (0.5, 0.75, 1.0)
"""Of the gains, step by step."""

_SHORT, _LAST = 5.0, 15.0  # s


def name_of(share: float) -> str:
    """Return the name of a step with a share of the gains."""
    return f'{share:.0%} of the gains'


def seconds() -> float:
    """Return how long all steps take [s]."""
    return (len(SHARES) - 1) * _SHORT + _LAST


class Step(NamedTuple):
    """A run with a share of the gains."""

    share: float
    config: ControllerConfig
    duration: float  # s

    @property
    def name(self) -> str:
        """Name of the run, and of its bag."""
        return name_of(self.share)


class Errors(NamedTuple):
    """Largest errors (n,) [rad] of a run, and those to expect."""

    measured: Floats
    expected: Floats


def steps(config: ControllerConfig) -> list[Step]:
    """Return the steps by which a commissioned configuration is proven.

    Raises BlfDscError if it has no gains of joints.
    """
    gains = config.feedback
    if not gains.joint_stiffness:
        raise BlfDscError(
            'feedback.joint_stiffness is empty: prove the file that blf_dsc commission has written'
        )
    calm: dict[str, Value] = {'safety.oscillation': 'stop'}
    soft = change(config, undisturbed_parameters(config) | calm)
    found = []
    for share in SHARES[:-1]:
        factor = share * gains.stiffness
        values = as_parameters(
            factor * np.array(gains.joint_stiffness),
            factor * np.array(gains.joint_damping),
        )
        found.append(Step(share, with_gains(soft, values), _SHORT))
    return [*found, Step(SHARES[-1], change(config, calm), _LAST)]


def start_of(config: ControllerConfig, here: Floats) -> Floats:
    """Return where the reference begins (n,) [rad]: to hold, it is where the arm is."""
    if config.reference.type == 'hold':
        return here
    return np.asarray(sampled(reference_of(config), np.zeros(1))[0, 0])


def errors_of(bag: Path, config: ControllerConfig) -> Errors:
    """Return the largest errors (n,) [rad] of a run, and those to expect along its reference.

    Raises BlfDscError if the bag has no tracking errors.
    """
    run = read_run(bag)
    if run.error is None:
        raise BlfDscError(f'{bag} has no tracking errors')
    expected = expected_errors(config, settings_of_config(config))
    return Errors(np.nanmax(np.abs(run.error), axis=0), expected.unmodelled)
