"""Options that commands share, and the configuration they give."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from gripper_force.errors import ConfigError

if TYPE_CHECKING:  # --help needs no configuration
    from gripper_force.config import Config

CORES = os.cpu_count() or 1

ConfigPath = Annotated[Path | None, typer.Option("--config", help="YAML file with configuration keys.")]
Overrides = Annotated[
    list[str] | None, typer.Option("--set", help="Set one configuration key: key.path=value. Repeatable.")
]


def _refuse_overrides(context: typer.Context, overrides: list[str] | None) -> None:
    """Raises `ConfigError` that names the command if there are overrides."""
    if overrides:
        command = context.command_path.partition(" ")[2]
        raise ConfigError(f"{command} uses no configuration; leave out --set {overrides[0]}")


NoOverrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set", help="Not allowed: this command uses no configuration.", callback=_refuse_overrides
    ),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout.")]
Jobs = Annotated[int, typer.Option(min=1, help="Processes to use.")]
Ray = Annotated[
    str | None,
    typer.Option(help="Use a Ray cluster instead of --jobs: its address, or auto.", metavar="ADDRESS"),
]
SummaryFolder = Annotated[
    Path | None,
    typer.Option(
        "--out",
        help="Folder for a summary (summary.html, .csv and .json) and, with the extra parquet, the estimates of each "
        "frame (frames.parquet).",
    ),
]
Page = Annotated[Path | None, typer.Option("--write", help="Markdown page to write the table into.")]

_NAMES: Final = {"sim.yaw_deg": "--degrees", "calibration.object": "--profile"}
"""Options whose names are not the last part of their keys."""


def config_options(config: Path | None, overrides: list[str] | None) -> list[str]:
    """Returns the options with which the next command has the same configuration."""
    return [
        *(() if config is None else ("--config", str(config))),
        *(w for o in overrides or () for w in ("--set", o)),
    ]


def load_settings(path: Path | None, overrides: list[str] | None, options: Mapping[str, object]) -> "Config":
    """Loads the configuration of a command; its own options override ``--set``.

    Raises:
        ConfigError: A file, key or value is wrong. The sentence names it.
    """
    return _load(path, overrides, options, new_rig=False)


def load_settings_before_rig(
    path: Path | None, overrides: list[str] | None, options: Mapping[str, object]
) -> "tuple[Config, Path | None]":
    """Loads the configuration of a command that needs no rig profile, as `load_settings`.

    Returns:
        The configuration, without a rig profile that does not exist yet; and the path of that one, or None.
    """
    settings = _load(path, overrides, options, new_rig=True)
    rig = settings.calibration.rig
    if rig is None or rig.exists():
        return settings, None
    return settings.with_values(calibration={"rig": None}), rig


def _load(
    path: Path | None, overrides: list[str] | None, options: Mapping[str, object], *, new_rig: bool
) -> "Config":
    from gripper_force.config import load_with_options

    layers = {_name(key): {key: value} for key, value in options.items() if value is not None}
    return load_with_options(path, overrides, layers, new_rig=new_rig)


def _name(key: str) -> str:
    """Returns the name of the option that sets a key."""
    return _NAMES.get(key) or "--" + key.rpartition(".")[2].replace("_", "-")
