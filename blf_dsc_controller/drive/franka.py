# SPDX-License-Identifier: Apache-2.0
"""A Franka Research 3 by libfranka's protocol, with `pylibfranka`.

The robot adds gravity and motor friction to the torques that it gets, and reports the
whole torque of each joint (tau_J).  It needs a torque after each state, every
millisecond.  One that misses twenty states in a row, or changes a torque by more than 1
N m between two, is stopped by it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, ClassVar

import numpy as np
import pylibfranka
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.drive import DriveConfig
from blf_dsc_controller.drive.driver import (
    ConnectionLostError,
    Driver,
    DriverError,
    Facts,
    ReflexError,
    RobotState,
)
from blf_dsc_controller.messages.tip_load import TipLoad

Vector = NDArray[np.float64]
_JOINTS = 7
_FLANGE = 0.107  # m, along the axis of joint 7, from its frame
_SAME_MASS = 0.01  # kg
_REMEDIES = {
    'Reflex': 'it had a reflex: see Desk, and clear the way of the arm',
    'UserStopped': 'release the external activation device or the stop button',
    'Guiding': 'let go of the guiding buttons',
    'Move': 'another program controls it: end that one',
    'Other': 'unlock the joints in Desk, and activate the FCI',
}


class FrankaDriver(Driver):
    """A Franka Research 3."""

    facts: ClassVar[Facts] = Facts(
        joints=_JOINTS,
        period=0.001,
        drive_compensates='gravity_and_friction',
        effort='whole',
        torque_limit=(87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0),
        torque_rate=(1000.0,) * _JOINTS,
        load_in_motion=True,
    )

    def __init__(
        self, address: str, controller: ControllerConfig, config: DriveConfig
    ) -> None:
        super().__init__(address, controller, config)
        self._torque = np.zeros(_JOINTS)
        self._control: Any = None
        self._load = 0.0
        # of the tip in the frame of the flange
        self._tip = controller.robot.chain(controller.joints).tip_placement.copy()
        self._tip[2, 3] -= _FLANGE

    def connect(self) -> Sequence[str]:
        """Reach the robot, recover it from a reflex, and set thresholds and load.

        Raises:
            DriverError: it cannot be reached, is not ready, or refuses a setting.
        """
        is_realtime = self.controller.realtime.priority > 0
        wanted = pylibfranka.RealtimeConfig
        with self._explained(f'{self.address} cannot be reached'):
            self._robot = pylibfranka.Robot(
                self.address, wanted.kEnforce if is_realtime else wanted.kIgnore
            )
            state = self._robot.read_once()
        if state.robot_mode == pylibfranka.RobotMode.Reflex:
            self.recover()
            state = self._robot.read_once()
        if state.robot_mode != pylibfranka.RobotMode.Idle:
            mode = state.robot_mode.name
            raise DriverError(
                f'{self.address} is not idle, but in mode {mode}: '
                f'{_REMEDIES.get(mode, "see Desk")}'
            )
        self._set_thresholds()
        self._set_load()
        return [f'connected to {self.address}', *self._remarks()]

    def _set_thresholds(self) -> None:
        torque = list(self.config.collision_torque)
        force = list(self.config.collision_force)
        if not torque:
            return
        if len(torque) != _JOINTS:
            raise DriverError(
                f'drive: collision_torque: got {len(torque)} entries, but the robot has {_JOINTS} '
                'joints: give one for each'
            )
        with self._explained('the collision thresholds were refused'):
            self._robot.set_collision_behavior(torque, torque, force, force)

    def _set_load(self) -> None:
        """Declare `robot.drive_payload` to the robot, whose model then includes it."""
        if self.config.set_load:
            robot = self.controller.robot
            self.tell_load(TipLoad(robot.drive_payload, robot.drive_payload_centre))

    def tell_load(self, load: TipLoad) -> None:
        """Send a load; the robot takes it in motion, too."""
        has_load = load.mass > 0.0
        centre = self._tip @ np.append(load.centre, 1.0) if has_load else np.zeros(4)
        inertia = np.diag(self.config.load_inertia) if has_load else np.zeros((3, 3))
        with self._explained('the load was refused'):
            self._robot.set_load(
                load.mass, centre[:3].tolist(), inertia.ravel(order='F').tolist()
            )

    def _remarks(self) -> Iterator[str]:
        """Yield what the states of the robot at rest contradict."""
        with self._explained('no state was received'):
            state = self._robot.read_once()
        if not any(state.tau_J):
            yield (
                'note: no joint has a torque (tau_J) while the robot rests, so it is a simulator '
                'that reports commands alone. To go on, set safety.first_torque: send and '
                'disturbance.observer_bandwidth: 0.0'
            )
        elif not self.controller.robot.torque_loop:
            yield (
                'note: this robot has joint torque sensors. With robot.torque_loop: true and the '
                'disturbance.observer_bandwidth that `blf_dsc commission` gives, the law takes up '
                'loads by them, with a third of the error'
            )
        known = self.controller.robot.drive_payload
        if self.config.set_load and abs(state.m_ee) > _SAME_MASS:
            yield (
                f'note: the robot compensates an end effector of {state.m_ee:.2f} kg, which is '
                'configured in Desk. The URDF should contain it, too; a difference is learned'
            )
        elif not self.config.set_load and abs(state.m_total - known) > _SAME_MASS:
            yield (
                f'note: the robot compensates {state.m_total:.2f} kg at its flange, but '
                f'robot.drive_payload is {known:g} kg: give there what the URDF lacks of this mass'
            )

    def positions(self) -> Vector:
        """Return the joint positions (7,) [rad]."""
        with self._explained('no state was received'):
            return np.array(self._robot.read_once().q)

    def start(self) -> None:
        """Begin torque control."""
        self._control = None  # one that a reflex has ended excludes another
        self._torque = np.zeros(_JOINTS)  # not that of the motion before
        with self._explained('torque control was refused'):
            self._control = self._robot.start_torque_control()

    def read(self) -> RobotState:
        """Wait for the next state; libfranka gives up after a second.

        Positions of motors are left out if all are 0 or those of the joints, as of simulators
        without gears.
        """
        with self._in_motion():
            state, _ = self._control.readOnce()
        self._load = state.m_load
        has_motors = any(state.theta) and list(state.theta) != list(state.q)
        motors = (state.theta, state.dtheta) if has_motors else None
        return RobotState(state.time.to_sec(), state.q, state.dq, state.tau_J, motors)

    def load_in_force(self) -> float:
        """Return the mass [kg] of the load that the last state had."""
        return float(self._load)

    def write(self, torque: Vector | None) -> None:
        """Command torques (7,) [N m] beyond gravity.

        None repeats those since the start, or zero.
        """
        if torque is not None:
            self._torque = torque
        with self._in_motion():
            self._control.writeOnce(pylibfranka.Torques(self._torque.tolist()))

    def finish(self) -> None:
        """End torque control with the last torque.

        The robot's own controller holds the arm.
        """
        last = pylibfranka.Torques(self._torque.tolist())
        last.motion_finished = True
        with self._in_motion():
            self._control.writeOnce(last)

    def recover(self) -> None:
        """Clear the errors of a reflex.

        Raises:
            DriverError: it takes a person to do it.
        """
        with self._explained('automatic error recovery was refused'):
            self._robot.automatic_error_recovery()

    @contextmanager
    def _explained(self, what: str) -> Iterator[None]:
        """Raise the errors of libfranka as `DriverError`, with what to do."""
        try:
            yield
        except pylibfranka.NetworkException as error:
            raise DriverError(
                f'{what} ({_reason(error)}): check the address and the cable, activate the FCI in '
                'Desk, and end other programs that control the robot'
            ) from error
        except pylibfranka.RealtimeException as error:
            raise DriverError(
                f'{what} ({_reason(error)}): install a kernel with PREEMPT_RT and allow rtprio to '
                'this user, or set realtime.priority to 0'
            ) from error
        except (
            pylibfranka.CommandException,
            pylibfranka.ControlException,
            pylibfranka.InvalidOperationException,
            pylibfranka.FrankaException,
        ) as error:
            raise DriverError(
                f'{what} ({_reason(error)}): see Desk, which names the cause'
            ) from error

    @contextmanager
    def _in_motion(self) -> Iterator[None]:
        """Raise the errors of libfranka during the motion as those of a driver."""
        try:
            yield
        except pylibfranka.NetworkException as error:
            raise ConnectionLostError(
                f'{_reason(error)}: the robot stops by itself; check its computer and the cable'
            ) from error
        except pylibfranka.ControlException as error:
            raise ReflexError(_reason(error)) from error
        except pylibfranka.CommandException as error:
            raise ReflexError(
                f'{_reason(error)}: the robot has ended the motion; see Desk, which names the cause'
            ) from error
        except pylibfranka.InvalidOperationException as error:
            raise DriverError(
                f'torque control ended ({_reason(error)}): end what else reads or moves the robot, '
                'and start again'
            ) from error
        except (pylibfranka.RealtimeException, pylibfranka.FrankaException) as error:
            raise DriverError(
                f'torque control ended ({_reason(error)}): see Desk, and start again'
            ) from error


def _reason(error: Exception) -> str:
    return str(error).removeprefix('libfranka: ').strip()
