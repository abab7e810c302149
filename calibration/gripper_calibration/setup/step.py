"""Vocabulary of the steps of a setup: what a step gets, asks and finds."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol

from gripper_force.config import Config
from gripper_force.errors import ConfigError
from gripper_force.progress import Progress


class Person(Protocol):
    """The person who sets up the rig, or a script that answers with yes and with defaults."""

    def tell(self, text: str) -> None:
        """Shows a remark."""

    def do(self, text: str) -> None:
        """Asks for an action and returns once it is done."""

    def agrees(self, question: str) -> bool:
        """Asks a question whose answer is yes or no. A script answers yes."""

    def choose(self, question: str, answers: Sequence[str], option: str) -> str:
        """Returns one of the answers. A script can't choose: `ConfigError` names its ``option``."""

    def number(self, question: str, option: str, default: float | None = None) -> float:
        """Returns a number that `is_answer` accepts.

        A script takes the default; without one `ConfigError` names its ``option``.
        """


def is_answer(number: float, default: float | None) -> bool:
    """Returns True if a number can answer a question for a length or a mass: it is positive, or the default."""
    return number == default or 0 < number < math.inf


ANSWERED: Final = "as you answered"
"""Origin of a value that a person gave when asked."""


class Found(NamedTuple):
    """A value for the rig file and its origin, for the comment behind it."""

    value: Any
    origin: str


@dataclass(frozen=True, slots=True)
class Task:
    """Configuration, files and person that a step works with.

    Attributes:
        config: The configuration so far.
        given: Paths of the keys that the rig file or ``--set`` states.
        folder: Folder for pictures and measurements.
        person: Answers questions.
        progress: Called with what the devices do.
        mass_kg: Known mass for the load cell, or without one for a jaw, if it was given.
        gauge_mm: Width of the load cell between the jaws, if it was given.
        keep: Writes values into the rig file at once, because a device has them already.
    """

    config: Config
    given: Mapping[str, Any]
    folder: Path
    person: Person
    progress: Progress
    mass_kg: float | None = None
    gauge_mm: float | None = None
    keep: Callable[[Mapping[str, Found]], None] = lambda values: None

    def number(self, question: str, option: str, default: float | None = None) -> float:
        """Asks the person for a number.

        Raises:
            ConfigError: The answer is not a positive number, or a script has no answer.
        """
        number = self.person.number(question, option, default)
        if not is_answer(number, default):
            raise ConfigError(
                f"{number:g} can't answer this: {question}; give a positive number, or pass {option}"
            )
        return number


@dataclass(frozen=True, slots=True)
class StepResult:
    """Result of a step.

    Attributes:
        summary: One sentence.
        values: Keys for the rig file.
        remarks: What a person should know.
        files: Pictures, by what they show.
        details: Anything else for scripts.
        used: Mass or width that was given or asked for, by the name in `Task`.
    """

    summary: str
    values: Mapping[str, Found] = field(default_factory=dict)
    remarks: Sequence[str] = ()
    files: Mapping[str, Path] = field(default_factory=dict)
    details: Mapping[str, Any] = field(default_factory=dict)
    used: Mapping[str, float] = field(default_factory=dict)
