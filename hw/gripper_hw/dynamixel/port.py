"""Ports for the vendor's SDK: a serial port, a port of the caller's, or a virtual bus (see `memory_port`).

All raise `DeviceLostError` once the other end is gone. The SDK's own port would report "busy" forever.
"""

import contextlib
import os
import select
import termios
import time
from collections.abc import Callable, Iterable
from typing import Any, Final, NoReturn, Protocol, TypeVar

import serial
from dynamixel_sdk import PortHandler

from gripper_force.config import VIRTUAL_PREFIX
from gripper_force.errors import ConfigError, DeviceError, DeviceLostError
from gripper_hw.serial_line import open_line

_MAX_REPLY_BYTES: Final = 4096  # a scan of all ids; more means that the other end never stops sending


_POLL_S: Final = 5e-5
"""Pause between two looks for bytes at a caller's port, which does not wait for them."""

_T = TypeVar("_T")


class Port(Protocol):
    """Members of a port that the driver uses beyond the SDK's `PortHandler`."""

    is_using: bool

    def closePort(self) -> None:  # noqa: N802
        """Releases the port. May be called twice."""

    def drain(self) -> None:
        """Discards received bytes until the reply timeout ends."""


def open_port(name: str, baud_rate: int, reply_margin_ms: float) -> Port:
    """Opens a port exclusively.

    Args:
        name: Device path, or ``virtual:<name>`` for a bus registered in this process.
        baud_rate: Bits per second.
        reply_margin_ms: Reply timeout beyond the transmission time of the packets.

    Raises:
        ConfigError: The SDK does not support this baud rate.
        DeviceNotFoundError: The port does not exist.
        DeviceError: The port is in use or not permitted.
    """
    if name.startswith(VIRTUAL_PREFIX):
        from gripper_hw.dynamixel.memory_port import MemoryPort

        return MemoryPort(name, name.removeprefix(VIRTUAL_PREFIX))
    port = SerialPort(name, reply_margin_ms)
    if not port.setBaudRate(baud_rate):
        raise ConfigError(
            f"servo.baud_rate {baud_rate} is not supported by the Dynamixel SDK; use e.g. 1000000"
        )
    return port


class SerialPort(PortHandler):  # type: ignore[misc]
    """Serial port that sleeps until bytes arrive. The SDK's own port busy-waits."""

    def __init__(self, name: str, reply_margin_ms: float) -> None:
        super().__init__(name)
        self.ser: serial.Serial | None = None
        self._reply_margin_ms = reply_margin_ms
        self._sent_bytes = 0
        self._remaining_bytes = 0

    def setupPort(self, cflag_baud: int) -> bool:  # noqa: N802
        """Opens the port; raises the errors of `open_port`."""
        self.closePort()
        self.ser = open_line(self.port_name, cflag_baud, unit="servo", timeout_s=0)
        # Only some adapters, and no pseudo-terminal, have a latency timer; macOS has no call for it.
        with contextlib.suppress(ValueError, OSError, NotImplementedError):
            self.ser.set_low_latency_mode(True)
        self.is_open = True
        self.tx_time_per_byte = 10_000.0 / cflag_baud
        return True

    def closePort(self) -> None:  # noqa: N802
        """Closes the port. May be called twice."""
        self.is_open = False
        self.is_using = False
        if self.ser is not None:
            with contextlib.suppress(OSError, termios.error):
                self.ser.close()
            self.ser = None

    def clearPort(self) -> None:  # noqa: N802
        """Discards received bytes."""
        try:
            termios.tcflush(self._fd(), termios.TCIFLUSH)
        except (OSError, termios.error) as error:
            self._raise_lost(error)

    def writePort(self, packet: Iterable[int]) -> int:  # noqa: N802
        """Sends a packet and returns the number of bytes accepted."""
        data = bytes(packet)
        self._sent_bytes = len(data)
        self._remaining_bytes = _MAX_REPLY_BYTES
        try:
            return os.write(self._fd(), data)
        except BlockingIOError:
            return 0
        except OSError as error:
            self._raise_lost(error)

    def readPort(self, length: int) -> bytes:  # noqa: N802
        """Returns up to ``length`` bytes as soon as one is available; empty after the reply timeout."""
        length = min(length, self._remaining_bytes)
        if length <= 0:
            return b""
        timeout_s = (self.packet_start_time + self.packet_timeout - self.getCurrentTime()) / 1e3
        data = self._read(length, max(0.0, timeout_s))
        self._remaining_bytes -= len(data)
        return data

    def getCurrentTime(self) -> float:  # noqa: N802
        """Monotonic time in ms; the SDK's own method follows the wall clock."""
        return time.monotonic() * 1e3

    def setPacketTimeout(self, packet_length: int) -> None:  # noqa: N802
        """Starts the timeout: time of the request and a reply of ``packet_length`` bytes, plus margin."""
        self.setPacketTimeoutMillis(
            self.tx_time_per_byte * (packet_length + self._sent_bytes) + self._reply_margin_ms
        )

    def drain(self) -> None:
        """Discards received bytes until the reply timeout ends."""
        while not self.isPacketTimeout():
            self.readPort(_MAX_REPLY_BYTES)

    def _read(self, length: int, timeout_s: float) -> bytes:
        try:
            fd = self._fd()
            poller = select.poll()  # `select.select` fails for descriptors from 1024 on
            poller.register(fd, select.POLLIN)
            if not poller.poll(1e3 * timeout_s):
                return b""
            data = os.read(fd, length)
        except BlockingIOError:
            return b""
        except OSError as error:
            self._raise_lost(error)
        if not data:
            self._raise_lost(EOFError("end of file"))
        return data

    def _fd(self) -> int:
        if self.ser is None or self.ser.fd is None:
            self._raise_lost(OSError("the port is closed"))
        return self.ser.fd

    def _raise_lost(self, error: Exception) -> NoReturn:
        self.is_using = False
        raise DeviceLostError(
            f"the servo's port {self.port_name} is gone ({error}); check cable and power, then start again"
        ) from error


