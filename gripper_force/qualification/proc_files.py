"""The kernel's figures of a process: files that only Linux has (https://man7.org/linux/man-pages/man5/proc.5.html)."""

import resource
from pathlib import Path

from gripper_force.errors import ConfigError


def process_text(name: str) -> str:
    """Returns the text of a file in ``/proc/self``. Raises `ConfigError` on a system without it."""
    path = Path("/proc/self", name)
    try:
        return path.read_text(encoding="ascii")
    except FileNotFoundError as error:
        raise ConfigError(f"this command reads {path}, which only Linux has; run it on Linux") from error


def memory_bytes() -> tuple[int, int]:
    """Returns the size of the address space and of the resident memory. Raises `ConfigError` without Linux."""
    space, resident = process_text("statm").split()[:2]
    return int(space) * resource.getpagesize(), int(resident) * resource.getpagesize()
