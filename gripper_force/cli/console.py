"""Output for people (tables and progress) and for scripts (one JSON object on stdout)."""

import json
import math
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, TaskID, TextColumn, TimeRemainingColumn
from rich.progress import Progress as ProgressBar
from rich.table import Column, Table

from gripper_force.errors import ConfigError

if TYPE_CHECKING:  # --help loads no NumPy
    from contextlib import AbstractContextManager

    from rich.status import Status

    from gripper_force.progress import Progress, Prompt

err = Console(stderr=True, highlight=False)
out = Console(highlight=False)
if not out.is_terminal:
    out.width = 1000  # a file or a pipe has no width: a path must not be broken

_SPEED_S: Final = 3600.0
"""Time over which the speed of a job is averaged: a step of a training or of a matrix may take minutes."""

_UNITS: Final = {"n": "N", "s": "s", "ms": "ms", "mb": "MB", "mb_h": "MB/h", "percent": "%"}
_NAMES: Final = {"mae": "MAE", "rmse": "RMSE"}

T = TypeVar("T")


class Bar:
    """A running progress bar: a `Progress` callback that can be taken off the screen while a person is asked."""

    def __init__(self, progress_bar: ProgressBar, task: TaskID) -> None:
        self._progress_bar, self._task = progress_bar, task
        self.stop, self.start = progress_bar.stop, progress_bar.start
        self.has_progressed = False

    def __call__(self, text: str, steps: int = 1) -> None:
        """Reports progress, see `Progress`."""
        self.has_progressed |= not text.startswith("failed: ") and steps > 0
        self._progress_bar.update(self._task, advance=steps, note=text)


@contextmanager
def bar(label: str, total: int, *, hidden: bool = False) -> "Iterator[Bar]":
    """Shows a progress bar with the remaining time on stderr, unless it is hidden, and gives its callback."""
    remaining = TimeRemainingColumn(elapsed_when_finished=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), remaining)
    note = TextColumn("{task.fields[note]}", markup=False)
    progress_bar = ProgressBar(*columns, note, console=err, disable=hidden, speed_estimate_period=_SPEED_S)
    callback = Bar(progress_bar, progress_bar.add_task(label, total=total, note=""))
    if err.is_terminal:  # elsewhere it is printed once, at its end
        progress_bar.start()
    try:
        yield callback
    except Exception:
        progress_bar.live.transient = not callback.has_progressed  # wrong input: the error says all
        raise
    finally:
        if hidden or progress_bar.live.transient:
            progress_bar.live.stop()
        else:
            progress_bar.start()
            progress_bar.stop()


def bar_or_lines(label: str, total: int) -> "AbstractContextManager[Progress]":
    """Returns `bar` on a terminal, and otherwise `lines`: for jobs so long that a log file should follow them."""
    return bar(label, total) if err.is_terminal else lines(label, total)


@contextmanager
def lines(label: str, total: int) -> "Iterator[Progress]":
    """Like `bar` for a log file: prints a line on stderr for each report of progress."""
    steps_done = 0

    def show(text: str, steps: int = 1) -> None:
        nonlocal steps_done
        steps_done += steps
        line(f"{label}: {steps_done} of {total}, {text}")

    yield show


def line(text: str, steps: int = 1) -> None:
    """Prints a line on stderr for each report of progress."""
    err.print(f"[dim]{escape(text)}[/]", soft_wrap=True)


def status_text(status: "Status") -> "Progress":
    """Returns a callback that shows each report of progress as the text of a status line."""
    return lambda text, steps=1: status.update(text)


@contextmanager
def answering(unanswered: str) -> Iterator[None]:
    """Converts the end of the input and Ctrl-C while its block asks a question with typer.

    Args:
        unanswered: Text of the error if the input ends.

    Raises:
        ConfigError: The input has ended.
        KeyboardInterrupt: Ctrl-C.
    """
    try:
        yield
    except typer.Abort as abort:
        err.print()
        if not isinstance(abort.__context__, EOFError):
            raise KeyboardInterrupt from abort  # typer would end with code 1
        raise ConfigError(unanswered) from abort


def warn(text: str) -> None:
    """Prints a warning on stderr."""
    err.print(f"[yellow]warning:[/] {escape(text)}", soft_wrap=True)


