"""File that takes each outcome at once, so that an interrupted matrix can be continued."""

import hashlib
import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Generic, TypeVar

from gripper_force import __version__
from gripper_force.config import Config, dump_config
from gripper_force.errors import DataError
from gripper_force.progress import Progress
from gripper_force.qualification.result_lines import whole_lines

T = TypeVar("T")


def collect(runs: Iterable[Callable[[], T]], name: str, progress: Progress) -> list[T]:
    """Returns the outcome of each run, and calls ``progress`` with the row's name after it."""
    outcomes = []
    for run in runs:
        outcomes.append(run())
        progress(name)
    return outcomes


class OutcomeFile(Generic[T]):
    """The outcomes of one matrix by key.

    Args:
        path: The file.
        config: Configuration that all outcomes must have been made with.
        resume: False to start with an empty file.

    Attributes:
        outcomes: Outcomes so far.

    Raises:
        DataError: The file can't be read or written, or was made with another configuration or version.
    """

    def __init__(self, path: Path, config: Config, *, resume: bool) -> None:
        self._path = path
        self._digest = hashlib.sha256(f"{__version__} {dump_config(config)}".encode()).hexdigest()
        self.outcomes: dict[str, T] = {}
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            if not (resume and path.exists()):
                path.write_text("", encoding="utf-8")
            for line in whole_lines(path):
                digest, key, outcome = json.loads(line)
                self.outcomes[key] = outcome
                if digest != self._digest:
                    raise DataError(
                        f"{path} was made with another configuration or version; run without --resume"
                    )
        except (OSError, ValueError, TypeError) as error:
            raise DataError(f"can't continue with {path}: {error}; run without --resume") from error

    def add(self, key: str, outcome: T) -> T:
        """Writes an outcome and returns it."""
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps([self._digest, key, outcome]) + "\n")
        return outcome
