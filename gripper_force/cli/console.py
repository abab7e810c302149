"""Output for people (tables and progress) and for scripts (one JSON object on stdout)."""

import json
import math
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as ProgressBar
from rich.table import Column, Table

from gripper_force.errors import ConfigError, GripperError

if TYPE_CHECKING:  # --help loads no NumPy
    from rich.status import Status

    from gripper_force.interfaces import Progress, Prompt

err = Console(stderr=True, highlight=False)
out = Console(highlight=False)

T = TypeVar("T")


@contextmanager
def bar(label: str, total: int, *, hidden: bool = False) -> "Iterator[Progress]":
    """Shows a progress bar on stderr, unless it is hidden, and gives its `Progress` callback."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with ProgressBar(*columns, TextColumn("{task.fields[note]}"), console=err, disable=hidden) as shown:
        task = shown.add_task(label, total=total, note="")
        yield lambda text, steps=1: shown.update(task, advance=steps, note=text)


@contextmanager
def lines(label: str, total: int) -> "Iterator[Progress]":
    """Like `bar` for a log file: prints a line on stderr for each report of progress."""
    done = 0

    def show(text: str, steps: int = 1) -> None:
        nonlocal done
        done += steps
        line(f"{label}: {done} of {total}, {text}")

    yield show


def line(text: str, steps: int = 1) -> None:
    """Prints a line on stderr for each report of progress."""
    err.print(f"[dim]{escape(text)}[/]", soft_wrap=True)


def warn(text: str) -> None:
    """Prints a warning on stderr."""
    err.print(f"[yellow]warning:[/] {escape(text)}", soft_wrap=True)


def prompt(yes: bool, status: "Status | None" = None) -> "Prompt":
    """Returns a prompt that waits for Enter, or with ``yes`` only prints. Meanwhile ``status`` is hidden."""

    def ask(text: str) -> None:
        if yes:
            err.print(text, soft_wrap=True)
            return
        if not sys.stdin.isatty():
            raise ConfigError(
                f"this needs a person at a terminal: {text}; run it in a terminal, or pass --yes if it is done"
            )
        if status is not None:
            status.stop()
        err.print(f"{text}, then press Enter ", end="", soft_wrap=True)
        answer = ""
        try:
            answer = sys.stdin.readline()
        finally:
            if not answer:  # Ctrl-C, Ctrl-D, or the terminal was closed
                err.print()
        if not answer:
            raise ConfigError(f"no answer to this: {text}; run it again and press Enter")
        if status is not None:
            status.start()

    return ask


def show(result: T, as_json: bool, render: Callable[[T], object] | None = None) -> None:
    """Prints a result as one JSON object, or for a person: with ``render``, or as names and values.

    Args:
        result: A dictionary or a dataclass.
        as_json: True for JSON.
        render: Prints the result for a person.
    """
    if as_json:
        sys.stdout.write(json.dumps(jsonable(result), allow_nan=False) + "\n")
    elif render is None:
        pairs(jsonable(result))
    else:
        render(result)


def jsonable(value: Any) -> Any:
    """Converts a value for JSON; NaN and infinity become null."""
    if isinstance(value, dict):
        return {str(key): jsonable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [jsonable(item) for item in value]
    if hasattr(value, "model_dump"):
        return jsonable(value.model_dump(mode="json"))
    if hasattr(value, "__dataclass_fields__"):
        return {name: jsonable(getattr(value, name)) for name in value.__dataclass_fields__}
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value


def end_with_failures(failed: Mapping[str, object], count: int) -> None:
    """Prints the problem of each of ``count`` logs that failed, and ends with exit code 2 if there are any."""
    if not failed:
        return
    for problem in failed.values():
        err.print(f"[bold red]error:[/] {escape(str(problem))}", soft_wrap=True)
    err.print(f"{len(failed)} of {count} logs are not part of the figures")
    raise typer.Exit(2)


def number(value: object, unit: str = "", digits: int = 3) -> str:
    """Formats a figure with its unit; a dash for a missing value."""
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "-"
    return f"{value:.{digits}f}{unit}" if isinstance(value, float) else f"{value}{unit}"


def pairs(values: Mapping[str, object]) -> None:
    """Prints names and values."""
    table = Table("", Column("", overflow="fold"), box=None, show_header=False, pad_edge=False)
    for name, value in values.items():
        table.add_row(f"[dim]{name}[/]", number(value))
    out.print(table)


def plain(error: GripperError) -> str:
    """An error's message with its brackets escaped, so that they are not markup."""
    return str(error).replace("[", r"\[")
