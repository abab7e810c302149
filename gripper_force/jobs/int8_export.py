"""Export of a checkpoint to OpenVINO with int8 convolutions, calibrated on recordings."""

import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from gripper_force.errors import ConfigError, DataError
from gripper_force.types import Gray
from gripper_force.vision.engines import Floats, StepOutput
from gripper_force.vision.engines.pytorch import TorchEngine
from gripper_force.vision.export import (
    ExportErrors,
    export_errors,
    openvino_network,
    save_openvino,
    written,
)
from gripper_force.vision.header import KEY, Header, Model, Residual
from gripper_force.vision.stream_inference import stream

_SAMPLES: Final = 300
"""Frames that the recordings must hold, and about the largest number to calibrate on; NNCF's default."""

_HELD_OUT: Final = 4
"""Largest number of recordings that the error is measured on."""


def export_int8(model: Model, path: Path, frames: Sequence[Gray]) -> ExportErrors:
    """Writes an ensemble's streaming step as an OpenVINO file, with its convolutions in int8.

    Other layers, a tenth of the arithmetic or less, stay in floating point: with the whole network in int8, errors
    exceeded 1 N.

    Args:
        model: The checkpoint.
        path: File to write, ``.xml``; see `gripper_force.vision.export.export`.
        frames: Recordings, (T, S, S) uint8 each. The last ones, or the second half of a single one, are held out; the
            ranges are calibrated on the others.

    Returns:
        The difference from PyTorch, on the recordings held out. The header of the file claims errors that include it.

    Raises:
        ConfigError: The suffix is another one, or a package is not installed.
        CheckpointError: The checkpoint can't be read, the file can't be written, or its estimates are not finite.
        DataError: The recordings hold too few frames.
    """
    check_int8_name(path)
    frames = [
        clip for clip in frames if len(clip) > model.header.preprocess.lead_in
    ]  # others give no estimate
    total = sum(len(clip) for clip in frames)
    if total < _SAMPLES:
        raise DataError(
            f"int8 needs at least {_SAMPLES} frames, and the recordings hold {total}; record more"
        )
    calibrated, held_out = _split(frames, model.header.preprocess.reference_frames)
    with written(path) as made:
        save_openvino(_quantised(openvino_network(model), model, calibrated), model, made)
        errors = export_errors(model, made, held_out)
        _replace_header(with_added_error(model.header, errors), made)
    return errors


def check_int8_name(path: Path) -> None:
    """Raises `ConfigError` if an int8 network can't be exported to this file, before logs are read for it."""
    if path.suffix != ".xml":
        raise ConfigError(f"int8 is exported to OpenVINO only, not to {path}; name a file that ends in .xml")


def _split(frames: Sequence[Gray], reference_frames: int) -> tuple[list[Gray], list[Gray]]:
    """Returns the recordings to calibrate on, and those to measure the error on."""
    if len(frames) == 1:
        (clip,) = frames
        middle = len(clip) // 2
        return [clip[:middle]], [np.concatenate([clip[:reference_frames], clip[middle:]])]
    count = min(_HELD_OUT, len(frames) // 2)
    return list(frames[:-count]), list(frames[-count:])


def _quantised(network: Any, model: Model, frames: Sequence[Gray]) -> Any:
    """Quantises the convolutions to int8: weights with a scale per channel, inputs calibrated on frames."""
    import nncf

    engine = _InputRecorder(model, max(1, sum(len(clip) for clip in frames) // _SAMPLES))
    for clip in frames:
        for _ in stream(engine, clip):
            pass  # the engine keeps what its layers take
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

    def _infer(self, frame: Floats) -> StepOutput:
        self._count += self._has_begun
        if self._has_begun and self._count % self._every == 0:
            self.recorded.append([frame[None, None], *(np.array(tensor) for tensor in self._states)])
        return super()._infer(frame)


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
