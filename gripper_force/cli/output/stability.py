"""What hard cases, faults and long use came to."""

from typing import Any

from rich.markup import escape
from rich.table import Table

from gripper_force.cli.console import number, out, pairs, plain


def fuzz_table(r: dict[str, Any]) -> None:
    """What readers made of hostile input."""
    table = Table("target", "inputs", "results", "typed errors", "findings", box=None)
    for name, row in r["targets"].items():
        table.add_row(name, *(str(row[key]) for key in ("inputs", "results", "typed_errors", "findings")))
    out.print(table)
    for finding in r["findings"]:
        out.print(f"[bold red]{escape(f'{finding.target}:{finding.index}')}[/] {escape(finding.error)}")
        out.print(f"  kept as {finding.file}", soft_wrap=True)
    pairs({"inputs": r["inputs"], "seed": r["seed"], "seconds": r["wall_s"]})


def numerics_tables(r: dict[str, Any]) -> None:
    """Hard cases for the numbers, part by part."""
    from gripper_force.qualification.numerics.suite import said

    for name, rows in r["parts"].items():
        title = f"{name} ({r['seconds'][name]:.0f} s)"
        table = Table("case", "how", "found", "bound", title=title, title_justify="left", box=None)
        for row in rows:
            colour = "green" if row.ok else "bold red"
            found = f"[{colour}]{said(row.figure, row.unit)}[/]"
            table.add_row(escape(row.case), escape(row.detail), found, said(row.bound, row.unit))
        out.print(table)
        out.print()


def faults_table(r: dict[str, Any]) -> None:
    """The fault matrix."""
    table = Table(
        "fault", "expected", "as expected", "worst ms", "of", "live ms", "peak over limit", box=None
    )
    for row in r["rows"]:
        colour = "green" if row["ok"] == row["runs"] else "bold red"
        table.add_row(
            row["row"],
            row["expected"],
            f"[{colour}]{row['ok']} of {row['runs']}[/]",
            number(row["worst_ms"], digits=1),
            number(row["within_ms"], digits=0),
            number(row["live_worst_ms"], digits=1),
            f"{100 * row['peak_over_limit']:+.1f} %",
        )
    out.print(table)
    for row in r["rows"]:
        for seed, why_not in row["failures"].items():
            out.print(f"[bold red]{row['row']}[/], seed {seed}: {plain(why_not)}", soft_wrap=True)


def soak_table(r: dict[str, Any]) -> None:
    """The process over many grasps."""
    table = Table("simulated s", "memory MB", "files", "threads", box=None)
    for s in r["samples"]:
        table.add_row(
            number(s.simulated_s, digits=0), number(s.memory_mb, digits=1), str(s.handles), str(s.threads)
        )
    out.print(table)
    summary = {key: value for key, value in r.items() if key not in ("samples", "outcomes")}
    pairs({**summary, "outcomes": ", ".join(f"{n} {name}" for name, n in r["outcomes"].items())})
