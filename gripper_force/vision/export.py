"""Export of a checkpoint to ONNX or OpenVINO. Each file is checked against PyTorch before it is kept."""

import logging
import math
import shutil
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, TypedDict

import numpy as np
import torch

from gripper_force.errors import CheckpointError, ConfigError, DataError
from gripper_force.types import Gray
from gripper_force.vision.checkpoint import load_checkpoint
from gripper_force.vision.engines import Engine, Floats, Step, open_engine
from gripper_force.vision.engines.pytorch import TorchEngine, restored_threads
from gripper_force.vision.ensemble_step import FRAME, EnsembleStep, state_names
from gripper_force.vision.header import EXPORTED, KEY, Header, Model, Residual, exported_metadata
from gripper_force.vision.preprocess import Normaliser

TOLERANCE: Final = 1e-4
"""Largest difference of an exported network from PyTorch in float32, as a share of the label scale."""

_CHECKED: Final = 30
"""Frames of noise that an exported network is checked on: more than a window."""

_CLIPS: Final = 4
"""Recordings that a quantised network is checked on."""

_SAMPLES: Final = 300
"""Frames that int8 ranges are calibrated on; NNCF's default."""


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


def export(model: Model, path: Path, frames: Sequence[Gray] | None = None) -> ExportErrors:
    """Writes an ensemble's streaming step as an ONNX or OpenVINO file.

    With ``frames`` the convolutions are quantised to int8. Other layers, a tenth of the arithmetic or less,
    stay in floating point: with the whole network in int8, errors exceeded 1 N.

    Args:
        model: The checkpoint.
        path: File to write; its suffix selects the format. An OpenVINO file's weights go beside it, into
            ``.bin``.
        frames: Recordings, (T, S, S) uint8 each, to calibrate the ranges of int8 on; None for float32.

    Returns:
        The difference from PyTorch, on the recordings or on noise. The header of an int8 file claims errors
        that include it.

    Raises:
        ConfigError: The suffix is unknown, or a package is not installed.
        CheckpointError: The checkpoint can't be read, or the exported network computes something else.
        DataError: The recordings hold too few frames.
    """
    if path.suffix not in EXPORTED:
        raise ConfigError(f"can't export to {path}; name a file that ends in {' or '.join(EXPORTED)}")
    if frames is not None and path.suffix != ".xml":
        raise ConfigError(f"int8 is exported to OpenVINO only, not to {path}; name a file that ends in .xml")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=path.parent) as folder, _quiet(), restored_threads():
            torch.set_num_threads(1)  # the rounding of sums depends on the number of threads
            made = Path(folder) / path.name
            (_openvino if path.suffix == ".xml" else _onnx)(model, made, frames)
            errors = _check(model, made, frames)
            if frames is not None:
                _replace_header(with_added_error(model.header, errors), made)
            # The weights first: a process that finds the .xml must find its .bin too.
            for part in sorted(Path(folder).iterdir(), key=lambda part: part.suffix == path.suffix):
                shutil.move(part, path.parent / part.name)
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"exporting to {path.suffix} needs {error.name}, which is not installed; "
            "pip install 'gripper-force[engines]'"
        ) from error
    except OSError as error:
        raise CheckpointError(f"can't write {path}: {error.strerror}; name another file") from error
    return errors


def _onnx(model: Model, path: Path, _frames: Sequence[Gray] | None) -> None:
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
    for name, text in exported_metadata(model).items():
        program.model.metadata_props[f"{KEY}.{name}"] = text
    program.save(str(path))


def _openvino(model: Model, path: Path, frames: Sequence[Gray] | None) -> None:
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
    if frames is not None:
        network = _quantised(network, model, frames)
    for name, text in exported_metadata(model).items():
        network.set_rt_info(text, [KEY, name])
    openvino.save_model(network, path, compress_to_fp16=False)


