"""The command that shows a log, also one that is being written: view."""

import sys
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from gripper_force.cli import console
from gripper_force.cli.options import AsJson, NoOverrides
from gripper_force.errors import ConfigError

_NAMES = ("rerun", "foxglove")
_PORT = 8765


class ViewCommand(TyperCommand):
    """Command whose option ``--view`` may be given without a value; it then means Rerun."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Adds the value where it is missing."""
        return super().parse_args(ctx, list(_with_viewer(args)))


def _with_viewer(args: Sequence[str]) -> Sequence[str]:
    return [
        "--view=rerun" if arg == "--view" and (not then or then.startswith("-")) else arg
        for arg, then in pairwise([*args, ""])
    ]


def view(
    log: Annotated[Path, typer.Argument(help="Log of a run (.mcap).")],
    viewer: Annotated[str, typer.Option(help=f"{' or '.join(_NAMES)}.")] = _NAMES[0],
    follow: Annotated[
        bool, typer.Option("--follow", help="Show a run while it writes the log, which need not exist yet.")
    ] = False,
    save: Annotated[
        Path | None, typer.Option(help="Write a file for Rerun (.rrd) instead of opening a window.")
    ] = None,
    port: Annotated[
        int | None,
        typer.Option(min=0, max=65535, help=f"Port for Foxglove; 0: a free one. Default: {_PORT}."),
    ] = None,
    recover: Annotated[bool, typer.Option(help="Show the intact part of a truncated log.")] = False,
    set_: NoOverrides = None,
    as_json: AsJson = False,
) -> None:
    """Show a log in Rerun or Foxglove: frames, attention, forces, phases and events on one timeline."""
    from gripper_force.jobs import view as job

    if save is not None and save.suffix != ".rrd":
        raise ConfigError(f"--save writes a file for Rerun, not {save}; name one that ends with .rrd")
    if port is not None and viewer != "foxglove":
        raise ConfigError("--port is for Foxglove; add --viewer foxglove, or leave out --port")
    job.require(viewer)
    if viewer == "foxglove":
        if save is not None:
            raise ConfigError(f"--save is for Rerun; Foxglove opens the log itself: {log}")
        _serve_foxglove(log, _PORT if port is None else port, follow=follow, recover=recover, as_json=as_json)
        return
    from gripper_force.jobs.view.rerun_view import RerunViewer
    from gripper_force.runtime.log_reader import LogReader

    reader = None if follow else LogReader(log, recover=recover)
    rerun = RerunViewer(log, save, live=follow)
    if follow:
        _ready(as_json)
    job.show(reader or job.GrowingLog(log, job.wait_for_writer()), rerun)
    console.show({"log": log, "viewer": viewer, "file": save}, as_json)


def _serve_foxglove(log: Path, port: int, *, follow: bool, recover: bool, as_json: bool) -> None:
    from gripper_force.jobs import view as job
    from gripper_force.jobs.view.foxglove_view import FoxgloveViewer
    from gripper_force.runtime.log_reader import LogReader

    reader = None if follow else LogReader(log, recover=recover)
    server = FoxgloveViewer(log.stem, port, reader)
    instruction = (
        f"open {server.app_url} or, in the Foxglove app, the connection {server.url}; import the layout "
        f"{job.FOXGLOVE_LAYOUT}"
    )
    try:
        if reader is not None:
            console.show(
                {"log": log, "url": server.url, "layout": job.FOXGLOVE_LAYOUT}, as_json, lambda _: None
            )
            sys.stdout.flush()
            console.line(f"{instruction}; serving until Ctrl-C")
            server.play(reader)
            return
        if as_json:
            console.show({"text": f"{instruction}; the run begins then", "url": server.url}, as_json)
            sys.stdout.flush()
        else:
            console.line(instruction)
        wait = job.wait_for_writer()
        server.wait_for_app(wait)
        _ready(as_json)
        job.show(job.GrowingLog(log, wait), server)
    finally:
        server.close()


def _ready(as_json: bool) -> None:
    if as_json:  # for the process that starts the run
        console.show({"ready": True}, as_json)
        sys.stdout.flush()
