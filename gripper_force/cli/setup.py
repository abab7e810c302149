"""The command `setup`, and the person or script that answers it."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from gripper_force.cli import console
from gripper_force.cli.options import AsJson, Overrides
from gripper_force.cli.output.setup import step_lines
from gripper_force.errors import ConfigError, GripperError

if TYPE_CHECKING:
    from rich.status import Status

    from gripper_calibration.setup.run import Setup

T = TypeVar("T")


def setup(
    config: Annotated[
        Path, typer.Option("--config", help="Rig file to write; an existing one is continued.")
    ] = Path("rig.yaml"),
    step: Annotated[
        list[str] | None,
        typer.Option(help="Run only this step: scan, servo, jaws, camera, load-cell or torque. Repeatable."),
    ] = None,
    fresh: Annotated[
        bool,
        typer.Option(
            "--fresh", help="Start over: forget what earlier steps found. A copy of the rig file is kept."
        ),
    ] = False,
    mass_kg: Annotated[
        float | None,
        typer.Option(help="Known mass for the load cell. Without a load cell it hangs from one jaw."),
    ] = None,
    gauge_mm: Annotated[
        float | None, typer.Option(help="Width of the load cell between the jaws, for the torque constant.")
    ] = None,
    yes: Annotated[
        bool,
        typer.Option("--yes", help="Do not ask: answer yes, take defaults, and write to the servo's EEPROM."),
    ] = False,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Set up a rig step by step, and write one file for `grasp --config`. Continues after the last finished step."""
    from gripper_calibration.setup.run import Setup

    running = Setup(config, set_, only=step, fresh=fresh, mass_kg=mass_kg, gauge_mm=gauge_mm)
    reports = []
    with console.err.status("setting up") as status:
        person = _Terminal(yes, status)
        try:
            for report in running.run(person, console.status_text(status)):
                step_lines(report)
                reports.append(report)
        except (GripperError, KeyboardInterrupt):
            status.stop()
            if running.rig.path.exists():
                console.tell_resumable(f"what was found so far is in {config}", fresh=fresh)
            raise
    words = _next_words(running, config)
    result = {"rig": config, "steps": reports, "next": console.command(*words)}
    console.show(
        result, as_json, lambda _: console.out.print(f"rig file: {config}", soft_wrap=True, markup=False)
    )
    console.next_step(*words)


def _next_words(running: "Setup", path: Path) -> list[str]:
    """Returns the words of the next command: `setup` while steps are left; `teach` needs camera and load cell."""
    settings, options = running.config, ["--config", str(path)]
    if running.pending:
        return ["setup", *options]
    if settings.uses_vision and settings.load_cell.backend != "none":
        return ["teach", "NAME", *options]
    return ["grasp", *options, "--target-n", "3"]


class _Terminal:
    """Asks at the terminal, or with ``yes`` answers for the person. Implements `gripper_calibration`'s `Person`."""

    def __init__(self, yes: bool, status: "Status") -> None:
        self._yes, self._status = yes, status
        self.do = console.prompt(yes, status)

    def tell(self, text: str) -> None:
        console.err.print(text, soft_wrap=True, markup=False)

    def agrees(self, question: str) -> bool:
        if self._yes:
            self.tell(f"{question} yes")
            return True
        return self._ask(question, lambda: typer.confirm(question, default=None, err=True), "--yes")

    def choose(self, question: str, answers: Sequence[str], option: str) -> str:
        asked = f"{question} ({', '.join(answers)})"
        if self._yes:
            raise ConfigError(f"this needs an answer: {asked}; pass {option}")
        while True:
            answer = self._ask(asked, lambda: typer.prompt(asked, err=True), option)
            if answer in answers:
                return str(answer)
            self.tell(f"answer one of {', '.join(answers)}")

    def number(self, question: str, option: str, default: float | None = None) -> float:
        from gripper_calibration.setup.step import is_answer

        if self._yes:
            if default is None:
                raise ConfigError(f"this needs an answer: {question}; pass {option}")
            self.tell(f"{question}: {default:g} (default)")
            return default
        while True:
            answer = self._ask(
                question, lambda: typer.prompt(question, default, type=float, err=True), option
            )
            if is_answer(number := float(answer), default):
                return number
            self.tell(f"{number:g} is not possible; answer with a positive number")

    def _ask(self, question: str, ask: Callable[[], T], option: str) -> T:
        self._status.stop()
        with console.answering(f"this was not answered: {question}; pass {option} in scripts"):
            answer = ask()
        self._status.start()
        return answer
