"""Tables of recorded and imported sets."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich.markup import escape
from rich.table import Column, Table

from gripper_force.cli.console import number, out

if TYPE_CHECKING:  # --help loads no NumPy
    from gripper_force.jobs.imports.database import EnvironmentSummary
    from gripper_force.jobs.imports.video import ImportSummary
    from gripper_force.jobs.recording.summary import RecordingSummary


def sets_table(r: "RecordingSummary") -> None:
    """Prints the content of recorded sets."""
    rate = f"Hz of {r.overall.camera_hz_asked:g}"
    names = ("set", "frames", rate, "lost", "load cell Hz", "rejected", "peak N", "lag ms")
    columns = [Column(name, no_wrap=True) for name in names]
    table = Table(*columns, box=None, pad_edge=False, collapse_padding=True)
    for name, s in [*((one.set, one) for one in r.sets), ("all", r.overall)]:
        table.add_row(
            name,
            str(s.frames),
            number(s.camera_hz, digits=1),
            str(s.frames_lost),
            number(s.load_cell_hz, digits=1),
            str(s.samples_rejected),
            number(s.peak_n, digits=1),
            _lag(s.lag_ms, s.lag_spread_ms),
        )
    out.print(table)
    table = Table("force N", "frames", box=None)
    for n, count in r.overall.histogram.items():
        table.add_row(f"{n} to {n + 1}", str(count))
    out.print(table)
    for warning in r.warnings:
        out.print(f"[yellow]{escape(warning)}[/]", soft_wrap=True)


def _lag(lag_ms: float | None, spread_ms: float | None) -> str:
    """Formats a lag. The spread of a single touch is unknown."""
    return number(lag_ms, digits=1) + ("" if spread_ms is None else f" ± {spread_ms:.1f}")


def imports_table(logs: "Sequence[ImportSummary]") -> None:
    """Prints the results of `import video`."""
    table = Table("log", "frames", "without force", "spikes", "tare N", "lag ms", box=None)
    for row in logs:
        figures = (number(row.tare_n, digits=3), f"{1e3 * row.force_lag_s:.0f}")
        counts = (str(getattr(row, name)) for name in ("frames", "frames_without_force", "spikes_rejected"))
        table.add_row(escape(row.log.name), *counts, *figures)
    out.print(table)
    for row in logs:
        if row.tare_note:
            note = f"no tare: {row.tare_note}"
            out.print(f"[yellow]{escape(row.log.name)}[/] {escape(note)}", soft_wrap=True)
        if row.starts_in_contact:
            note = "starts in contact, so its first frames are no reference; train and evaluate leave it out"
            out.print(f"[yellow]{escape(row.log.name)}[/] {note}", soft_wrap=True)


def database_table(environments: "Sequence[EnvironmentSummary]", ignored: Sequence[str]) -> None:
    """Prints the results of `import database`, and the problems found."""
    columns = ("object", "degrees", "lux", "logs", "kept", "touches", "frames", "spikes_rejected")
    table = Table("folder", *(name.removesuffix("_rejected") for name in columns), box=None)
    for row in environments:
        table.add_row(escape(row.folder), *(str(getattr(row, name)) for name in columns))
    out.print(table)
    for row in environments:
        for problem in row.problems:
            out.print(f"[yellow]{escape(row.folder)}[/] {escape(problem)}", soft_wrap=True)
    if ignored:
        out.print(f"[yellow]not imported[/] {escape(', '.join(ignored))}", soft_wrap=True)
