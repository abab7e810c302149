"""Engines: libraries that compute an ensemble's streaming step. All give the same forces.

Only the library of the engine that a run names is imported.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Final, Literal, get_args

import numpy as np
import numpy.typing as npt

from gripper_force.errors import ConfigError, NonFiniteError
from gripper_force.plugins import load_class
from gripper_force.vision.header import Header, Model

Floats = npt.NDArray[np.float32]
Precision = Literal["float32", "bfloat16"]

ENGINES: Final = {
    "torch": "gripper_force.vision.engines.pytorch:TorchEngine",
    "openvino": "gripper_force.vision.engines.openvino:OpenVinoEngine",
    "onnxruntime": "gripper_force.vision.engines.onnxruntime:OnnxEngine",
}
"""Built-in engines: name and class. Each name is also that of the package that the engine needs."""


@dataclass(frozen=True, slots=True)
class StepOutput:
    """Output of an ensemble for one frame.

    Attributes:
        forces_n: Force estimate of each of the M members, (M,).
        features: Inputs of the members' last layers, concatenated over the members, (F,).
        attention: Attention map of SSAM, (h, w) in 0..1; None without SSAM.
    """

    forces_n: Floats
    features: Floats
    attention: Floats | None

    def __post_init__(self) -> None:
        """Raises `TypeError` if a field, perhaps of an engine of another package, is no array with its dimensions."""
        vectors = (self.forces_n, self.features, *(() if self.attention is None else self.attention[:1]))
        kinds = {(one.ndim, one.dtype.kind) if isinstance(one, np.ndarray) else 0 for one in vectors}
        if kinds != {(1, "f")}:
            raise TypeError(
                "forces_n and features must be NumPy arrays of floats of 1 dimension, attention of 2, or None"
            )


class Engine(ABC):
    """An ensemble that takes one frame after the other. Not thread-safe.

    A subclass is constructed as ``Class(model, precision, threads)``, with the arguments of `open_engine`,
    and implements `_zero_states` and `_infer`. `gripper_force.testing.engine_contract.EngineContract` tests
    it.
    """

    def __init__(self, header: Header) -> None:
        self.header = header
        self._has_begun = False

    def reset(self) -> None:
        """Forgets all frames; the next one is the first of a new stream."""
        self._has_begun = False

    def warm_up(self) -> None:
        """Runs the networks once, so that the first step of a stream is as fast as the others."""
        self._zero_states()
        self._infer(np.zeros((self.header.preprocess.size,) * 2, np.float32))
        self.reset()

    def step(self, frame: Floats) -> StepOutput:
        """Processes the next prepared frame of the stream.

        Args:
            frame: Output of `gripper_force.vision.preprocess.Normaliser`, (S, S).

        Raises:
            NonFiniteError: The frame holds NaN or infinity. It is skipped: the states do not change.
        """
        # OpenVINO's ReLU maps NaN to 0, so the result would look like any other force.
        if not np.isfinite(frame).all():
            raise NonFiniteError("a prepared frame holds NaN or infinity; check the camera's image")
        if not self._has_begun:
            # Frames before the first count as copies of the first.
            self._zero_states()
            for _ in range(max(member.context for member in self.header.members)):
                self._infer(frame)
            self._has_begun = True
        return self._infer(frame)

    @abstractmethod
    def _zero_states(self) -> None:
        """Sets all states of the networks to zero."""

    @abstractmethod
    def _infer(self, frame: Floats) -> StepOutput:
        """Runs the networks on one frame, (S, S), and updates the states."""


def open_engine(
    model: Model, engine: str = "onnxruntime", precision: Precision = "float32", threads: int | None = 1
) -> Engine:
    """Loads a model into an engine and runs it once, so that a run's first step is as fast as the others.

    Args:
        model: A checkpoint, or a file that `gripper_force.vision.export` made of one.
        engine: One of `ENGINES`, a name registered as an entry point in the group ``gripper_force.engines``,
            or ``package.module:Class``.
        precision: Precision of the arithmetic. Of the built-in engines only OpenVINO computes in bfloat16.
            Layers that a file holds in int8 stay in int8.
        threads: CPU threads to compute with. PyTorch has one setting for the whole process, which is changed;
            None leaves it as it is, and gives ONNX Runtime one, and OpenVINO its default, all cores.

    Raises:
        ConfigError: The engine or the precision is unknown, a package is not installed, or the engine can't
            run this file or this precision.
        CheckpointError: The file is damaged.
    """
    if precision not in get_args(Precision):
        raise ConfigError(f"unknown vision.precision {precision!r}; use {' or '.join(get_args(Precision))}")
    if threads is not None and not (isinstance(threads, int | np.integer) and threads > 0):
        raise ConfigError(f"vision.threads {threads!r} is not a whole number from 1 on; name one, or None")
    if precision != "float32" and engine in ENGINES and engine != "openvino":
        raise ConfigError(f"vision.engine={engine} computes in float32 only; {precision} needs openvino")
    hint = "" if engine == "onnxruntime" else ", or set vision.engine=onnxruntime"
    opened: Engine = load_class("engines", ENGINES, engine, "vision.engine", hint)(model, precision, threads)
    opened.warm_up()
    return opened
