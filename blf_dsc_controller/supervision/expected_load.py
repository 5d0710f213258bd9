# SPDX-License-Identifier: Apache-2.0
"""A load that is announced before the arm can estimate it: a gripper closes, or a box comes again.

The mean of the prior then has the load at once, and the estimate within the interval in which
the tip takes it up.  Learning corrects what is wrong with it.  It is as if `robot` had been
described with that load, except for the gains, which a wrong announcement must not make too
stiff.
"""

from __future__ import annotations

from numbers import Real

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.base_parameters import payload_inertia
from blf_dsc_controller.arms.inertia import moved
from blf_dsc_controller.arms.model import regressors_at
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.factory.estimate import tip_parameters
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.payload import DEVIATION, MASS
from blf_dsc_controller.messages.tip_load import TipLoad
from blf_dsc_controller.numerics.intervals import TWO_SIDED
from blf_dsc_controller.supervision.drive_load import widest_interval

Vector = NDArray[np.float64]

LONGEST = 10.0
"""Longest time [s] in which a tip takes up a load."""

NOTHING = TipLoad(0.0, (0.0, 0.0, 0.0))


class ExpectedLoad:
    """What the law of an arm expects its tip to hold, besides what it held at the start.

    Attributes:
        load: what is expected now.
        estimated: the last payload estimate that was certain enough; None: none yet.
    """

    def __init__(self, config: ControllerConfig, controller: Controller) -> None:
        self.load = NOTHING
        self.estimated: TipLoad | None = None
        self._config, self._controller = config, controller
        # P^ (p,) when the tip last held nothing that was expected
        self._empty = np.zeros(0)
        self._step = np.zeros(0)  # of P^, in a sample
        self._steps = 0  # that are left
        self._last_mass = 0.0  # kg, the last estimate of the mass, certain or not

    def expect(self, load: TipLoad | None, interval: float, q: Vector) -> TipLoad:
        """Expect this load, which the tip takes up within an `interval` [s], at q (n,) [rad].

        None: the last estimated load.  Return the load that is expected.

        Raises:
            BlfDscError: it is no load of this arm's tip, or none has been estimated.
        """
        if not (self._config.model == 'urdf' and self._config.robot.tip):
            raise BlfDscError(
                'expected load: this arm has no tip that could hold it: give robot.tip'
            )
        load = self.estimated if load is None else load
        if load is None:
            raise BlfDscError(
                'expected load: none has been weighed yet, so there is none to remember: give its '
                'mass, or hold one in motion until its interval is narrow'
            )
        parameters = self._parameters(load)
        self._check(load, parameters, interval, q)
        law, p = self._controller, parameters.size
        estimate = law.state.estimate[:p]
        if self.load.mass == 0.0 and not self._steps:
            self._empty = estimate.copy()
        law.expect(parameters)
        law.state.change.announced[0] = 1.0
        self._steps = max(1, round(interval / self._config.sample_time))
        self._step = (self._empty + parameters - estimate) / self._steps
        self.load = load
        return load

    def advance(self) -> None:
        """Advance the estimate of the law towards the expected load, before each sample."""
        if self._steps:
            self._controller.shift_estimate(self._step)
            self._steps -= 1

    def observe(self) -> None:
        """Remember the payload estimate of the law, once it is certain enough."""
        load = self._controller.state.payload.load
        if not load.size or load[MASS] == self._last_mass:
            return  # it is solved for ten times a second
        self._last_mass = mass = float(load[MASS])
        interval = TWO_SIDED * load[DEVIATION]
        if 0.0 < interval < widest_interval(mass) < mass:
            centre = load[MASS + 1 : DEVIATION].tolist()
            self.estimated = TipLoad(mass, tuple(centre))

    def apply_again(self) -> None:
        """Expect the same load after the settings of the law were replaced."""
        if self.load.mass > 0.0:
            self._controller.expect(self._parameters(self.load))

    def forget(self) -> None:
        """Expect nothing, before a law that forgets what it has learned."""
        settings = self._controller.settings
        settings.prior_mean[:] = settings.initial_estimate
        self.load, self._steps = NOTHING, 0

    def _parameters(self, load: TipLoad) -> Vector:
        """Return by how much a load changes the base parameters (p,)."""
        placement = np.eye(4)
        placement[:3, 3] = load.centre
        inertia = moved(payload_inertia(load.mass), placement)
        return np.asarray(tip_parameters(self._config, [inertia])[:, 0])

    def _check(
        self, load: TipLoad, parameters: Vector, interval: float, q: Vector
    ) -> None:
        """Check an interval [s], and a load with its `parameters` (p,), at q (n,) [rad].

        Raises:
            BlfDscError: they are not plausible for this arm.
        """
        config, settings = self._config, self._controller.settings
        if not (isinstance(interval, Real) and 0.0 <= interval <= LONGEST):
            raise BlfDscError(
                f'expected load: got an interval of {interval!r}, but seconds between 0 and '
                f'{LONGEST:g} are needed'
            )
        rated = config.robot.payload
        carried = 0.0 if self.estimated is None else self.estimated.mass
        if load.mass > max(rated, carried):
            raise BlfDscError(
                f'expected load: got {load.mass:g} kg, but robot.payload, which the arm is rated '
                f'for, is {rated:g} kg: give kg, or the true robot.payload'
            )
        (H,) = regressors_at(settings.model, q[np.newaxis], *np.zeros((3, 1, q.size)))
        weight = np.abs(H @ parameters)
        worst = int((weight / settings.torque.limit).argmax())
        limit = settings.torque.limit[worst]
        if weight[worst] > limit:
            unit = config.units[worst].torque
            raise BlfDscError(
                f'expected load: {load.mass:g} kg would need {weight[worst]:.3g} {unit} at joint '
                f'{config.joints[worst]!r} here, whose limit is {limit:g} {unit}: give kg, '
                'and the centre in m'
            )
