# SPDX-License-Identifier: Apache-2.0
"""A simulated arm as a robot: the section `sim_plant` of the same file, no faster than real time.

Its drives are braked until the first torque, and after the end.  It waits for each
torque, so on a slow computer the arm is slow, and nothing is missed.  With
`drive.feedback: motor` its motors close a PD of their own (`sim_plant.motors`).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.drive import DriveConfig
from blf_dsc_controller.configuration.motor_options import limits_of
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.drive.driver import Driver, Facts, ReflexError, RobotState
from blf_dsc_controller.messages.tip_load import TipLoad
from blf_dsc_controller.motors.damiao import ranges_of
from blf_dsc_controller.motors.frame import Frame, Ranges, torque_alone
from blf_dsc_controller.run import FIRST_STAMP, NANOSECOND
from sim_plant.kernels import plant_views
from sim_plant.motors import IN_REAL_TIME, MotorPlant
from sim_plant.plant import plant_of
from sim_plant.sampled_plant import Plant
from sim_plant.settings import plant_settings

Vector = NDArray[np.float64]
SIMULATED = 'simulated'
"""The address of a simulated arm."""

_BEHIND = 0.05  # s, which are caught up with; more are left behind


class SimulatedDriver(Driver):
    """A simulated arm; `simulated` makes the class of a configuration."""

    plant_config: ClassVar[PlantConfig]

    def connect(self) -> Sequence[str]:
        """Build the arm, at rest in its initial position."""
        self._build(self.plant_config)
        self.plant.compile()
        self._torque = np.zeros(self.facts.joints)
        self._is_braked = True
        self._count = 0
        self._due = 0.0
        self._load = TipLoad(
            self.plant_config.robot.drive_payload,
            self.plant_config.robot.drive_payload_centre,
        )
        self._load_in_force = self._load
        return ['the arm is simulated: no robot moves']

    def _build(self, config: PlantConfig) -> None:
        self.plant: Plant = plant_of(config)
        self._built = config

    def _measure(self) -> Vector:
        measured = np.array(self.plant.measure())
        return np.asarray(np.reshape(measured, (3, self.facts.joints)))

    def _advance(self) -> None:
        self.plant.step(self._torque)

    def positions(self) -> Vector:
        """Return the measured positions (n,) [rad]."""
        return np.asarray(self._measure()[0])

    def start(self) -> None:
        """Begin to wait for torques: those of an earlier run are forgotten, as no jump counts."""
        plant = self.plant
        now = plant_views(plant.arm, plant.settings, plant.state)[1]
        # The drives have held the arm themselves, by their brakes.
        now.drives.command[:] = now.drives.applied[:] = 0.0
        self._is_braked = True
        self._due = time.monotonic()

    def read(self) -> RobotState:
        """Wait until the next state is due by the wall clock."""
        period = self.facts.period
        self._due = max(self._due + period, time.monotonic() - _BEHIND)
        time.sleep(max(self._due - time.monotonic(), 0.0))
        if self.plant.is_stopped:
            raise ReflexError(
                'a torque changed faster than actuator.reflex_rate '
                f'({self.plant_config.actuator.reflex_rate:g} N m/s or N/s)'
            )
        self._count += 1
        stamp = NANOSECOND * FIRST_STAMP + self._count * period
        q, dq, effort = self._measure()
        return RobotState(stamp, q, dq, effort, self.plant.motor_reading)

    def write(self, torque: Vector | None) -> None:
        """Apply torques (n,) [N m] until the next state; None: those before."""
        if torque is not None:
            self._torque[:] = torque
            self._is_braked = False
        if self._is_braked:
            return
        if self._load != self._load_in_force:
            self._put_into_force(self._load)
        self._advance()

    def tell_load(self, load: TipLoad) -> None:
        """Let the drives add the weight of a load from the next state on."""
        self._load = load

    def load_in_force(self) -> float:
        """Return the mass [kg] whose weight the drives add."""
        return self._load_in_force.mass

    def finish(self) -> None:
        """Apply the brakes."""
        self._is_braked = True

    def recover(self) -> None:
        """Release drives that have stopped by themselves: the arm rests where it is."""
        here = {
            'initial.position': self.positions().tolist(),
            'initial.velocity': [0.0] * self.facts.joints,
        }
        self._build(change(self.plant_config, here))
        self._torque[:] = 0.0
        self._is_braked = True

    def _put_into_force(self, load: TipLoad) -> None:
        given = {
            'robot.drive_payload': load.mass,
            'robot.drive_payload_centre': list(load.centre),
        }
        self.plant.change(plant_settings(change(self._built, given)))
        self._load_in_force = load


class SimulatedMotorsDriver(SimulatedDriver):
    """A simulated arm whose motors close a PD of their own, from frames."""

    has_feedback = True

    def __init__(
        self, address: str, controller: ControllerConfig, config: DriveConfig
    ) -> None:
        """Note what the frames of the motors hold.

        Raises:
            BlfDscError: `drive.motor_models` does not say it.
        """
        super().__init__(address, controller, config)
        plant = self.plant_config
        self.latency = plant.actuator.delay * plant.sample_time
        self._ranges = ranges_of(limits_of(config, self.facts.joints))

    @property
    def ranges(self) -> Ranges:
        """What a frame to the motors can carry."""
        return self._ranges

    def write(self, torque: Vector | None) -> None:
        """Send torques (n,) [N m] without a PD; None: let the motors go on as they are."""
        if torque is not None:
            self._frame = torque_alone(torque)
        super().write(torque)

    def write_frame(self, frame: Frame) -> None:
        """Send a frame to each motor."""
        self._frame = frame
        super().write(frame.torque)

    def _build(self, config: PlantConfig) -> None:
        self._motors = MotorPlant(config, self._ranges, IN_REAL_TIME)
        self.plant = self._motors.plant
        self._built = self._motors.config
        self._frame = torque_alone(np.zeros(self.facts.joints))

    def _measure(self) -> Vector:
        return self._motors.measure()

    def _advance(self) -> None:
        self._motors.step(self._frame)


def simulated(plant: PlantConfig, feedback: str = 'host') -> type[SimulatedDriver]:
    """Return the driver of a configured plant; `feedback` is `drive.feedback`."""
    n = len(plant.joints)
    limits = [limit or np.inf for limit in plant.actuator.torque_limit]
    facts = Facts(
        joints=n,
        period=plant.sample_time,
        drive_compensates=plant.robot.drive_compensates,
        effort=plant.robot.effort,
        torque_limit=limits,
        torque_rate=[plant.actuator.reflex_rate or np.inf] * n,
        load_in_motion=True,
    )
    kind = SimulatedMotorsDriver if feedback == 'motor' else SimulatedDriver
    return type('Simulated', (kind,), {'facts': facts, 'plant_config': plant})
