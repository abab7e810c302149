"""Tables of `doctor`: checks, and register changes."""

from typing import TYPE_CHECKING

from rich.markup import escape
from rich.table import Table

from gripper_force.cli.console import err, out

if TYPE_CHECKING:  # --help loads no NumPy
    from gripper_force.jobs.checks import Check, RegisterChange, SetupResult


def checks_table(checks: "list[Check]") -> None:
    """Prints the checks and the suggested fixes."""
    marks = {True: "[green]ok[/]", False: "[bold red]problem[/]", None: "-"}
    table = Table(box=None, show_header=False, pad_edge=False)
    for check in checks:
        advice = f"\n[yellow]{escape(check.advice)}[/]" if check.advice else ""
        style = "dim" if check.ok is None else ""
        table.add_row(marks[check.ok], check.unit, check.name, escape(check.found) + advice, style=style)
    out.print(table)


def changes_table(servo: str, changes: "list[RegisterChange]") -> None:
    """Prints the registers that would change, on stderr."""
    table = Table(servo, "is", "becomes", box=None, pad_edge=False)
    for change in changes:
        table.add_row(change.register, change.old, change.new)
    err.print(table)


def setup_line(r: "SetupResult") -> None:
    """Prints the result of a servo's setup."""
    result = "written and read back" if r.applied else "unchanged"
    out.print(f"servo {r.servo}: {result if r.changes else 'nothing to change'}")
