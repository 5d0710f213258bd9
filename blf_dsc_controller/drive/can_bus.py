# SPDX-License-Identifier: Apache-2.0
"""A CAN bus by python-can, whose troubles say what to do.

A robot's address is that of its bus: a channel of socketcan, such as can0, or
INTERFACE:CHANNEL with another interface of python-can, such as
udp_multicast:239.74.163.2 or slcan:/dev/ttyACM0.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection
from time import monotonic
from typing import Any

import can

from blf_dsc_controller.drive.driver import ConnectionLostError, DriverError

_ECHOES = 4  # frames to each identifier that may still come back
_OPTIONS: dict[bool, dict[str, Any]] = {False: {}, True: {'fd': True}}


class CanBus:
    """A bus on which this program commands some identifiers."""

    def __init__(self, address: str, commands: Collection[int], *, fd: bool) -> None:
        """Open it; `commands` are the identifiers that nobody else may send.

        Raises:
            DriverError: it cannot be opened.
        """
        interface, has_interface, channel = address.partition(':')
        self.address = address
        self._commands = frozenset(commands)
        self._fd = fd
        self._sent = deque[tuple[int, bytes]](maxlen=_ECHOES * len(self._commands))
        try:
            self._bus = can.Bus(
                interface=interface if has_interface else 'socketcan',
                channel=channel or interface,
                **_OPTIONS[fd],
            )
        except (can.CanError, OSError, ValueError, ImportError) as error:
            raise DriverError(
                f'{address}: the CAN bus cannot be opened ({error}): give a channel such as can0, '
                'brought up (ip link set can0 up type can bitrate 1000000), or INTERFACE:CHANNEL '
                'of python-can'
            ) from error

    def send(self, identifier: int, data: bytes) -> None:
        """Send eight bytes.

        Raises:
            ConnectionLostError: the bus does not take them.
        """
        message = can.Message(
            arbitration_id=identifier,
            data=data,
            is_extended_id=False,
            is_fd=self._fd,
            bitrate_switch=self._fd,
        )
        self._sent.append((identifier, data))
        try:
            self._bus.send(message)
        except (can.CanError, OSError) as error:
            raise self._lost(f'takes no frames ({error})') from error

    def receive(self, timeout: float) -> tuple[int, bytes] | None:
        """Return identifier and data of the next frame; None: there was none in time [s].

        Some interfaces, such as udp_multicast, return what was sent: that is left out.

        Raises:
            ConnectionLostError: the bus is off, or gone.
            DriverError: another program commands the same motors.
        """
        end = monotonic() + timeout
        while (found := self._next(max(end - monotonic(), 0.0))) is not None:
            identifier, _ = found
            if identifier not in self._commands:
                return found
            if found not in self._sent:
                raise DriverError(
                    f'{self.address}: another program commands these motors, too (identifier '
                    f'0x{identifier:03x}): end one of the two'
                )
        return None

    def _next(self, timeout: float) -> tuple[int, bytes] | None:
        try:
            message = self._bus.recv(timeout)
        except (can.CanError, OSError) as error:
            raise self._lost(f'gives no frames ({error})') from error
        if message is None:
            return None
        if message.is_error_frame:
            raise self._lost('reports an error, or is off')
        return message.arbitration_id, bytes(message.data)

    def clear(self) -> None:
        """Drop frames that wait."""
        while self.receive(0.0) is not None:
            pass

    def close(self) -> None:
        """Leave the bus."""
        self._bus.shutdown()

    def _lost(self, what: str) -> ConnectionLostError:
        return ConnectionLostError(
            f'{self.address}: the CAN bus {what}: check power, cable, terminators and bit rate, '
            'and bring it down and up again'
        )
