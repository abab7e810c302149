"""Options that commands share, and the configuration they give."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:  # --help needs no configuration
    from gripper_force.config import Config

CORES = os.cpu_count() or 1

ConfigPath = Annotated[Path | None, typer.Option("--config", help="YAML file with configuration keys.")]
Overrides = Annotated[
    list[str] | None, typer.Option("--set", help="Set one configuration key: key.path=value. Repeatable.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout.")]
Jobs = Annotated[int, typer.Option(min=1, help="Processes to use.")]
Page = Annotated[Path | None, typer.Option("--write", help="Markdown page to write the table into.")]


def load_settings(
    path: Path | None, overrides: list[str] | None, options: Mapping[str, object], *, new_rig: bool = False
) -> "Config":
    """Loads the configuration of a command; its own options override ``--set``.

    With ``new_rig`` the rig profile need not exist yet, because the command writes it.

    Raises:
        ConfigError: A file, key or value is wrong. The sentence names it.
    """
    from gripper_force.config import load_config

    given = [(key, value) for key, value in options.items() if value is not None]
    return load_config(path, [*(overrides or []), *given], new_rig=new_rig)
