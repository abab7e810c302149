"""Reading of checkpoints and of files exported from them, and the cache of exported files of this machine.

An ONNX file holds the header in its metadata, an OpenVINO file in its ``rt_info``.
"""

import hashlib
import xml.etree.ElementTree as ET
from importlib import import_module
from pathlib import Path
from typing import Final

from gripper_force.errors import CheckpointError
from gripper_force.folders import xdg_folder
from gripper_force.vision.header import (
    EXPORTED,
    KEY,
    SHIPPED,
    Model,
    check_not_exported,
    digest_of,
    header_from,
    read_checkpoint,
)

WEIGHTS: Final = "weights"
"""Name in an OpenVINO file's metadata of the SHA-256 of its weights, which are in a file of their own."""

SHIPPED_EXPORTS: Final = Path(__file__).with_name("exported")
"""Folder of the shipped checkpoints as ONNX files, which `scripts/export-shipped` makes."""


def read_model(source: str | Path) -> Model:
    """Reads the header of a checkpoint, or of a file exported from one.

    Args:
        source: A path, or ``default`` or ``small`` for a shipped checkpoint.

    Raises:
        CheckpointError: The file is missing, damaged, or not of this project.
    """
    if str(source) in SHIPPED or Path(source).suffix not in EXPORTED:
        path, data, header = read_checkpoint(source)
        return Model(path, header, digest_of(data, header))
    path = Path(source)
    if not path.is_file():
        raise CheckpointError(f"no network at {path}; make one with `gripper-force export network`")
    metadata = _openvino_metadata(path) if path.suffix == ".xml" else _onnx_metadata(path)
    if not {"header", "digest"} <= metadata.keys():
        raise CheckpointError(
            f"{path} was not made by `gripper-force export network`; make one with it from a checkpoint"
        )
    return Model(path, header_from(metadata["header"], path), metadata["digest"])


def exported_file(model: Model, suffix: str) -> Path:
    """Returns the file of a model that an engine runs.

    This is the model's own file; or, for a checkpoint, the export that comes with a shipped one, or one in
    the cache folder, made at the first use.

    Args:
        model: The model.
        suffix: Suffix of the engine's files, a key of `EXPORTED`.

    Raises:
        ConfigError: The file was exported for another engine, or a package for the export is not installed.
        CheckpointError: The checkpoint can't be exported.
    """
    if model.path.suffix == suffix:
        return model.path
    check_not_exported(model)
    name = exported_name(model, suffix)
    if (shipped := SHIPPED_EXPORTS / name).exists():
        return shipped
    path = cache_folder() / name
    if not path.exists():
        # Imported by name: the export is not among the modules that a run with a robot reaches.
        import_module("gripper_force.vision.export_process").export_apart(model, path)
    return path


def unusable(engine: str, path: Path, model: Model, error: Exception) -> CheckpointError:
    """Returns the error of an engine that can't run the file that `exported_file` named for a model."""
    remedies = {model.path: "export it again", SHIPPED_EXPORTS / path.name: "install gripper-force again"}
    remedy = remedies.get(path, "delete it: the next run makes it again")
    return CheckpointError(f"{engine} can't run {path}: {' '.join(str(error).split())}; {remedy}")


def check_weights(path: Path) -> None:
    """Raises `ValueError` if the weights beside an OpenVINO file are not those that it was exported with."""
    if _openvino_metadata(path).get(WEIGHTS, digest := weights_digest(path)) != digest:
        raise ValueError(f"{path.with_suffix('.bin').name} does not hold the weights of this file")


def weights_digest(path: Path) -> str:
    """Returns the SHA-256 of the weights beside an OpenVINO file; that of nothing if there are none."""
    weights = path.with_suffix(".bin")
    return hashlib.sha256(weights.read_bytes() if weights.exists() else b"").hexdigest()


def exported_name(model: Model, suffix: str) -> str:
    """Returns the file name under which the export of a checkpoint is kept."""
    return f"{model.digest[:32]}{suffix}"


def cache_folder() -> Path:
    """Returns the folder of cached files. Raises `ConfigError` if there is none."""
    return xdg_folder("XDG_CACHE_HOME", ".cache")


def _openvino_metadata(path: Path) -> dict[str, str]:
    try:
        root = ET.parse(path).getroot()  # noqa: S314 - a network that the user has chosen to run
    except (OSError, ET.ParseError) as error:
        raise CheckpointError(
            f"{path} is damaged or not an OpenVINO file: {error}; export it again"
        ) from error
    section = root.find(f"rt_info/{KEY}")
    return {} if section is None else {entry.tag: entry.get("value", "") for entry in section}


def _onnx_metadata(path: Path) -> dict[str, str]:
    import onnxruntime

    try:
        session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime's classes have no common base but Exception
        raise CheckpointError(f"{path} is damaged or not an ONNX file: {error}; export it again") from error
    prefix = f"{KEY}."
    return {
        name.removeprefix(prefix): value
        for name, value in session.get_modelmeta().custom_metadata_map.items()
        if name.startswith(prefix)
    }
