"""Writing of object profiles."""

from pathlib import Path

from gripper_force.errors import ConfigError
from gripper_force.profiles.object_profile import ObjectProfile, weights_path
from gripper_force.schema import dump, write_all


def check_place(path: Path) -> None:
    """Creates the folder of a profile. Raises `ConfigError` if the profile can't be written there."""
    if path.suffix != ".yaml":
        raise ConfigError(f"can't write an object profile to {path}; name a file that ends in .yaml")
    probe = path.with_name(f".{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise ConfigError(
            f"can't write {path}: {error.strerror}, {error.filename}; name another file"
        ) from error


def write_object(path: Path, profile: ObjectProfile, weights: bytes) -> None:
    """Writes an object profile and the safetensors file beside it. Raises `ConfigError` if it can't."""
    write_all({weights_path(path): weights, path: dump(profile).encode()})
