# SPDX-License-Identifier: Apache-2.0
"""Checks of every sample that the law computed, before its torque is sent."""

from __future__ import annotations

from math import inf

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.controller_groups import Safety
from blf_dsc_controller.configuration.tool_bound import tool_of
from blf_dsc_controller.law.check_state import NO_EFFECT, OUTSIDE, SUSPECT
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.supervision.kept_estimates import KeptEstimates
from blf_dsc_controller.supervision.model_torque import needed_torque
from blf_dsc_controller.supervision.not_sensors import is_off
from blf_dsc_controller.supervision.oscillation_check import OscillationCheck
from blf_dsc_controller.supervision.stop_cause import chatter_of, saturation_of
from blf_dsc_controller.supervision.supervisor import Fault, Reason
from blf_dsc_controller.tool.errors import in_words

Vector = NDArray[np.float64]
# of the torque limit: an effort that is so much below its command, on average and now,
# explains an error past the bound
_SHORT_TORQUE, _SHORT_TORQUE_NOW = 0.05, 0.1
_AGAINST_TORQUE = 0.1  # of the torque limit, beyond the torque of the model at rest
# s without saturation that make up for one with it: more than a fifth adds up
_UNSATURATED_RELIEF = 4


class SampleCheck:
    """Checks each sample, and returns to earlier estimates where a fault has spoilt them.

    Attributes:
        ratio: largest |xi1| / k_c of each joint since the start (n,).
        outside: samples past the bound since the start.
        saturated: samples with a torque at its limit since the start.
    """

    def __init__(
        self,
        config: ControllerConfig,
        controller: Controller,
        oscillation: OscillationCheck,
        estimates: KeptEstimates,
    ) -> None:
        """Enable the checks of the controller; `estimates` are the kept ones of its law."""
        controller.checks.sample_time[0] = config.sample_time
        self._has_torques = config.robot.effort in ('whole', 'commanded')
        self._joints = config.joints
        self._units = config.units
        self._tool = tool_of(config)
        self._controller = controller
        self._config, self._oscillation = config, oscillation
        self._limited = 0  # the joint that was last at its torque limit
        self.ratio = controller.checks.ratio
        self._estimates = estimates
        self._saturation = 0  # ns, times _UNSATURATED_RELIEF
        self.set_limits(config.safety)
        self.restart()

    def set_limits(self, safety: Safety) -> None:
        """Apply the limits of `safety` to the next samples."""
        self._safety = safety
        checks = self._controller.checks
        checks.velocity_limit[:] = safety.velocity_limit
        checks.error_ratio[0] = safety.error_ratio

    def restart(self) -> None:
        """Reset the counts, starting with the next sample."""
        self.compare_efforts()
        self.ratio[:] = 0.0
        self.outside = self.saturated = 0
        self._estimates.begin()
        self.relax()

    def compare_efforts(self) -> None:
        """Compare efforts with commands where they are torques, and follow them."""
        compares = self._has_torques and not is_off(self._controller)
        self._controller.checks.effect.compares[0] = float(compares)

    @property
    def saturated_time(self) -> float:
        """Time at a torque limit [s], less a quarter of the time without since then."""
        return self._saturation * 1e-9 / _UNSATURATED_RELIEF

    def relax(self, duration: float = inf) -> None:
        """Account for some time without saturation [s]."""
        # Whole nanoseconds: many samples at once leave what they leave one by one.
        remaining = self._saturation - round(duration * 1e9) if duration < inf else 0
        self._saturation = max(0, remaining)

    @property
    def tool_errors(self) -> Vector | None:
        """Errors and bounds at the tool (4,) of the last sample, as of `Tool.errors`.

        None of an arm without a bound there.
        """
        if self._tool is None:
            return None
        sample = self._controller.sample
        return self._tool.errors(sample.qr, sample.xi1, sample.bound)

    @property
    def _vibration(self) -> str:
        """What oscillates or chatters, and the remedy; empty if nothing does."""
        return self._oscillation.cause or chatter_of(self._controller, self._config)

    @property
    def _lack_of_torque(self) -> str:
        """Which joint has been at its torque limit for long, and the remedy; empty if none has."""
        time = self.saturated_time
        return saturation_of(self._controller, self._config, self._limited, time)

    def check(self, dt: float) -> Fault | None:
        """Return why the torque of a sample, after `dt` [s], must not be used."""
        flags = self._controller.flags
        if flags & OUTSIDE:
            self.outside += 1
        if not flags & SUSPECT:
            self.relax(dt)
            return None
        if flags & NO_EFFECT:
            return self._stop_without_effect()
        fault = (
            self._check_numbers() or self._check_error() or self._count_saturated(dt)
        )
        if fault is None:
            self._estimates.keep()
        return fault

    def _check_numbers(self) -> Fault | None:
        """Return the fault of an estimate or a torque that is not finite."""
        state = self._controller.state
        demand = self._controller.signals.demand
        if not (
            np.isfinite(state.estimate).all() and np.isfinite(state.disturbance).all()
        ):
            text = f'an estimate is not finite: {state.estimate}, disturbance {state.disturbance}'
            return Fault(Reason.ESTIMATE, text)
        # Saturation turns an infinite demand into a finite torque.
        if not (
            np.isfinite(demand).all()
            and np.isfinite(self._controller.sample.torque).all()
        ):
            return Fault(Reason.TORQUE, f'the demanded torque is not finite: {demand}')
        return None

    def _stop_without_effect(self) -> Fault:
        """Keep the estimates of when a joint last moved; return the fault."""
        checks = self._controller.checks
        limit = self._controller.settings.torque.limit
        self._estimates.return_to_moved()
        if vibration := self._vibration:
            return Fault(Reason.OSCILLATION, vibration)
        if saturation := self._lack_of_torque:
            return Fault(Reason.SATURATED, f'{saturation}; no joint moves any more')
        if checks.effect.short_for[0] > 0.0:
            shortfall = checks.effect.shortfall - checks.effect.shortfall_in_motion
            return self._falling_short(
                int(np.argmax(np.abs(shortfall) / limit)), shortfall
            )
        change = checks.effect.recent - checks.effect.before
        worst = int(np.argmax(np.abs(change) / limit))
        text = (
            f'the torque of joint {self._joints[worst]!r} has changed by {change[worst]:+.4g} '
            f'{self._units[worst].torque}, but no joint has moved: release the brakes, and '
            'activate the effort controller; if neither is it, the drives give less than they are '
            'sent, or the joints stick: correct torque constant or gear ratio, or give '
            'robot.coulomb'
        )
        return Fault(Reason.NO_EFFECT, text)

    def _falling_short(self, joint: int, shortfall: Vector) -> Fault:
        """Return the fault of a joint whose effort is `shortfall` (n,) [N m] below its command."""
        unit = self._units[joint].torque
        text = (
            f'the effort of joint {self._joints[joint]!r} lacks {shortfall[joint]:+.4g} {unit} of '
            'what is commanded: release the brakes, and activate the effort controller; if the '
            f'effort is not in {unit}, set robot.effort to current or unknown; if the joint '
            'moves, its drive gives less than it is sent: correct its torque constant, gear ratio '
            'or current limit, or give what it can as torque.limit'
        )
        return Fault(Reason.NO_EFFECT, text)

    def _check_reach(self) -> Fault | None:
        """Return the fault if, by the efforts, commands do not reach a moving arm.

        The kept estimates are then those from before the error grew.
        """
        settings = self._controller.settings
        checks = self._controller.checks
        if checks.effect.compares[0] == 0.0 or self._oscillation.cause:
            return None
        shortfall = checks.effect.shortfall - checks.effect.mean_shortfall
        present = self._controller.sample.torque - checks.repeats.used[2 * settings.n :]
        if settings.torque.drive > 0 and settings.torque.effort_is_whole == 1:
            present += self._controller.signals.saturation.added
        present -= checks.effect.mean_shortfall
        mean_ratio = np.abs(shortfall) / settings.torque.limit
        present_ratio = np.abs(present) / settings.torque.limit
        is_short = (
            (mean_ratio > _SHORT_TORQUE)
            & (present_ratio > _SHORT_TORQUE_NOW)
            & (shortfall * present > 0.0)
        )
        if not is_short.any():
            return None
        self._estimates.return_to_consistent()
        return self._falling_short(
            int(np.argmax(np.where(is_short, mean_ratio, 0.0))), shortfall
        )

    def _check_error(self) -> Fault | None:
        """Return the fault of an error past `safety.error_ratio` times its bound; None: none is."""
        safety = self._safety
        if safety.error_ratio == 0.0 or self._controller.settings.has_barrier == 0:
            return None
        xi1 = self._controller.sample.xi1
        bound = self._controller.sample.bound
        ratio = np.abs(xi1) / bound
        worst = int(np.argmax(ratio))
        if ratio[worst] < safety.error_ratio:
            return None
        if (unreached := self._check_reach()) is not None:
            return unreached
        unit = self._units[worst].position
        factor = '' if safety.error_ratio == 1.0 else f'{safety.error_ratio:g} times '
        text = (
            f'joint {self._joints[worst]!r} is {xi1[worst]:+.6g} {unit} from its reference: '
            f'past {factor}its bound of {bound[worst]:.6g} {unit}'
        )
        if (at_tool := self.tool_errors) is not None:
            text += f'; {in_words(at_tool)}'
        if cause := self._vibration or self._lack_of_torque:
            return Fault(Reason.OUTSIDE_BOUND, f'{cause}; {text}')
        return Fault(Reason.OUTSIDE_BOUND, text + self._imbalance(worst))

    def _imbalance(self, joint: int) -> str:
        """Return what may be wrong if a joint leaves against the torque that it is sent.

        A weak drive and a load look alike, unless efforts are what the drive gives.
        """
        controller = self._controller
        sample = controller.sample
        rest = np.zeros(len(self._joints))
        q = sample.qr + sample.xi1
        model = needed_torque(
            controller.settings, self._estimates.estimate, q, rest, rest
        )[joint]
        sent, unit = sample.torque[joint], self._units[joint].torque
        threshold = _AGAINST_TORQUE * controller.settings.torque.limit[joint]
        is_against = -np.sign(sample.xi1[joint]) * (sent - model) > threshold
        if not is_against or (sent - model) * model < -threshold * abs(model):
            return ''
        drive = (
            ''
            if controller.checks.effect.compares[0] == 1.0
            else ', its drive gives less than it is sent (torque constant, gear ratio, '
            'current limit)'
        )
        return (
            f'; it is sent {sent:.3g} {unit}, where the model needs {model:.3g} {unit} at rest, '
            f'and leaves all the same: it carries more than the model knows{drive}, or something '
            'holds it'
        )

    def _count_saturated(self, dt: float) -> Fault | None:
        """Count a sample with a torque at its limit; return the fault if there are too many."""
        signals = self._controller.signals
        limit = self._controller.settings.torque.limit
        demand, added = signals.demand, signals.saturation.added
        needed = np.maximum(np.abs(demand), np.abs(demand - added))
        worst = int(np.argmax(needed - limit))
        self._limited = worst
        self.saturated += 1
        self._saturation += _UNSATURATED_RELIEF * round(dt * 1e9)
        if self.saturated_time <= self._safety.saturation_time:
            return None
        unit = self._units[worst].torque
        text = (
            f'joint {self._joints[worst]!r} needs {needed[worst]:.4g} {unit} and has been at '
            f'its limit of {limit[worst]:g} {unit} for {self.saturated_time:.4g} s (less a quarter '
            'of the time below it)'
        )
        return Fault(Reason.SATURATED, '; '.join(filter(None, (self._vibration, text))))
