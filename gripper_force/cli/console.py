"""What a person sees in a terminal, or a script on stdout: progress, names and values, one JSON object."""

import json
import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from gripper_force.errors import GripperError

err = Console(stderr=True, highlight=False)
out = Console(highlight=False)


@contextmanager
def bar(label: str, total: int) -> Iterator[Any]:
    """A progress bar on stderr; gives a function to call with a note, and with steps if not one."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, TextColumn("{task.fields[note]}"), console=err) as progress:
        task = progress.add_task(label, total=total, note="")
        yield lambda note, steps=1: progress.update(task, advance=steps, note=note)


def show(result: dict[str, Any], as_json: bool, render: Any = None) -> None:
    """Prints a result: as one JSON object, or for a person, by ``render`` or as names and values."""
    if as_json:
        sys.stdout.write(json.dumps(jsonable(result), allow_nan=False) + "\n")
    elif render is None:
        pairs(result)
    else:
        render(result)


def jsonable(value: Any) -> Any:
    """NaN has no place in JSON; a figure without a meaning is null."""
    if isinstance(value, dict):
        return {str(key): jsonable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [jsonable(item) for item in value]
    if hasattr(value, "__dataclass_fields__"):
        return {name: jsonable(getattr(value, name)) for name in value.__dataclass_fields__}
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value


def number(value: Any, unit: str = "", digits: int = 3) -> str:
    """A figure with its unit, or a dash where it has no meaning."""
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "-"
    return f"{value:.{digits}f}{unit}" if isinstance(value, float) else f"{value}{unit}"


def pairs(values: dict[str, Any]) -> None:
    """Prints names and values."""
    table = Table(box=None, show_header=False, pad_edge=False)
    for name, value in values.items():
        table.add_row(f"[dim]{name}[/]", number(value))
    out.print(table)


def plain(error: GripperError) -> str:
    """An error's sentence, whose brackets are no markup."""
    return str(error).replace("[", r"\[")
