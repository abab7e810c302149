"""From a checkpoint to the files that other engines run, each checked against PyTorch before it is kept."""

import logging
import math
import shutil
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
import torch

from gripper_force.errors import CheckpointError, ConfigError, DataError
from gripper_force.types import Gray
from gripper_force.vision.checkpoint import load_checkpoint
from gripper_force.vision.engines import Engine, Floats, open_engine
from gripper_force.vision.engines.pytorch import TorchEngine
from gripper_force.vision.ensemble_step import FRAME, EnsembleStep, state_names
from gripper_force.vision.header import EXPORTED, KEY, Header, Model, Residual, described
from gripper_force.vision.preprocess import Normaliser

TOLERANCE: Final = 1e-4
"""How far an exported network may be off PyTorch in float32, of the label's scale."""

_CHECKED: Final = 30
"""Frames that an exported network is checked on: more than a window."""

_CLIPS: Final = 4
"""Recordings that a quantised network is compared on."""

_SAMPLES: Final = 300
"""Frames that int8 is scaled on; NNCF's own default."""


def export(model: Model, path: Path, frames: Sequence[Gray] | None = None) -> dict[str, float]:
    """Writes an ensemble's streaming step as an ONNX or OpenVINO file, after the ending of ``path``.

    Args:
        model: The checkpoint.
        path: The file to write; an OpenVINO file's weights go beside it, into ``.bin``.
        frames: Recordings, (T, S, S) uint8 each, to scale the convolutions' int8 on; None: float32. What is
            no convolution, a tenth of the arithmetic or less, stays in floating point: all of the network in
            int8 was off by more than a newton.

    Returns:
        ``largest_n``, ``mean_n`` and ``rms_n``: how far it is off PyTorch on frames, of the recordings or of
        noise. What int8 is off by, the errors that the file claims hold as well.

    Raises:
        ConfigError: The ending is another, or a package is not installed.
        CheckpointError: The checkpoint can't be read, or what came out of it computes something else.
        DataError: The recordings are too few.
    """
    if path.suffix not in EXPORTED:
        raise ConfigError(f"{path} should end in {' or '.join(EXPORTED)}: that says what to export to")
    if frames is not None and path.suffix != ".xml":
        raise ConfigError("int8 is exported to OpenVINO: name a file that ends in .xml")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=path.parent) as folder, _quiet():
            made = Path(folder) / path.name
            (_openvino if path.suffix == ".xml" else _onnx)(model, made, frames)
            errors = _check(model, made, frames)
            if frames is not None:
                _claim(coarser(model.header, errors), made)
            # The weights first: what finds the one finds the other.
            for part in sorted(Path(folder).iterdir(), key=lambda part: part.suffix == path.suffix):
                shutil.move(part, path.parent / part.name)
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"exporting to {path.suffix} needs {error.name}: pip install 'gripper-force[engines]'"
        ) from error
    except OSError as error:
        raise CheckpointError(f"can't write {path}: {error.strerror}") from error
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
    for name, text in described(model).items():
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
    for name, text in described(model).items():
        network.set_rt_info(text, [KEY, name])
    openvino.save_model(network, path, compress_to_fp16=False)


def _quantised(network: Any, model: Model, frames: Sequence[Gray]) -> Any:
    """The convolutions in int8, each channel of their weights and their inputs scaled on frames."""
    import nncf

    total = sum(len(clip) for clip in frames)
    if total < _SAMPLES:
        raise DataError(f"int8 is scaled on at least {_SAMPLES} frames, and these recordings have {total}")
    engine = _Tapped(model, total // _SAMPLES)
    for clip in frames:
        engine.reset()
        for frame in inputs_of(model, clip):
            engine.step(frame)
    kept = {"Convolution", "GroupConvolution"}
    nodes = network.get_ops()
    others = sorted({node.get_type_name() for node in nodes} - kept)
    # The first convolution has one channel to read: little to gain, and what it sees is faint.
    first = [
        n.get_friendly_name()
        for n in nodes
        if n.get_type_name() == "Convolution" and n.input(1).get_shape()[1] == 1
    ]
    return nncf.quantize(
        network,
        nncf.Dataset(engine.seen),
        subset_size=len(engine.seen),
        fast_bias_correction=False,
        ignored_scope=nncf.IgnoredScope(types=others, names=first, validate=False),
    )


class _Tapped(TorchEngine):
    """Keeps what goes into a step, evenly over all of them."""

    def __init__(self, model: Model, every: int) -> None:
        super().__init__(model)
        self.seen: list[list[Floats]] = []
        self._every, self._count = every, 0

    def _run(self, frame: Floats) -> Any:
        self._count += self._begun
        if self._begun and self._count % self._every == 0:
            self.seen.append([frame[None, None], *(np.array(tensor) for tensor in self._state)])
        return super()._run(frame)


def _traced(model: Model) -> tuple[EnsembleStep, tuple[torch.Tensor, ...]]:
    step = EnsembleStep(load_checkpoint(model.path).networks).eval()
    size = model.header.preprocess.size
    return step, (torch.zeros(1, 1, size, size), *step.blank())


def inputs_of(model: Model, clip: Gray) -> Iterator[Floats]:
    """Prepares a recording, (T, S, S) uint8, as a run would."""
    normaliser = Normaliser(model.header.preprocess)
    for frame in clip:
        yield from normaliser.push(frame)


def _check(model: Model, path: Path, frames: Sequence[Gray] | None) -> dict[str, float]:
    exact = frames is None
    if frames is None:
        size = model.header.preprocess.size
        frames = [np.random.default_rng(0).integers(0, 256, (_CHECKED, size, size), np.uint8)]
    made = Model(path, model.header, model.digest)
    frames = frames[:_CLIPS]
    ours, theirs = (
        np.concatenate([_estimates(engine, model, clip) for clip in frames])
        for engine in (TorchEngine(model), open_engine(made, EXPORTED[path.suffix]))
    )
    off_n = np.abs(ours - theirs)
    scale_n = max(member.label_scale_n for member in model.header.members)
    if not np.isfinite(off_n).all() or (exact and off_n.max() > TOLERANCE * scale_n):
        raise CheckpointError(f"what came out as {path.suffix} is off by {off_n.max():.2g} N")
    return {
        "largest_n": float(off_n.max()),
        "mean_n": float(off_n.mean()),
        "rms_n": float(np.sqrt(np.square(off_n).mean())),
    }


def coarser(header: Header, errors: Mapping[str, float]) -> Header:
    """What a network says about itself that is off by so much more, in an independent way.

    Args:
        header: What it said before.
        errors: ``mean_n`` and ``rms_n`` of what came on top.
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
    return header.model_copy(update={"residuals": residuals, "metrics": metrics})


def _claim(header: Header, path: Path) -> None:
    """Puts another header into an OpenVINO file."""
    tree = ET.parse(path)  # noqa: S314 - it was written a moment ago
    entry = tree.find(f"rt_info/{KEY}/header")
    assert entry is not None
    entry.set("value", header.model_dump_json())
    tree.write(path, encoding="utf-8", xml_declaration=True)


def _estimates(engine: Engine, model: Model, clip: Gray) -> Floats:
    engine.reset()
    return np.stack([engine.step(frame).forces_n.mean() for frame in inputs_of(model, clip)])


@contextmanager
def _quiet() -> Iterator[None]:
    """The exporters talk about their own insides, on stdout too."""
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
