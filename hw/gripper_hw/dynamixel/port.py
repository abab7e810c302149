"""What the vendor's SDK talks through: a quiet serial line, or a virtual bus (see `memory_port`).

Both raise `DeviceLostError` once the other end is gone, where the SDK's own would report "busy" for good.
"""

import contextlib
import os
import select
import termios
import time
from collections.abc import Iterable
from typing import Final, NoReturn, Protocol

import serial
from dynamixel_sdk import PortHandler

from gripper_force.errors import ConfigError, DeviceLostError
from gripper_hw.serial_line import open_line

VIRTUAL_PREFIX: Final = "virtual:"

_MAX_BYTES: Final = 4096  # what a scan of all ids brings; more is a line that never falls silent


class Port(Protocol):
    """What the driver needs beyond the SDK's `PortHandler`."""

    is_using: bool

    def closePort(self) -> None:  # noqa: N802
        """Releases the port. May be called twice."""
        ...

    def drain(self) -> None:
        """Throws away what comes until the time for an answer is over."""
        ...


def open_port(name: str, baud_rate: int, reply_margin_ms: float) -> Port:
    """Opens a port, exclusively.

    Args:
        name: A device path, or ``virtual:<name>`` for a bus registered in this process.
        baud_rate: Bits a second.
        reply_margin_ms: Time a reply may be late beyond its own length on the wire.

    Raises:
        ConfigError: The adapter does not do this baud rate.
        DeviceNotFoundError: There is no such port.
        DeviceError: The port is in use, or may not be opened.
    """
    if name.startswith(VIRTUAL_PREFIX):
        from gripper_hw.dynamixel.memory_port import MemoryPort

        return MemoryPort(name, name.removeprefix(VIRTUAL_PREFIX))
    port = SerialPort(name, reply_margin_ms)
    if not port.setBaudRate(baud_rate):
        raise ConfigError(f"servo.baud_rate {baud_rate} is none that Dynamixel adapters do; use e.g. 1000000")
    return port


class SerialPort(PortHandler):  # type: ignore[misc]
    """A serial line that sleeps until bytes come, where the SDK's own polls for them."""

    def __init__(self, name: str, reply_margin_ms: float) -> None:
        super().__init__(name)
        self.ser: serial.Serial | None = None
        self._margin_ms = reply_margin_ms
        self._sent = 0
        self._left = 0

    def setupPort(self, cflag_baud: int) -> bool:  # noqa: N802
        """Opens the line. Raises as `open_port` says."""
        self.closePort()
        self.ser = open_line(self.port_name, cflag_baud, unit="servo", timeout_s=0)
        # Only some adapters, and no pseudo-terminal, have a latency timer.
        with contextlib.suppress(ValueError, OSError):
            self.ser.set_low_latency_mode(True)
        self.is_open = True
        self.tx_time_per_byte = 10_000.0 / cflag_baud
        return True

    def closePort(self) -> None:  # noqa: N802
        """Closes the line. May be called twice."""
        self.is_open = False
        self.is_using = False
        if self.ser is not None:
            with contextlib.suppress(OSError, termios.error):
                self.ser.close()
            self.ser = None

    def clearPort(self) -> None:  # noqa: N802
        """Throws away what was received."""
        try:
            termios.tcflush(self._fd(), termios.TCIFLUSH)
        except (OSError, termios.error) as error:
            self._lost(error)

    def writePort(self, packet: Iterable[int]) -> int:  # noqa: N802
        """Sends a packet and returns how many bytes were taken."""
        data = bytes(packet)
        self._sent = len(data)
        self._left = _MAX_BYTES
        try:
            return os.write(self._fd(), data)
        except BlockingIOError:
            return 0
        except OSError as error:
            self._lost(error)

    def readPort(self, length: int) -> bytes:  # noqa: N802
        """Returns up to ``length`` bytes, as soon as there is one, or none once the packet's time is over."""
        length = min(length, self._left)
        if length <= 0:
            return b""
        left_s = (self.packet_start_time + self.packet_timeout - self.getCurrentTime()) / 1e3
        data = self._read(length, max(0.0, left_s))
        self._left -= len(data)
        return data

    def getCurrentTime(self) -> float:  # noqa: N802
        """Monotonic time in ms; the SDK's own steps with the wall clock."""
        return time.monotonic() * 1e3

    def setPacketTimeout(self, packet_length: int) -> None:  # noqa: N802
        """Starts the time for a reply of ``packet_length`` bytes; the instruction is still on its way out."""
        self.setPacketTimeoutMillis(self.tx_time_per_byte * (packet_length + self._sent) + self._margin_ms)

    def drain(self) -> None:
        """Throws away what comes until the time for an answer is over."""
        while not self.isPacketTimeout():
            self.readPort(_MAX_BYTES)

    def _read(self, length: int, timeout_s: float) -> bytes:
        try:
            fd = self._fd()
            waiting = select.poll()  # `select.select` fails for descriptors from 1024 on
            waiting.register(fd, select.POLLIN)
            if not waiting.poll(1e3 * timeout_s):
                return b""
            data = os.read(fd, length)
        except BlockingIOError:
            return b""
        except OSError as error:
            self._lost(error)
        if not data:
            self._lost(EOFError("end of file"))
        return data

    def _fd(self) -> int:
        if self.ser is None or self.ser.fd is None:
            self._lost(OSError("the port is closed"))
        return self.ser.fd

    def _lost(self, error: Exception) -> NoReturn:
        self.is_using = False
        raise DeviceLostError(
            f"the servo's port {self.port_name} is gone ({error}); check cable and power, then start again"
        ) from error