def _quantised(network: Any, model: Model, frames: Sequence[Gray]) -> Any:
    """Quantises the convolutions to int8: weights with a scale per channel, inputs calibrated on frames."""
    import nncf

    total = sum(len(clip) for clip in frames)
    if total < _SAMPLES:
        raise DataError(
            f"int8 needs at least {_SAMPLES} frames, and the recordings hold {total}; record more"
        )
    engine = _InputRecorder(model, total // _SAMPLES)
    for clip in frames:
        engine.reset()
        for frame in inputs_of(model, clip):
            engine.step(frame)
    kept = {"Convolution", "GroupConvolution"}
    nodes = network.get_ops()
    others = sorted({node.get_type_name() for node in nodes} - kept)
    # The first convolution stays too: one input channel, so little to gain, and small input values.
    first = [
        n.get_friendly_name()
        for n in nodes
        if n.get_type_name() == "Convolution" and n.input(1).get_shape()[1] == 1
    ]
    return nncf.quantize(
        network,
        nncf.Dataset(engine.recorded),
        subset_size=len(engine.recorded),
        fast_bias_correction=False,
        ignored_scope=nncf.IgnoredScope(types=others, names=first, validate=False),
    )


class _InputRecorder(TorchEngine):
    """Records the inputs of every n-th step."""

    def __init__(self, model: Model, every: int) -> None:
        super().__init__(model)
        self.recorded: list[list[Floats]] = []
        self._every, self._count = every, 0

    def _infer(self, frame: Floats) -> Step:
        self._count += self._begun
        if self._begun and self._count % self._every == 0:
            self.recorded.append([frame[None, None], *(np.array(tensor) for tensor in self._states)])
        return super()._infer(frame)


def _traced(model: Model) -> tuple[EnsembleStep, tuple[torch.Tensor, ...]]:
    step = EnsembleStep(load_checkpoint(model.path).networks).eval()
    size = model.header.preprocess.size
    return step, (torch.zeros(1, 1, size, size), *step.zero_states())


def inputs_of(model: Model, clip: Gray) -> Iterator[Floats]:
    """Yields the network's inputs, (S, S) float32, for a recording (T, S, S) uint8, as in a run."""
    normaliser = Normaliser(model.header.preprocess)
    for frame in clip:
        yield from normaliser.push(frame)


def _check(model: Model, path: Path, frames: Sequence[Gray] | None) -> ExportErrors:
    exact = frames is None
    if frames is None:
        size = model.header.preprocess.size
        frames = [np.random.default_rng(0).integers(0, 256, (_CHECKED, size, size), np.uint8)]
    made = Model(path, model.header, model.digest)
    frames = frames[:_CLIPS]
    expected_n, exported_n = (
        np.concatenate([_estimates(engine, model, clip) for clip in frames])
        for engine in (TorchEngine(model), open_engine(made, EXPORTED[path.suffix]))
    )
    error_n = np.abs(expected_n - exported_n)
    scale_n = max(member.label_scale_n for member in model.header.members)
    if not np.isfinite(error_n).all() or (exact and error_n.max() > TOLERANCE * scale_n):
        raise CheckpointError(
            f"the exported {path.suffix} file differs from PyTorch by {error_n.max():.2g} N; "
            "install other versions of the packages of gripper-force[engines], or use vision.engine=torch"
        )
    return {
        "largest_n": float(error_n.max()),
        "mean_n": float(error_n.mean()),
        "rms_n": float(np.sqrt(np.square(error_n).mean())),
    }


def with_added_error(header: Header, errors: ExportErrors) -> Header:
    """Returns the header with larger claimed errors, and without a score, which the rounding would exceed.

    Args:
        header: Header of the checkpoint.
        errors: Additional errors, taken as independent of the ones claimed so far.
    """
    added_n = {"mae_n": errors["mean_n"], "rmse_n": errors["rms_n"]}
    residuals = tuple(
        Residual(force_n=residual.force_n, std_n=math.hypot(residual.std_n, errors["rms_n"]))
        for residual in header.residuals
    )
    metrics = {
        name: math.hypot(value, added_n[name]) if name in added_n else value
        for name, value in header.metrics.items()
    }
    return header.model_copy(update={"residuals": residuals, "metrics": metrics, "ood": None})


def _replace_header(header: Header, path: Path) -> None:
    """Replaces the header in an OpenVINO file."""
    tree = ET.parse(path)  # noqa: S314 - written just before
    entry = tree.find(f"rt_info/{KEY}/header")
    assert entry is not None
    entry.set("value", header.model_dump_json(exclude_none=True))
    tree.write(path, encoding="utf-8", xml_declaration=True)


def _estimates(engine: Engine, model: Model, clip: Gray) -> Floats:
    engine.reset()
    return np.stack([engine.step(frame).forces_n.mean() for frame in inputs_of(model, clip)])


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
