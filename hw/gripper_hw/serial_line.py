"""Opens a serial line for one program alone, and says in a sentence why it can't."""

import termios
from errno import EACCES, EAGAIN, EBUSY
from pathlib import Path

import serial

from gripper_force.errors import DeviceError, DeviceNotFoundError


def open_line(name: str, baud_rate: int, *, unit: str, timeout_s: float | None) -> serial.Serial:
    """Opens a port, exclusively.

    Args:
        name: A device path.
        baud_rate: Bits a second.
        unit: Section of the configuration that names the port: ``servo`` or ``load_cell``.
        timeout_s: How long a read waits; None: until a byte is there.

    Raises:
        DeviceNotFoundError: There is no such port.
        DeviceError: It is in use, may not be opened, or is no serial line.
    """
    try:
        return serial.Serial(name, baud_rate, timeout=timeout_s, exclusive=True)
    except (OSError, ValueError, termios.error) as error:
        raise _open_error(name, unit, error) from error


def _open_error(name: str, unit: str, error: Exception) -> DeviceError:
    whose = f"the {unit.replace('_', ' ')}'s port {name}"
    if not Path(name).exists():
        return DeviceNotFoundError(
            f"there is no port {name}; plug it in, or set {unit}.port to one of /dev/serial/by-id"
        )
    if isinstance(error, OSError) and error.errno == EACCES:
        return DeviceError(f"no permission to open {whose}; join the group dialout and log in again")
    if isinstance(error, OSError) and error.errno in (EAGAIN, EBUSY):
        return DeviceError(f"{whose} is in use by another program; close that first")
    return DeviceError(f"can't open {whose}: {error}")
