"""Files for other engines: what they say about themselves, and where this machine keeps its own.

An ONNX file carries the header in its metadata, an OpenVINO file in its ``rt_info``.
"""

import os
import xml.etree.ElementTree as ET
from pathlib import Path

from gripper_force.errors import CheckpointError, ConfigError
from gripper_force.vision.header import (
    EXPORTED,
    KEY,
    SHIPPED,
    Model,
    digest_of,
    header_from,
    read_checkpoint,
)


def read_model(source: str | Path) -> Model:
    """Reads what a checkpoint, or a file that was exported from one, says about itself.

    Args:
        source: A path, or ``default`` or ``small`` for a checkpoint that is shipped.

    Raises:
        CheckpointError: The file is missing, damaged, or nothing of ours.
        ConfigError: What reads its format is not installed.
    """
    if str(source) in SHIPPED or Path(source).suffix not in EXPORTED:
        path, data, header = read_checkpoint(source)
        return Model(path, header, digest_of(data))
    path = Path(source)
    if not path.is_file():
        raise CheckpointError(f"no network at {path}; make one with `gripper-force export`")
    about = _of_openvino(path) if path.suffix == ".xml" else _of_onnx(path)
    if not {"header", "digest"} <= about.keys():
        raise CheckpointError(f"{path} was not made by `gripper-force export`")
    return Model(path, header_from(about["header"], path), about["digest"])


def exported(model: Model, suffix: str) -> Path:
    """The model's file for an engine: its own, or, of a checkpoint, one that this machine keeps.

    It is made at the first use.

    Raises:
        ConfigError: It is a file for another engine, or a package for the export is not installed.
    """
    if model.path.suffix == suffix:
        return model.path
    if model.path.suffix in EXPORTED:
        raise ConfigError(
            f"{model.path} was exported for another engine: set vision.engine={EXPORTED[model.path.suffix]}, "
            "or name the checkpoint that it was made of"
        )
    path = cache_folder() / f"{model.digest[:32]}{suffix}"
    if not path.exists():
        from gripper_force.vision.export import export

        export(model, path)
    return path


def cache_folder() -> Path:
    """What can be made again (https://specifications.freedesktop.org/basedir-spec/latest/)."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "gripper-force"


def _of_openvino(path: Path) -> dict[str, str]:
    try:
        root = ET.parse(path).getroot()  # noqa: S314 - a network that one has chosen to run
    except (OSError, ET.ParseError) as error:
        raise CheckpointError(f"{path} is damaged or no OpenVINO file: {error}") from error
    ours = root.find(f"rt_info/{KEY}")
    return {} if ours is None else {part.tag: part.get("value", "") for part in ours}


def _of_onnx(path: Path) -> dict[str, str]:
    try:
        import onnxruntime
    except ModuleNotFoundError as error:
        raise ConfigError("an ONNX file needs ONNX Runtime: pip install 'gripper-force[engines]'") from error
    try:
        session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    except Exception as error:  # its own classes derive from Exception alone
        raise CheckpointError(f"{path} is damaged or no ONNX file: {error}") from error
    return {
        name.removeprefix(f"{KEY}."): value
        for name, value in session.get_modelmeta().custom_metadata_map.items()
        if name.startswith(f"{KEY}.")
    }
