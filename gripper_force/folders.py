"""Folders of the user's files."""

import os
from pathlib import Path

from gripper_force.errors import ConfigError


def xdg_folder(variable: str, under_home: str) -> Path:
    """Returns this project's folder in one of https://specifications.freedesktop.org/basedir-spec/latest/.

    Args:
        variable: Environment variable that names that folder.
        under_home: The folder if the variable is not set.

    Raises:
        ConfigError: It is not set, and the user has no home.
    """
    try:
        base = os.environ.get(variable) or Path.home() / under_home
    except RuntimeError as error:
        raise ConfigError(f"this user has no home folder; set {variable} to a folder") from error
    return Path(base) / "gripper-force"
