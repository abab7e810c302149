"""Tables of the `stability` commands."""

from typing import TYPE_CHECKING, Final, TypedDict, cast

from rich.markup import escape
from rich.table import Table

from gripper_force.cli.console import label, number, out, pairs

if TYPE_CHECKING:
    from collections.abc import Sequence

    from gripper_force.qualification.fault_matrix.matrix import RowSummary
    from gripper_force.qualification.fault_matrix.wrong_configurations import WrongSummary
    from gripper_force.qualification.fuzz.fuzzer import FuzzReport
    from gripper_force.qualification.numerics.suite import NumericsReport
    from gripper_force.qualification.safety_search import SearchReport, TimedRequest
    from gripper_force.qualification.soak import SoakReport


_SHOWN: Final = 8
"""Requests of a case that are printed. A stream has a hundred."""


class FaultsReport(TypedDict):
    """Rows of both tables; ``ok`` is True if every grasp had an expected reaction."""

    rows: "list[RowSummary]"
    wrong: "list[WrongSummary]"
    ok: bool


def fuzz_table(r: "FuzzReport") -> None:
    """Prints the outcomes of random and damaged input, reader by reader."""
    table = Table("target", "inputs", "results", "typed errors", "findings", box=None)
    for name, row in r["targets"].items():
        counts = (row["inputs"], row["results"], row["typed_errors"], row["findings"])
        table.add_row(name, *map(str, counts))
    out.print(table)
    for finding in r["findings"]:
        out.print(f"[bold red]{escape(f'{finding.target}:{finding.index}')}[/] {escape(finding.error)}")
        out.print(f"  input: {finding.file}", soft_wrap=True)
    pairs({"inputs": r["inputs"], "seed": r["seed"], "seconds": r["wall_s"]})


def numerics_tables(r: "NumericsReport") -> None:
    """Prints the hard numerical cases, part by part."""
    from gripper_force.qualification.numerics.suite import with_unit

    for name, rows in r["parts"].items():
        title = f"{name} ({r['seconds'][name]:.0f} s)"
        table = Table("case", "method", "found", "bound", title=title, title_justify="left", box=None)
        for row in rows:
            colour = "green" if row.ok else "bold red"
            found = f"[{colour}]{with_unit(row.figure, row.unit)}[/]"
            table.add_row(escape(row.case), escape(row.detail), found, with_unit(row.bound, row.unit))
        out.print(table)
        out.print()


def faults_tables(r: FaultsReport) -> None:
    """Prints the fault matrix and the wrong configurations."""
    if r["rows"]:
        _faults_table(r["rows"])
    if r["wrong"]:
        _wrong_table(r["wrong"])


def _faults_table(rows: "list[RowSummary]") -> None:
    table = Table(
        "fault",
        "expected",
        "as expected",
        "live",
        "worst ms",
        "within ms",
        "live ms",
        "peak over limit",
        box=None,
    )
    for row in rows:
        colour = "green" if row["ok"] == row["runs"] else "bold red"
        live = "green" if row["live_ok"] == row["live_runs"] else "bold red"
        table.add_row(
            row["row"],
            row["expected"],
            f"[{colour}]{row['ok']} of {row['runs']}[/]",
            f"[{live}]{row['live_ok']} of {row['live_runs']}[/]" if row["live_runs"] else "-",
            number(row["worst_ms"], digits=1),
            number(row["within_ms"], digits=0),
            number(row["live_worst_ms"], digits=1),
            f"{100 * row['peak_over_limit']:+.1f} %",
        )
    out.print(table)
    for row in rows:
        for seed, failure in row["failures"].items():
            out.print(f"[bold red]{row['row']}[/], seed {seed}: {escape(failure)}", soft_wrap=True)


def _wrong_table(rows: "list[WrongSummary]") -> None:
    table = Table(
        "wrong", "as expected", "live", "force over limit", "speed over configured", "on nothing", box=None
    )
    for row in rows:
        colour = "green" if row["ok"] == row["runs"] else "bold red"
        live = "green" if row["live_ok"] == row["live_runs"] else "bold red"
        table.add_row(
            row["row"],
            f"[{colour}]{row['ok']} of {row['runs']}[/]",
            f"[{live}]{row['live_ok']} of {row['live_runs']}[/]" if row["live_runs"] else "-",
            number(max(row["force_share"], row["live_force_share"] or 0.0), digits=2),
            number(max(row["speed_share"], row["live_speed_share"] or 0.0), digits=2),
            str(row["held_nothing"] + row["live_held_nothing"]),
        )
    out.print(table)
    for row in rows:
        for grasp, failure in row["failures"].items():
            out.print(f"[bold red]{row['row']}[/], {escape(grasp)}: {escape(failure)}", soft_wrap=True)


def search_table(r: "SearchReport") -> None:
    """Prints the violations of each statement, and its worst cases."""
    for name, cases in r["worst"].items():
        found = r["violations"][name]
        colour = "bold red" if found else "green"
        out.print(f"{name}: [{colour}]{found} of {r['cases']}[/]")
        for case in cases:
            requests = cast("Sequence[TimedRequest]", case["drawn"]["requests"])
            values = {**case["drawn"], "requests": _requests(requests)}
            drawn = ", ".join(f"{key} {number(value)}" for key, value in values.items())
            outcome = case["outcome"] or "not ended"
            out.print(
                f"  case {case['index']}, {outcome}: {case['force_share']:.2f} of the force limit, "
                f"{case['speed_share']:.2f} of the speed\n    [dim]{escape(drawn)}[/]",
                soft_wrap=True,
            )
    pairs(
        {
            "end stops held by motor current alone": r["held_stops"],
            "outcomes": ", ".join(f"{n} {name}" for name, n in r["outcomes"].items()),
            "seed": r["seed"],
        }
    )


def _requests(requests: "Sequence[TimedRequest]") -> str:
    """Returns the first requests of a case as text, each with the time until the next one, and the number of all."""
    shown = "; ".join(f"{one.kind} {one.value:.3g} for {one.time_s:.2f} s" for one in requests[:_SHOWN])
    return f"{shown}; {len(requests)} in all" if len(requests) > _SHOWN else shown or "-"


def soak_table(r: "SoakReport") -> None:
    """Prints memory, open files and threads over many grasps."""
    table = Table("simulated s", "memory MB", "files", "threads", box=None)
    for s in r["samples"]:
        table.add_row(
            number(s.simulated_s, digits=0), number(s.memory_mb, digits=1), str(s.handles), str(s.threads)
        )
    out.print(table)
    summary = {label(key): value for key, value in r.items() if key not in ("samples", "outcomes")}
    pairs({**summary, "outcomes": ", ".join(f"{n} {name}" for name, n in r["outcomes"].items())})
