# SPDX-License-Identifier: Apache-2.0
"""Commissioning of an arm in a loop of your own."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from functools import cached_property
from math import inf
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from blf_dsc_controller.arms.known_gears import MARGIN
from blf_dsc_controller.commissioning.better_known import (
    ABOVE_IF_HIDDEN,
    FAR_ABOVE,
    MOST_ANEW,
    better_configuration,
    is_known_by_urdf_only,
)
from blf_dsc_controller.commissioning.choice import LAGS
from blf_dsc_controller.commissioning.chosen import with_gains
from blf_dsc_controller.commissioning.commissioned import Commissioned, commissioned
from blf_dsc_controller.commissioning.measurement import (
    Measured,
    measured_in,
    oscillation_in,
)
from blf_dsc_controller.commissioning.motion import SLOW_TONES
from blf_dsc_controller.commissioning.planned import (
    TORQUE,
    TRAVEL,
    Planned,
    plan,
    postures_of,
    softer,
)
from blf_dsc_controller.commissioning.strength import MOST, shown_by
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import CONTROLLER, load, locate
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.progress import print_notice
from blf_dsc_controller.run import Run
from blf_dsc_controller.warnings.table import refuse

REPEATS = 2
"""How often a posture is measured again at most: softer, with swings, or with more torque."""

_SOFTER = 0.5  # of the gains, with which an arm that oscillates is measured again
_SOFTEST = 1.0 / 64.0  # of the gains: 14 N m/rad instead of 900, as for an unknown arm
_WORTHWHILE = 1.2  # times the amplitude, from which a posture is measured again


class Commissioning:
    """The motions by which an arm from a URDF is measured, and the gains that follow.

    Run each motion from rest, near its posture, and record it::

        commissioning = Commissioning('my.yaml')
        for k, motion in enumerate(commissioning.motions):
            with ArmController(motion.config, record=f'run_{k}') as controller:
                ...  # update, for motion.duration [s]
        found = commissioning.result(['run_0', 'run_1', 'run_2'])
        controller = ArmController(found.config)


    Attributes:
        config: the configuration that the arm is measured for.
        margin: modulus margin of the gains to choose.
        measured_with: the configuration of the motions: `config`, or the stiffer one by which
            `better_known` measures the arm anew.
        slides: whether the first motion in a posture has swings already.
        share: of the gains of `measured_with` that motions have.
        torque: of the first motion in a posture, rms, as a share of the rated torque, at most.
            What an earlier posture needed, the next ones have from the start (`go_on_with`).
        anew_left: how many times `better_known` may still measure the arm anew.
    """

    def __init__(
        self,
        config: ControllerConfig | str | Path,
        postures: Sequence[ArrayLike] | None = None,
        *,
        torque: float = TORQUE,
        travel: float = TRAVEL,
        margin: float = MARGIN,
        lags: Sequence[float] = LAGS,
    ) -> None:
        """Prepare the motions for a configuration, file or preset.

        Args:
            config: of an arm from a URDF, with gains that hold it, if only softly.
            postures: some, each (n,) [rad]; without them, three that the reference visits.
            torque: of a first motion, rms, as a share of the rated torque, at most.
            travel: how far the tool moves from its middle, at most [m].
            margin: modulus margin of the gains.
            lags: lags of the damping that are tried, joint by joint [s]; empty: none.

        Raises:
            BlfDscError: torque or travel is not above 0.
            ConfigurationError: with all problems of the file.
            StartError: no arm is stable with its gains.
        """
        for name, given in (('torque', torque), ('travel', travel)):
            if not 0.0 < given < inf:
                raise BlfDscError(f'{name}: got {given:g}, but it must be above 0')
        if not isinstance(config, ControllerConfig):
            config = load(locate(config), CONTROLLER, ControllerConfig)
        refuse(config)
        self.config = config
        self.margin = margin
        self._lags = lags
        self.measured_with = config
        self.slides = False
        self.share = 1.0
        self.anew_left = MOST_ANEW if is_known_by_urdf_only(config) else 0
        self._postures = postures
        self.torque = torque
        self._weakest = torque
        self._most = MOST * torque
        self._travel = travel

    @cached_property
    def motions(self) -> list[Planned]:
        """The motions: each has `config`, `duration` [s] and `posture` (n,) [rad].

        Raises:
            BlfDscError: the arm is not from a URDF, has feedback through its inertia
                matrix, or a posture is not one of this arm or too near its limits; or
                none is given, and the reference visits none.
        """
        return self.motions_from(None)

    def motions_from(self, here: ArrayLike | None) -> list[Planned]:
        """Return the motions of an arm at `here` (n,) [rad], where it stays if it is to hold.

        Raises:
            BlfDscError: as for `motions`.
        """
        postures = self._postures
        if postures is None:
            at = None if here is None else np.asarray(here, float)
            postures = list(postures_of(self.config, here=at))
        return [self.motion(each) for each in postures]

    def motion(self, posture: ArrayLike) -> Planned:
        """Return the motion around a posture (n,) [rad], such as that of the arm at rest.

        It has the torque, swings and gains that `plan_repeat` has found earlier postures to need.

        Raises:
            BlfDscError: the posture is not one of this arm, or too near its limits.
        """
        return self._motion(posture, self.torque, sliding=self.slides, share=self.share)

    def sliding(self, posture: ArrayLike) -> Planned:
        """Return the motion around a posture (n,) [rad] with swings that keep joints sliding.

        Raises:
            BlfDscError: as for `motion`.
        """
        return self._motion(posture, self.torque, sliding=True)

    def plan_repeat(
        self, motion: Planned, run: Run, posture: ArrayLike | None = None
    ) -> Planned | None:
        """Plan and return the motion that measures a posture again; None: the run shows enough.

        It has half of the gains, if the arm oscillates, or nearly; more torque, if noise hides
        much; swings, if friction damps a joint more than its gains do.  The next postures begin
        with all of this (`go_on_with`).  It is around `posture` (n,) [rad], or that of the
        motion.  None also if the travel of the tool and the speeds permit no larger motion.

        Raises:
            BlfDscError: the run does not show the response, or the arm oscillates with any gains.
        """
        slid = motion.excitation.sliding
        around = motion.posture if posture is None else posture
        if why := oscillation_in(run):
            self.soften(why)
            return self._motion(around, self.torque, sliding=slid, share=self.share)
        shown = shown_by(run, motion.config)
        sliding = slid or shown.rubs
        if shown.factor == 1.0 and sliding == slid:
            return None
        again = self._motion(
            around,
            min(shown.factor * motion.torque, self._most),
            sliding=sliding,
            share=motion.share * (_SOFTER if shown.rings else 1.0),
        )
        before, after = (each.excitation.amplitude for each in (motion, again))
        gained = float((after[:, :-SLOW_TONES] / before[:, :-SLOW_TONES]).max())
        if sliding == slid and not shown.rings and gained <= _WORTHWHILE:
            return None
        self.go_on_with(again)
        return again

    def soften(self, why: str) -> None:
        """Halve the gains of moves and motions from now on; `why` says how the arm oscillated.

        Motions then have at most half of the torque, too, but not less than a first one.

        Raises BlfDscError if they are very soft already.
        """
        if self.share <= _SOFTEST:
            raise BlfDscError(
                f'with 1/{1.0 / self.share:.0f} of the gains, too: {why}. Gains are not the cause: '
                'look for a loose joint or base, and for late or coarse positions, velocities and '
                'torques'
            )
        self.share *= _SOFTER
        self._most = max(0.5 * self._most, self._weakest)
        self.torque = min(self.torque, self._most)
        print_notice(
            f'the arm has oscillated, and goes on with 1/{1.0 / self.share:.0f} of the gains: {why}'
        )

    @property
    def held_with(self) -> ControllerConfig:
        """The configuration of moves to a posture: with the gains of the motions."""
        gains = softer(self.measured_with, self.share)
        return with_gains(self.measured_with, gains) if gains else self.measured_with

    def go_on_with(self, motion: Planned) -> None:
        """Let the first motions of the next postures have what this one needed.

        `plan_repeat` has done so, unless another process has computed it.
        """
        self.torque = max(self.torque, motion.torque)
        self.slides = self.slides or motion.excitation.sliding
        self.share = min(self.share, motion.share)

    def better_known(self, motion: Planned, run: Run) -> Commissioning | None:
        """Return what measures this arm anew, by what a run shows; None: the run is good enough.

        It has stiffer gains, and compensates the friction that the run shows.  That is for arms
        of which only the URDF is known, at most twice, and while the arm bears more than 5 times
        the gains of the run, or 2.5 times if friction hides an inertia.  Its runs belong to the
        result of this one.

        Raises:
            BlfDscError: the run does not show the response.
        """
        if not self.anew_left:
            return None
        # the next measurement has no lag either
        found = commissioned(
            self.config, [Measured(run, motion.config)], self.margin, ()
        )
        hidden = np.isnan(found.findings.inertia)
        if found.choice.factors.max() <= (
            ABOVE_IF_HIDDEN if hidden.any() else FAR_ABOVE
        ):
            return None
        better = copy(self)
        vars(better).pop('motions', None)  # of gains that are softer
        better.measured_with = better_configuration(
            self.config,
            found.parameters_but_bounds(),
            found.start,
            found.findings.friction,
            hidden,
        )
        better.slides = motion.excitation.sliding
        better.anew_left -= 1
        return better

    def _motion(
        self,
        posture: ArrayLike,
        torque: float,
        *,
        sliding: bool = False,
        share: float = 1.0,
    ) -> Planned:
        return plan(
            self.measured_with,
            np.asarray(posture, float),
            torque=torque,
            travel=self._travel,
            sliding=sliding,
            share=share,
        )

    def result(
        self,
        runs: Sequence[str | Path | tuple[Run, ControllerConfig]],
        names: Sequence[str] = (),
    ) -> Commissioned:
        """Return what runs of motions show, and the gains that follow.

        Args:
            runs: folders of bags, or runs with the configurations that they had.
            names: what errors call the runs; without them, bags are named by their folders.

        Raises:
            BagError: a bag cannot be read.
            BlfDscError: a run is not of this arm or no motion of a commissioning, ended
                before its time, or lacks joint states.
        """
        measured = [
            Measured(*each)
            if isinstance(each, tuple)
            else measured_in(each, self.config)
            for each in runs
        ]
        if not names:
            names = ['' if isinstance(each, tuple) else str(each) for each in runs]
        return commissioned(self.config, measured, self.margin, self._lags, names)
