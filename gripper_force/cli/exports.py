"""Commands that convert for other software: `export network` and `export lerobot`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer
from typer.core import TyperGroup

from gripper_force.cli import console
from gripper_force.cli.learning import export_network
from gripper_force.cli.options import AsJson, Overrides
from gripper_force.errors import ConfigError

if TYPE_CHECKING:
    from gripper_force.jobs.exports.lerobot import Action


class _NetworkByDefault(TyperGroup):
    """Reads ``export --out FILE``, from before there was a second export, as ``export network --out FILE``."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if args and args[0] not in (*self.commands, "--help"):
            args = ["network", *args]
        return super().parse_args(ctx, args)


app = typer.Typer(
    cls=_NetworkByDefault,
    no_args_is_help=True,
    help="Export a network (the default), or logs, for other software.",
)
app.command("network")(export_network)


@app.command("lerobot")
def export_lerobot(
    logs: Annotated[list[Path], typer.Argument(help="Logs, or folders with logs.")],
    folder: Annotated[Path, typer.Option("--out", help="Folder of the dataset; it must not exist.")] = Path(
        "data/lerobot"
    ),
    fps: Annotated[int, typer.Option(min=1, help="Rows per second.")] = 30,
    action: Annotated[
        str, typer.Option(help="force: actions are target forces, 0 for open jaws; width: target widths.")
    ] = "force",
    task: Annotated[
        str | None, typer.Option(help='Description of the task. Default: "grasp the" and the object.')
    ] = None,
    video: Annotated[bool, typer.Option(help="Images as video; otherwise as PNG, without loss.")] = True,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Export logs to a LeRobot dataset, one episode per log. Needs the extra `lerobot`."""
    from gripper_force.jobs.dataset import find_logs
    from gripper_force.jobs.exports import lerobot as job

    if action not in job.ACTIONS:
        raise ConfigError(f"--action {action!r} is unknown; use {' or '.join(job.ACTIONS)}")
    paths = find_logs(logs)
    with console.bar("exporting", len(paths)) as progress:
        result = job.export_lerobot(
            paths,
            folder,
            fps=fps,
            action=cast("Action", action),
            task=task,
            video=video,
            overrides=set_,
            progress=progress,
        )
    console.show(result, as_json, lambda r: console.pairs(console.jsonable(r)))
