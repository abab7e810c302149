"""Time and memory of commands."""

import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from gripper_force.errors import GripperError

COMMANDS: Final = (
    "--help",
    "grasp",
    "replay runs/*.mcap --report",
    "grasp --trials 8",
    "record --object tube --sets 1 --out recorded",
    "simulate --presses 8 --grasps 0 --first-seed 800000 --out data",
    "simulate --presses 0 --grasps 4 --first-seed 801000 --out tests",
    "train data --out force.safetensors --set steps=20",
    "evaluate tests --checkpoint force.safetensors",
    "export --out force.xml",
    "calibrate servo --gauge-mm 30 --yes --set object=block --rig rig_profile.yaml",
    "calibrate camera --object sponge --seed 3 --set sim.markers=true --rig rig_profile.yaml",
    "calibrate object tube --touches 3 --folder touches --out tube.yaml",
    "reproduce 7",
    "stability numerics --part filter",
    "stability fuzz --cases 10000",
    "stability soak --seconds 60",
    "bench bus --cycles 100",
    "doctor",
)
"""Command lines that `commands` runs, in this order and in one folder: some use files of earlier ones."""

_ALLOWED: Final = (0, 1)
"""Exit codes of a command that ran; 1 for a bad result."""


@dataclass(frozen=True, slots=True)
class CommandCost:
    """Cost of a command.

    Attributes:
        command: Arguments of ``gripper-force``.
        wall_s: Duration.
        cpu_s: CPU time of all its processes.
        memory_mb: Peak resident memory of its largest process.
    """

    command: str
    wall_s: float
    cpu_s: float
    memory_mb: float


def commands(lines: Sequence[str] = COMMANDS) -> Iterator[CommandCost]:
    """Runs commands, each in its own process, in a temporary folder.

    Raises:
        GripperError: A command failed.
    """
    with TemporaryDirectory() as name:
        folder = Path(name)
        for line in lines:
            words = [found for word in line.split() for found in _expanded(folder, word)]
            with (folder / "stderr").open("w+", encoding="utf-8") as stderr:
                begin_s = time.monotonic()
                process = subprocess.Popen(
                    [sys.executable, "-c", "from gripper_force.cli import main; main()", *words],
                    cwd=folder,
                    stdout=subprocess.DEVNULL,
                    stderr=stderr,
                )
                _, status, usage = os.wait4(process.pid, 0)
                process.returncode = os.waitstatus_to_exitcode(status)
                wall_s = time.monotonic() - begin_s
                if process.returncode not in _ALLOWED:
                    stderr.seek(0)
                    raise GripperError(f"gripper-force {line} failed: {stderr.read().strip()[-500:]}")
            yield CommandCost(
                line, wall_s, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / _maxrss_per_mb()
            )


def _maxrss_per_mb() -> int:
    """Returns the unit of ``ru_maxrss``: macOS counts bytes, Linux kilobytes."""
    return 2**20 if sys.platform == "darwin" else 2**10


def _expanded(folder: Path, word: str) -> list[str]:
    return [str(path.relative_to(folder)) for path in folder.glob(word)] if "*" in word else [word]
