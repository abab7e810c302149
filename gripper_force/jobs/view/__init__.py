"""Live view: a run in Rerun or Foxglove, from its log, also while the log is being written.

A viewer runs in a process of its own and reads the log file, so it can't delay the control loop (decision 35).
"""

import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from shlex import quote
from typing import Any, Final, Protocol

from gripper_force import plugins
from gripper_force.errors import ConfigError, DataError, LogError
from gripper_force.runtime.log_reader import LogReader
from gripper_force.types import Record

VIEWERS: Final = ("rerun", "foxglove")
"""Viewers, each with the name of the module that it needs. The first is the default."""

OLDEST: Final = {"rerun": "0.41", "foxglove": "0.30"}
"""Oldest version of each SDK that works, as in ``pyproject.toml``. Other packages, such as LeRobot, bring others."""

FOXGLOVE_LAYOUT: Final = Path(__file__).with_name("foxglove_layout.json")
"""Layout to import in Foxglove, for live data and for log files."""

_POLL_S: Final = 0.02
_NICENESS: Final = 19
"""A viewer beside a run gets only the time that the run leaves."""

_PATIENCE_S: Final = 10.0
"""Time that a viewer gets at the end of a run to show the rest."""


class Viewer(Protocol):
    """Program that shows records."""

    def show(self, log: LogReader, record: Record) -> None:
        """Shows the next record of a log."""

    def close(self) -> None:
        """Sends everything, and ends the connection."""


def require(viewer: str) -> None:
    """Checks that a viewer is known and installed.

    Raises:
        ConfigError: It is not, or too old.
    """
    if viewer not in VIEWERS:
        raise ConfigError(f"{viewer!r} is not a viewer; use one of {', '.join(VIEWERS)}")
    plugins.require(viewer, f"the viewer {viewer}")
    package, oldest = f"{viewer}-sdk", OLDEST[viewer]
    if _release(installed := metadata.version(package)) < _release(oldest):
        raise ConfigError(
            f"the viewer {viewer} needs {package} {oldest}, but {installed} is installed; pip install "
            "'gripper-force[view]', in a separate environment if another package needs the old one"
        )


def _release(version: str) -> list[int]:
    """Returns the first two numbers of a version."""
    return [int(number) for number in re.findall(r"\d+", version)[:2]]


class GrowingLog(LogReader):
    """A log that is being written: `records` waits for the next ones until the log is complete.

    Args:
        path: The file, which need not exist yet.
        wait: Called while there is nothing new; returns False to end.

    Raises:
        LogError: The file is not a log, or there was none in the end.
    """

    def __init__(self, path: Path, wait: Callable[[], bool]) -> None:
        self._wait = wait
        while not self._is_open(path):
            if not wait():
                raise LogError(f"{path} was not written; start the run that writes it")

    def _is_open(self, path: Path) -> bool:
        """Opens the file once its configuration has been written."""
        if not path.exists():
            return False
        try:
            super().__init__(path, recover=True)
        except LogError:
            if not path.exists():  # a run without a cycle deletes it
                return False
            if not self._scan_end or self.complete or path.stat().st_size > _HEAD_BYTES:
                raise
            return False
        return True

    def _chunks_to_read(self) -> Iterator[Any]:
        count = 0
        while True:
            new_chunks = self._chunks[count:]
            yield from new_chunks
            count += len(new_chunks)
            if self.complete or not (new_chunks or self._wait()):
                return
            with self.path.open("rb") as file:
                self._scan(file)


_HEAD_BYTES: Final = 1 << 20
"""A log holds its configuration before this position."""


def wait_for_writer() -> Callable[[], bool]:
    """Returns a wait for `GrowingLog` that ends with the process that started this one."""
    parent = os.getppid()

    def wait() -> bool:
        time.sleep(_POLL_S)
        return os.getppid() == parent

    return wait


def show(log: LogReader, viewer: Viewer) -> None:
    """Shows all records of a log, and closes the viewer.

    Raises:
        LogError: The log is damaged.
    """
    try:
        for record in log.records():
            viewer.show(log, record)
    finally:
        viewer.close()


@contextmanager
def beside_run(
    path: Path,
    viewer: str,
    tell: Callable[[str], None],
    save: Path | None = None,
    connect: Callable[[str], None] | None = None,
) -> Iterator[None]:
    """Opens a viewer in a process of its own, which shows a log from its first record on.

    Args:
        path: The log that the run will write.
        viewer: One of `VIEWERS`.
        tell: Called with one sentence for a person.
        save: File for Rerun (``.rrd``) to write instead of opening a window.
        connect: Called with the address of Foxglove's server, instead of ``tell``, to connect a client: the server
            waits for one.

    Raises:
        ConfigError: The viewer is unknown or not installed.
        DataError: The viewer did not start.
    """
    require(viewer)
    options = ["--viewer", viewer, "--follow", "--json"] + ([] if save is None else ["--save", str(save)])
    command = [sys.executable, "-m", "gripper_force", "view", str(path), *options]
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,  # messages, and an error too
        stderr=subprocess.DEVNULL,
        text=True,
        preexec_fn=lambda: os.nice(_NICENESS),
    ) as process:
        try:
            tell("starting the viewer; the run begins when it is ready")
            assert process.stdout is not None
            while not (state := json.loads(process.stdout.readline() or '{"ended": true}')).get("ready"):
                if "ended" in state or "error" in state:
                    raise DataError(f"the viewer did not start: {state.get('error', 'it ended at once')}")
                if connect is not None and "url" in state:
                    connect(state["url"])
                else:
                    tell(state["text"])
            yield
            process.wait(_PATIENCE_S)
        except subprocess.TimeoutExpired:
            tell(
                f"the viewer is behind and was ended; show the whole run with: gripper-force view {quote(str(path))}"
            )
        finally:
            process.terminate()
