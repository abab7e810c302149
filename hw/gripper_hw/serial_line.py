"""Exclusive opening of serial ports."""

import termios
from errno import EACCES, EAGAIN, EBUSY
from pathlib import Path

import serial

from gripper_force.errors import DeviceError, DeviceNotFoundError


def open_line(name: str, baud_rate: int, *, unit: str, timeout_s: float | None) -> serial.Serial:
    """Opens a serial port exclusively.

    Args:
        name: Device path.
        baud_rate: Bits per second.
        unit: Configuration section that names the port: ``servo`` or ``load_cell``.
        timeout_s: Read timeout; None: a read blocks until a byte is available.

    Raises:
        DeviceNotFoundError: The port does not exist.
        DeviceError: The port is in use, not permitted, or not a serial port.
    """
    try:
        return serial.Serial(name, baud_rate, timeout=timeout_s, exclusive=True)
    except (OSError, ValueError, termios.error) as error:
        raise _open_error(name, unit, error) from error


def _open_error(name: str, unit: str, error: Exception) -> DeviceError:
    port = f"the {unit.replace('_', ' ')}'s port {name}"
    if not Path(name).exists():
        return DeviceNotFoundError(
            f"there is no port {name}; plug it in, or set {unit}.port to one of /dev/serial/by-id"
        )
    if isinstance(error, OSError) and error.errno == EACCES:
        return DeviceError(f"no permission to open {port}; join the group dialout and log in again")
    if isinstance(error, OSError) and error.errno in (EAGAIN, EBUSY):
        return DeviceError(f"{port} is in use by another program; close that first")
    return DeviceError(f"can't open {port} ({error}); set {unit}.port to a serial port")
