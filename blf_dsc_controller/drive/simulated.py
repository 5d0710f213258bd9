# SPDX-License-Identifier: Apache-2.0
"""A simulated arm as a robot: the section `sim_plant` of the same file, no faster than real time.

Its drives are braked until the first torque, and after the end.  It waits for each
torque, so on a slow computer the arm is slow, and nothing is missed.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.drive.driver import Driver, Facts, ReflexError, RobotState
from blf_dsc_controller.supervision.drive_load import DriveLoad
from sim_plant.plant import Plant, plant_of, plant_settings

Vector = NDArray[np.float64]
SIMULATED = 'simulated'
"""The address of a simulated arm."""

_FIRST = 1.0  # s, stamp of the first state
_BEHIND = 0.05  # s, which are caught up with; more are left behind


class SimulatedDriver(Driver):
    """A simulated arm; `simulated` makes the class of a configuration."""

    plant_config: ClassVar[PlantConfig]

    def connect(self) -> Sequence[str]:
        """Build the arm, at rest in its initial position."""
        self.plant: Plant = plant_of(self.plant_config)
        self.plant.compile()
        self._torque = np.zeros(self.facts.joints)
        self._is_braked = True
        self._count = 0
        self._due = 0.0
        self._load = DriveLoad(
            self.plant_config.robot.drive_payload,
            self.plant_config.robot.drive_payload_centre,
        )
        self._load_in_force = self._load
        return ['the arm is simulated: no robot moves']

    def positions(self) -> Vector:
        """Return the measured positions (n,) [rad]."""
        return np.array(self.plant.measure()[: self.facts.joints])

    def start(self) -> None:
        """Begin to wait for torques."""
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
                f'({self.plant_config.actuator.reflex_rate:g} N m/s)'
            )
        self._count += 1
        n = self.facts.joints
        q, dq, effort = np.array(self.plant.measure()).reshape(3, n)
        return RobotState(_FIRST + self._count * period, q, dq, effort)

    def write(self, torque: Vector | None) -> None:
        """Apply torques (n,) [N m] until the next state; None: those before."""
        if torque is not None:
            self._torque[:] = torque
            self._is_braked = False
        if self._is_braked:
            return
        if self._load != self._load_in_force:
            self._put_into_force(self._load)
        self.plant.step(self._torque)

    def tell_load(self, load: DriveLoad) -> None:
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
        self.plant = plant_of(change(self.plant_config, here))
        self._torque[:] = 0.0
        self._is_braked = True

    def _put_into_force(self, load: DriveLoad) -> None:
        given = {
            'robot.drive_payload': load.mass,
            'robot.drive_payload_centre': list(load.centre),
        }
        self.plant.change(plant_settings(change(self.plant_config, given)))
        self._load_in_force = load


def simulated(plant: PlantConfig) -> type[SimulatedDriver]:
    """Return the driver of a configured plant."""
    n = len(plant.joints)
    limits = [limit or np.inf for limit in plant.actuator.torque_limit]
    told = Facts(
        joints=n,
        period=plant.sample_time,
        drive_compensates=plant.robot.drive_compensates,
        effort=plant.robot.effort,
        torque_limit=limits,
        torque_rate=[plant.actuator.reflex_rate or np.inf] * n,
        load_in_motion=True,
    )

    class Simulated(SimulatedDriver):
        """The driver of one configured plant."""

        facts = told
        plant_config = plant

    return Simulated
