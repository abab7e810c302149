"""Export of a checkpoint to ONNX or OpenVINO. Each file is checked against PyTorch before it is kept."""

import logging
import shutil
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, TypedDict

import numpy as np
import torch

from gripper_force.errors import CheckpointError, ConfigError
from gripper_force.plugins import importing
from gripper_force.types import Gray
from gripper_force.vision.checkpoint import load_checkpoint
from gripper_force.vision.engines import open_engine
from gripper_force.vision.engines.pytorch import TorchEngine, restored_threads
from gripper_force.vision.ensemble_step import FRAME, EnsembleStep, state_names
from gripper_force.vision.header import EXPORTED, KEY, Model
from gripper_force.vision.model_files import WEIGHTS, cache_folder, weights_digest
from gripper_force.vision.stream_inference import stream

TOLERANCE: Final = 1e-4
"""Largest difference of an exported network from PyTorch in float32: of forces as a share of the label scale, of
features and attention as a share of the largest value."""

_CHECKED: Final = 30
"""Frames of noise that an exported network is checked on: more than a window."""


class ExportErrors(TypedDict):
    """Difference of an exported network's estimates from PyTorch's.

    Attributes:
        largest_n: Largest absolute difference.
        mean_n: Mean absolute difference.
        rms_n: Root mean square difference.
    """

    largest_n: float
    mean_n: float
    rms_n: float


def export(model: Model, path: Path) -> ExportErrors:
    """Writes an ensemble's streaming step as an ONNX or OpenVINO file.

    Args:
        model: The checkpoint.
        path: File to write; its suffix selects the format. An OpenVINO file's weights go beside it, into
            ``.bin``.

    Returns:
        The difference from PyTorch, on noise.

    Raises:
        ConfigError: The suffix is unknown, or a package is not installed.
        CheckpointError: The checkpoint can't be read, or the exported network computes something else.
    """
    with written(path) as part:
        if path.suffix == ".xml":
            save_openvino(openvino_network(model), model, part)
        else:
            _save_onnx(model, part)
        return export_errors(model, part)


@contextmanager
def written(path: Path) -> Iterator[Path]:
    """Yields a file in a folder of its own, and moves it, with what lies beside it, to ``path`` at the end.

    Raises:
        ConfigError: The suffix is unknown, or a package is not installed.
        CheckpointError: The file can't be written.
    """
    if path.suffix not in EXPORTED:
        raise ConfigError(f"can't export to {path}; name a file that ends in {' or '.join(EXPORTED)}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with (
            importing(f"exporting to {path.suffix}"),
            TemporaryDirectory(dir=path.parent) as folder,
            _quiet(),
            restored_threads(),
        ):
            torch.set_num_threads(1)  # the rounding of sums depends on the number of threads
            yield Path(folder) / path.name
            # The weights first: a process that finds the .xml must find its .bin too.
            for part in sorted(Path(folder).iterdir(), key=lambda part: part.suffix == path.suffix):
                shutil.move(part, path.parent / part.name)
    except OSError as error:
        in_cache = path.parent == cache_folder()
        remedy = "set XDG_CACHE_HOME to a folder that can be written" if in_cache else "name another file"
        raise CheckpointError(f"can't write {path}: {error.strerror}; {remedy}") from error


def _save_onnx(model: Model, path: Path) -> None:
    step, inputs = _traced(model)
    program = torch.onnx.export(
        step,
        inputs,
        dynamo=True,
        verbose=False,
        input_names=[FRAME, *state_names(model.header.members)],
        output_names=step.outputs,
    )
    assert program is not None
    for name, text in _metadata(model).items():
        program.model.metadata_props[f"{KEY}.{name}"] = text
    network = program.model_proto
    _halve_weights(network.graph)
    path.write_bytes(network.SerializeToString())


def _halve_weights(graph: Any) -> None:
    """Stores the weights of an ONNX graph in float16 where that is exact. Engines widen them once, as they load."""
    from onnx import TensorProto, helper, numpy_helper

    for tensor in list(graph.initializer):
        weights = numpy_helper.to_array(tensor)
        with np.errstate(over="ignore"):
            half = weights.astype(np.float16)
        if weights.dtype == np.float32 and np.array_equal(half, weights):
            name = tensor.name
            tensor.CopyFrom(numpy_helper.from_array(half, f"{name}.half"))
            graph.node.insert(0, helper.make_node("Cast", [tensor.name], [name], to=TensorProto.FLOAT))


