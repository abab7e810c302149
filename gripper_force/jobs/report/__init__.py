"""Report of a run, as a PNG and as an HTML page: `write_report`."""

from dataclasses import dataclass
from pathlib import Path

from gripper_force.config import Overrides
from gripper_force.errors import LogError
from gripper_force.jobs.replay.feed import changed_config, resolve_replay, run_again
from gripper_force.jobs.report.figure import draw, to_svg
from gripper_force.jobs.report.page import render
from gripper_force.jobs.report.pictures import FrameSampler
from gripper_force.jobs.report.reading import read_run
from gripper_force.runtime.log_reader import LogReader

__all__ = ["ReportPaths", "write_report"]


@dataclass(frozen=True, slots=True)
class ReportPaths:
    """Files of a report."""

    png: Path
    html: Path


def write_report(
    log: Path,
    *,
    recover: bool = False,
    checkpoint: str | None = None,
    overrides: Overrides | None = None,
) -> ReportPaths:
    """Writes the report of a log: a PNG, and an HTML page that needs no network and no other file.

    Without changes, the log is read once, and the figure is drawn once for both. With them, the report shows the
    estimates and decisions of an open-loop replay.

    Args:
        log: The log. Beside it are ``<log>.png`` and ``<log>.html``, with ``-replayed`` after the name if there are
            changes.
        recover: Read the intact part of a truncated or damaged log.
        checkpoint: Another network to estimate with; None: the log's own.
        overrides: Changes of the log's configuration, as for `gripper_force.jobs.replay.replay`.

    Raises:
        LogError: The log can't be read, or the report can't be written.
        ConfigError: The log holds a configuration that this version does not understand, or a change is wrong.
        CheckpointError: The other network's file can't be read.
    """
    reader = LogReader(log, recover=recover)
    if checkpoint is None and not overrides:
        stem = log.stem
        sampler = FrameSampler(reader)
        run = read_run(reader, sampler.add)
    else:
        stem = f"{log.stem}-replayed"
        resolved = resolve_replay(changed_config(reader, checkpoint, overrides))
        sampler = FrameSampler(reader, resolved.config)
        run = read_run(reader, sampler.add, run_again(reader, resolved), resolved.config)
    paths = ReportPaths(log.with_name(f"{stem}.png"), log.with_name(f"{stem}.html"))
    pictures, note = sampler.pictures(run)
    figure = draw(run, pictures)
    try:
        figure.savefig(paths.png)
        figure.set_layout_engine("none")  # the page shows the same figure, whose parts have their places now
        paths.html.write_text(render(run, to_svg(figure), note), encoding="utf-8")
    except OSError as error:
        raise LogError(
            f"can't write the report {error.filename or log.parent}: {error.strerror}; check the folder"
        ) from error
    return paths
