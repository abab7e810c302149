"""Writing of profiles."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
from safetensors.numpy import save

from gripper_force.errors import ConfigError
from gripper_force.files import make_folder_of, unfinished
from gripper_force.profiles.correction import ProfileArrays
from gripper_force.profiles.object_profile import ObjectProfile, weights_path
from gripper_force.profiles.rig_profile import (
    CameraCalibration,
    LoadCellCalibration,
    RigProfile,
    ServoCalibration,
    read_rig,
)
from gripper_force.schema import dump


def check_object_place(path: Path) -> None:
    """Creates the folder of an object profile. Raises `ConfigError` if the profile can't be written there."""
    _check_names(path)
    check_writable(path)


def check_writable(path: Path) -> None:
    """Creates the folder of a file. Raises `ConfigError` if the file can't be written there."""
    if path.is_dir():
        raise ConfigError(f"can't write {path}: it is a folder; name a file in it")
    try:
        make_folder_of(path)
    except OSError as error:
        raise ConfigError(
            f"can't write {path}: {error.strerror}, {error.filename}; name another file"
        ) from error


def _check_names(path: Path) -> None:
    if path.suffix != ".yaml":
        raise ConfigError(f"can't write an object profile to {path}; name a file that ends in .yaml")
    if (beside := weights_path(path)).exists() and not path.exists():
        raise ConfigError(
            f"an object profile {path} would replace {beside}, which belongs to no profile; name another file, or move "
            "that one away"
        )


def write_object(path: Path, profile: ObjectProfile, weights: bytes) -> None:
    """Writes an object profile and the safetensors file beside it. Raises `ConfigError` if it can't."""
    _check_names(path)
    write_all({weights_path(path): weights, path: dump(profile).encode()})


def pack(arrays: ProfileArrays) -> bytes:
    """Returns the content of the safetensors file beside a profile, with the axes in half precision."""
    tensors = {name: getattr(arrays, name).astype(np.float32) for name in ("head", "offset")}
    if arrays.known is not None:
        mean, axes, floor, _ = arrays.known
        tensors |= {"mean": mean.astype(np.float32), "axes": np.ascontiguousarray(axes, np.float16)}
        tensors["floor"] = np.array([floor], np.float32)
    data: bytes = save(tensors)
    return data


def rig_to_update(path: Path) -> RigProfile:
    """Returns the rig profile that a calibration will update, or a new one, before anything moves.

    Raises:
        ConfigError: The file exists and is not a rig profile, or it can't be written.
    """
    check_writable(path)
    return read_rig(path) if path.exists() else RigProfile()


def update_rig(path: Path, section: LoadCellCalibration | ServoCalibration | CameraCalibration) -> RigProfile:
    """Replaces one section of a rig profile, or creates the profile, and writes it.

    Raises:
        ConfigError: The file exists and is not a rig profile, or it can't be written.
    """
    names = {LoadCellCalibration: "load_cell", ServoCalibration: "servo", CameraCalibration: "camera"}
    rig_to_update(path)  # raises
    with _naming(path), unfinished(path, wait=True) as part:  # a second calibration may write another section
        profile = rig_to_update(path).model_copy(update={names[type(section)]: section})
        part.write_bytes(dump(profile).encode())
    return profile


def write_all(files: dict[Path, bytes]) -> None:
    """Writes several files; none appears under its name before all are complete.

    Raises:
        ConfigError: One can't be written.
        DataError: Another process or thread writes one of them.
    """
    with _naming(*files), ExitStack() as stack:
        for path, data in reversed(files.items()):  # the stack renames the last one first
            path.parent.mkdir(parents=True, exist_ok=True)
            stack.enter_context(unfinished(path)).write_bytes(data)


@contextmanager
def _naming(*files: Path) -> Iterator[None]:
    """Raises `ConfigError` that names the files for an `OSError` of writing them."""
    try:
        yield
    except OSError as error:
        names = " and ".join(map(str, files))
        where = "" if error.filename is None else f", {error.filename}"  # a full disk names no file
        raise ConfigError(f"can't write {names}: {error.strerror}{where}") from error