def warn_of_other_rig(differences: Iterable[str]) -> None:
    """Warns that logs differ from the one rig that the network learned from, if there are differences."""
    if texts := sorted(set(differences)):
        warn(f"the network learned from one rig only, and logs are of another: {'; '.join(texts)}")


def warn_of_contact_starts(left_out: int, logs: int, remedy: str = "") -> None:
    """Warns that logs were left out because they start in contact, if there are such logs."""
    if left_out:
        warn(f"left out {left_out} of {logs} logs, which start in contact{remedy}")


def command(*words: object) -> str:
    """Returns a command of gripper-force as a shell takes it, by its words."""
    return _as_typed("gripper-force", *words)


def _as_typed(*words: object) -> str:
    """Returns a command as a shell takes it. A path that begins with a dash would be an option, so it gets ``./``."""
    return shlex.join(
        f"./{word}" if isinstance(word, Path) and f"{word}".startswith("-") else str(word) for word in words
    )


def next_step(*words: object) -> None:
    """Prints the step that usually follows, as the last line: a command of gripper-force by its words."""
    err.print(f"next: {command(*words)}", soft_wrap=True, markup=False)


def next_page(page: Path) -> None:
    """Prints as the last line that this page is to be opened."""
    err.print(f"next: {_as_typed('open', page)}", soft_wrap=True, markup=False)


def tell_resumable(what: str, *, fresh: bool) -> None:
    """Prints after an interruption that the same command continues; with ``--fresh`` it would start over."""
    retry = "the same command without --fresh" if fresh else "the same command"
    err.print(f"{what}; {retry} continues there", soft_wrap=True, markup=False)


def prompt(
    yes: bool, status: "Status | Bar | None" = None, without: str = "pass --yes if it is done"
) -> "Prompt":
    """Returns a prompt that waits for Enter, or with ``yes`` only prints. Meanwhile ``status`` is hidden.

    Args:
        yes: True to only print.
        status: What to hide.
        without: What to do if there is no terminal, for the error.
    """

    def ask(text: str) -> None:
        if yes:
            err.print(text, soft_wrap=True)
            return
        if not sys.stdin.isatty():
            raise ConfigError(
                f"this needs a person at a terminal: {text}; run it in a terminal, or {without}"
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
        pairs({label(name): value for name, value in jsonable(result).items()})
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


def tell_missing_parquet(folder: Path | None) -> None:
    """Says before the work begins if a summary in this folder will lack the file of the estimates."""
    from gripper_force.jobs.summary_files import missing_parquet

    if folder is not None and (text := missing_parquet()):
        err.print(escape(text), soft_wrap=True)


def end_with_failures(
    failed: Mapping[str, object], count: int, unreported: Mapping[str, object] | None = None
) -> None:
    """Prints the problems of logs, and ends with exit code 2 if there are any.

    Args:
        failed: Problem of each of ``count`` logs that failed, by path.
        count: Number of all logs.
        unreported: Problem of each report that could not be written, by path of the log.
    """
    problems = [*failed.items(), *(unreported or {}).items()]
    if not problems:
        return
    for log, problem in problems:
        text = str(problem) if log in str(problem) else f"{log}: {problem}"
        err.print(f"[bold red]error:[/] {escape(text)}", soft_wrap=True)
    if failed:
        err.print(f"{len(failed)} of {count} logs are not part of the figures")
    raise typer.Exit(2)


def number(value: object, unit: str = "", digits: int = 3) -> str:
    """Formats a figure with its unit; a dash for a missing value."""
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "-"
    return f"{value:z.{digits}f}{unit}" if isinstance(value, float) else f"{value}{unit}"


def label(key: str) -> str:
    """Returns a key of JSON in plain words, with its unit at the end: ``mae_n`` as ``MAE, N``."""
    for suffix, unit in _UNITS.items():
        if key.endswith(f"_{suffix}"):
            return f"{label(key.removesuffix(f'_{suffix}'))}, {unit}"
    return " ".join(_NAMES.get(word, word) for word in key.split("_"))


def pairs(values: Mapping[str, object]) -> None:
    """Prints names and values."""
    table = Table("", Column("", overflow="fold"), box=None, show_header=False, pad_edge=False)
    for name, value in values.items():
        table.add_row(f"[dim]{escape(name)}[/]", escape(number(value)))
    out.print(table)