def openvino_network(model: Model) -> Any:
    """Returns an ensemble's streaming step as a network of OpenVINO."""
    import openvino

    step, inputs = _traced(model)
    network = openvino.convert_model(step, example_input=inputs)
    names = [FRAME, *state_names(model.header.members)]
    for port, name, tensor in zip(network.inputs, names, inputs, strict=True):
        port.get_tensor().set_names({name})
        port.get_node().set_friendly_name(name)
        port.get_node().set_partial_shape(openvino.PartialShape(list(tensor.shape)))
    network.validate_nodes_and_infer_types()
    for port, name in zip(network.outputs, step.outputs, strict=True):
        port.get_tensor().set_names({name})
    return network


def save_openvino(network: Any, model: Model, path: Path) -> None:
    """Writes a network of OpenVINO with a model's header and digest, and the digest of its weights."""
    import openvino

    for name, text in _metadata(model).items():
        network.set_rt_info(text, [KEY, name])
    openvino.save_model(network, path, compress_to_fp16=False)
    network.set_rt_info(weights_digest(path), [KEY, WEIGHTS])
    openvino.save_model(network, path, compress_to_fp16=False)


def _traced(model: Model) -> tuple[EnsembleStep, tuple[torch.Tensor, ...]]:
    step = EnsembleStep(load_checkpoint(model.path).networks).eval()
    size = model.header.preprocess.size
    return step, (torch.zeros(1, 1, size, size), *step.zero_states())


def export_errors(model: Model, path: Path, frames: Sequence[Gray] | None = None) -> ExportErrors:
    """Compares an exported file with PyTorch, on recordings, (T, S, S) uint8 each, or on noise.

    Returns:
        The difference of the ensemble's estimates.

    Raises:
        CheckpointError: The file computes another force of a member, other features or another attention; on
            recordings, only if they are not finite.
    """
    exact = frames is None
    if frames is None:
        size = model.header.preprocess.size
        frames = [np.random.default_rng(0).integers(0, 256, (_CHECKED, size, size), np.uint8)]
    exported_model = Model(path, model.header, model.digest)
    expected, exported = (
        [step for clip in frames for step in stream(engine, clip)]
        for engine in (TorchEngine(model), open_engine(exported_model, EXPORTED[path.suffix]))
    )
    for name in ("forces_n", "features", "attention"):
        if getattr(expected[0], name) is None:  # no attention
            continue
        values = [np.stack([getattr(step, name) for step in steps]) for steps in (expected, exported)]
        scale = np.abs(values[0]).max()
        if name == "forces_n":
            scale = max(member.label_scale_n for member in model.header.members)
        largest = np.abs(values[0] - values[1]).max()
        if not np.isfinite(largest) or (exact and largest > TOLERANCE * scale):
            raise CheckpointError(
                f"the exported {path.suffix} file differs from PyTorch by {largest:.2g} in {name}; "
                "install other versions of PyTorch and of the packages that export, or use vision.engine=torch"
            )
    means_n = [np.array([step.forces_n.mean() for step in steps]) for steps in (expected, exported)]
    error_n = np.abs(means_n[0] - means_n[1])
    return {
        "largest_n": float(error_n.max()),
        "mean_n": float(error_n.mean()),
        "rms_n": float(np.sqrt(np.square(error_n).mean())),
    }


@contextmanager
def _quiet() -> Iterator[None]:
    """Silences the exporters, which log and print their internal steps."""
    names = ("torch.onnx", "nncf", "onnxscript", "onnx_ir")
    levels = {name: logging.getLogger(name).level for name in names}
    for name in names:
        logging.getLogger(name).setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(), redirect_stdout(StringIO()):
            warnings.simplefilter("ignore")
            yield
    finally:
        for name, level in levels.items():
            logging.getLogger(name).setLevel(level)


def _metadata(model: Model) -> dict[str, str]:
    """Returns the metadata of a file exported from a model."""
    return {"header": model.header.model_dump_json(exclude_none=True), "digest": model.digest}