class BorrowedPort:
    """A port of the caller's, an SDK `PortHandler` or the like. Never configures or closes it."""

    def __init__(self, name: str, handler: Any, reply_margin_ms: float) -> None:
        """Checks that the port is open.

        Args:
            name: Name for messages.
            handler: The caller's port.
            reply_margin_ms: Reply timeout beyond the transmission time; the SDK's own is 34 ms.

        Raises:
            DeviceError: The port is not open.
        """
        if not getattr(handler, "is_open", True):
            raise DeviceError(f"the shared port {name} is not open; call its openPort() first")
        self._name, self._handler = name, handler
        self._reply_margin_ms = reply_margin_ms
        self._sent_bytes = 0

    @property
    def is_using(self) -> bool:
        """True during a transaction."""
        return bool(self._handler.is_using)

    @is_using.setter
    def is_using(self, value: bool) -> None:
        self._handler.is_using = value

    def closePort(self) -> None:  # noqa: N802
        """Has no effect: the caller closes the port."""

    def clearPort(self) -> None:  # noqa: N802
        """Discards received bytes."""
        self._call(self._handler.clearPort)

    def writePort(self, packet: Iterable[int]) -> int:  # noqa: N802
        """Sends a packet and returns the number of bytes accepted."""
        data = bytes(packet)
        self._sent_bytes = len(data)
        return self._call(lambda: int(self._handler.writePort(data)))

    def readPort(self, length: int) -> bytes:  # noqa: N802
        """Returns up to ``length`` received bytes."""
        data = self._call(lambda: bytes(self._handler.readPort(length)))
        if not data:
            time.sleep(_POLL_S)
        return data

    def setPacketTimeout(self, packet_length: int) -> None:  # noqa: N802
        """Starts the timeout: time of the request and a reply of ``packet_length`` bytes, plus margin."""
        wire_ms = 10_000.0 / self._handler.getBaudRate() * (packet_length + self._sent_bytes)
        self._handler.setPacketTimeoutMillis(wire_ms + self._reply_margin_ms)

    def isPacketTimeout(self) -> bool:  # noqa: N802
        """Returns True once the reply timeout has passed."""
        return bool(self._handler.isPacketTimeout())

    def drain(self) -> None:
        """Discards received bytes until the reply timeout ends."""
        while not self.isPacketTimeout():
            self.readPort(_MAX_REPLY_BYTES)

    def _call(self, action: Callable[[], _T]) -> _T:
        try:
            return action()
        except (OSError, termios.error, AttributeError, TypeError) as error:  # closed: `ser` is None
            self.is_using = False
            raise DeviceLostError(
                f"the shared port {self._name} is gone or closed ({error}); check cable and power, keep it open "
                "as long as the gripper, then start again"
            ) from error
