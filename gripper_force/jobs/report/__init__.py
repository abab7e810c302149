"""A run as a picture and as one page: `write_report`."""

from dataclasses import dataclass
from pathlib import Path

from gripper_force.errors import LogError
from gripper_force.jobs.report.data import read_run
from gripper_force.jobs.report.figure import draw
from gripper_force.jobs.report.page import render
from gripper_force.jobs.report.pictures import take_pictures

__all__ = ["ReportPaths", "write_report"]


@dataclass(frozen=True, slots=True)
class ReportPaths:
    """Where a report was written."""

    png: Path
    html: Path


def write_report(
    log: Path,
    out_dir: Path | None = None,
    *,
    recover: bool = False,
) -> ReportPaths:
    """Writes a log's report: a picture, and a page that needs no network and no other file.

    Args:
        log: The log.
        out_dir: Folder for ``<log>.png`` and ``<log>.html``; by default the log's own.
        recover: Read what is whole of a log that is cut short.

    Raises:
        LogError: The log can't be read, or the report can't be written.
        ConfigError: The log holds a configuration that this version does not understand.
    """
    folder = out_dir or log.parent
    paths = ReportPaths(folder / f"{log.stem}.png", folder / f"{log.stem}.html")
    run = read_run(log, recover=recover)
    pictures, note = take_pictures(log, run, recover=recover)
    page = render(run, pictures, note)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        draw(run, pictures).savefig(paths.png)
        paths.html.write_text(page, encoding="utf-8")
    except OSError as error:
        raise LogError(f"can't write the report {error.filename or folder}: {error.strerror}") from error
    return paths
