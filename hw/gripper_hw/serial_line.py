"""Exclusive opening of serial ports, see docs/decisions/0019-a-port-has-one-user.md."""

import fcntl
import os
import sys
import termios
from collections.abc import Iterator
from contextlib import suppress
from errno import EACCES, EAGAIN, EBUSY
from pathlib import Path
from typing import Final

import serial

from gripper_force.errors import DeviceError, DeviceNotFoundError

_TIOCGEXCL: Final = 0x80045440  # include/uapi/asm-generic/ioctls.h; not in Python's termios


class ExclusiveSerial(serial.Serial):
    """Serial port that no other program can open: locked (flock), and in the kernel's exclusive mode."""

    def close(self) -> None:
        """Ends the exclusive mode, which a pseudo-terminal would otherwise keep, and closes the port."""
        if self.fd is not None:
            with suppress(OSError, termios.error):
                fcntl.ioctl(self.fd, termios.TIOCNXCL)
        super().close()


def open_line(name: str, baud_rate: int, *, unit: str, timeout_s: float | None) -> serial.Serial:
    """Opens a serial port exclusively.

    Args:
        name: Device path.
        baud_rate: Bits per second.
        unit: Configuration section that names the port: ``servo`` or ``load_cell``.
        timeout_s: Read timeout; None: a read blocks until a byte is available.

    Raises:
        DeviceNotFoundError: The port does not exist.
        DeviceError: Another program uses the port, it is not permitted, or not a serial port.
    """
    try:
        line = ExclusiveSerial(name, baud_rate, timeout=timeout_s, exclusive=True)
        try:
            _claim(line.fileno(), name)
        except BaseException:
            serial.Serial.close(line)  # without ending the other program's exclusive mode
            raise
    except (OSError, ValueError, termios.error) as error:
        raise _open_error(name, unit, error) from error
    return line


def _claim(fd: int, name: str) -> None:
    """Sets the exclusive mode. Raises `OSError` (EBUSY) if another program uses the port."""
    # Root may open a port in exclusive mode, and anyone one that is open without it.
    # macOS has no way to ask, and no /proc: there the lock alone keeps two runs apart.
    linux = sys.platform == "linux"
    if (linux and any(fcntl.ioctl(fd, _TIOCGEXCL, bytes(4)))) or any(_users(name)):
        raise OSError(EBUSY, os.strerror(EBUSY))
    fcntl.ioctl(fd, termios.TIOCEXCL)


def _users(name: str) -> Iterator[str]:
    """Yields the other processes that have a port open, as far as this user may see them."""
    device = str(Path(name).resolve())
    for process in Path("/proc").glob("[0-9]*"):
        if process.name == str(os.getpid()):
            continue
        with suppress(OSError):  # it ended, or belongs to another user
            files = {entry.name: str(entry.readlink()) for entry in (process / "fd").iterdir()}
            if device in files.values() and not _is_terminal_of(process, files, device):
                yield f"{(process / 'comm').read_text().strip()} (process {process.name})"


def _is_terminal_of(process: Path, files: dict[str, str], device: str) -> bool:
    """Returns True if the process serves a pseudo-terminal, as `gripper-force virtual-servo` does."""
    index = f"tty-index:\t{Path(device).name}\n"
    masters = (number for number, target in files.items() if target.endswith("ptmx"))
    return any(index in (process / "fdinfo" / number).read_text() for number in masters)


def _open_error(name: str, unit: str, error: Exception) -> DeviceError:
    port = f"the {unit.replace('_', ' ')}'s port {name}"
    if not Path(name).exists():
        return DeviceNotFoundError(
            f"there is no port {name}; plug it in, or set {unit}.port to one of /dev/serial/by-id"
        )
    if isinstance(error, OSError) and error.errno == EACCES:
        return DeviceError(f"no permission to open {port}; join the group dialout and log in again")
    if isinstance(error, OSError) and error.errno in (EAGAIN, EBUSY):
        user = " and ".join(_users(name)) or "this program, or one that it can't see"
        return DeviceError(f"{port} is in use by {user}; close that first")
    return DeviceError(f"can't open {port} ({error}); set {unit}.port to a serial port")
