# SPDX-License-Identifier: Apache-2.0
"""The load that is declared to the drives of an arm; nothing of drives that add no weight."""

from __future__ import annotations

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.supervision.drive_load import DriveLoad, DriveLoads


class DeclaredLoads:
    """`DriveLoads` of a controller, made when they are needed.

    They are needed from the start with `load.tell_drive`, else from the first load on.
    """

    def __init__(self, config: ControllerConfig, controller: Controller) -> None:
        self._controller = controller
        tells = config.load.tell_drive
        self._loads = DriveLoads(config) if tells else None

    def begin_step(self) -> DriveLoad | None:
        """Begin the next step: return the load to declare to the drives; None if there is none."""
        return None if self._loads is None else self._loads.begin_step(self._controller)

    def take(self, config: ControllerConfig, load: DriveLoad) -> None:
        """Subtract the weight of a load that the drives add from now on.

        Raises:
            BlfDscError: the drives add no weight.
        """
        self._of(config).take(self._controller, load)

    def declare(self, config: ControllerConfig, load: DriveLoad) -> None:
        """Let the steps lead to this load, whatever is weighed.

        Raises:
            BlfDscError: the drives add no weight.
        """
        self._of(config).wanted = load

    @property
    def is_declared(self) -> bool:
        """Whether the drives have the load that is wanted, if any."""
        return self._loads is None or self._loads.is_declared

    def subtract_again(self) -> None:
        """Subtract the weight that the drives add, after the settings were replaced."""
        if self._loads is not None:
            self._loads.take(self._controller, self._loads.in_force)

    def forget(self) -> None:
        """Begin again with a law that has forgotten what the tip holds."""
        if self._loads is not None:
            self._loads.forget(self._controller)

    def _of(self, config: ControllerConfig) -> DriveLoads:
        if self._loads is None:
            if config.robot.drive_compensates == 'none':
                raise BlfDscError(
                    'robot.drive_compensates: got none: these drives add no weight, so no load '
                    'can be declared to them; the law weighs and carries it by itself'
                )
            self._loads = DriveLoads(config)
        return self._loads
