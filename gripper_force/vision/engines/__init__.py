"""Engines: what computes an ensemble's streaming step, chosen by name; all give the same newtons.

An engine is imported when a run names it, and of PyTorch, OpenVINO and ONNX Runtime only the one that runs.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt

from gripper_force.errors import ConfigError, NonFiniteError
from gripper_force.vision.header import Header, Model

Floats = npt.NDArray[np.float32]
Precision = Literal["float32", "bfloat16"]

ENGINES: Final = {
    "torch": "pytorch:TorchEngine",
    "openvino": "openvino:OpenVinoEngine",
    "onnxruntime": "onnxruntime:OnnxEngine",
}
"""Modules of this package, and classes in them."""


@dataclass(frozen=True, slots=True)
class Step:
    """What an ensemble makes of one frame.

    Attributes:
        forces_n: Each member's force, (M,).
        features: What the members' last layers make these from, side by side, (F,).
        attention: Where SSAM looks, (h, w) in 0..1; None without SSAM.
    """

    forces_n: Floats
    features: Floats
    attention: Floats | None


class Engine(ABC):
    """An ensemble, ready to take one frame after the other. One thread alone may use it."""

    def __init__(self, header: Header) -> None:
        self.header = header
        self._begun = False

    def reset(self) -> None:
        """Forgets the stream."""
        self._begun = False

    def step(self, frame: Floats) -> Step:
        """Takes the next prepared frame of the stream, (S, S).

        Raises:
            NonFiniteError: It holds NaN or infinity. The stream goes on as if it had not been there.
        """
        # OpenVINO's rectifier makes zeros of NaN, and a force like any other comes out.
        if not np.isfinite(frame).all():
            raise NonFiniteError("a prepared frame holds NaN or infinity; look at the camera's image")
        if not self._begun:
            # Frames before the first count as copies of it, so the first is taken in as often as it counts.
            self._blank()
            for _ in range(max(member.context for member in self.header.members)):
                self._run(frame)
            self._begun = True
        return self._run(frame)

    @abstractmethod
    def _blank(self) -> None:
        """Makes all states zero."""

    @abstractmethod
    def _run(self, frame: Floats) -> Step:
        """One step, from the states that the last one left."""


def open_engine(
    model: Model, engine: str = "torch", precision: Precision = "float32", threads: int = 1
) -> Engine:
    """Loads a model into an engine; the first step is as fast as any.

    Args:
        model: A checkpoint, or what `gripper_force.vision.export` made of one.
        engine: One of `ENGINES`.
        precision: Of the arithmetic; bfloat16 with OpenVINO only. What a file has in int8 stays so.
        threads: CPU threads to compute with.

    Raises:
        ConfigError: There is no such engine, its package is not installed, or it can't run this file so.
        CheckpointError: The file is damaged.
    """
    if engine not in ENGINES:
        raise ConfigError(f"no vision.engine {engine!r}; there are {', '.join(ENGINES)}")
    if precision != "float32" and engine != "openvino":
        raise ConfigError(f"vision.engine={engine} computes in float32: {precision} needs openvino")
    module, name = ENGINES[engine].split(":")
    opened: Engine = load_engine(module, name)(model, precision, threads)
    opened.step(np.zeros((model.header.preprocess.size,) * 2, np.float32))
    opened.reset()
    return opened


def load_engine(module: str, name: str) -> Any:
    """Imports an engine's class. Raises `ConfigError` where its package is not installed."""
    try:
        return getattr(import_module(f"gripper_force.vision.engines.{module}"), name)
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"vision.engine={module} needs the package {error.name}: pip install 'gripper-force[engines]'"
        ) from error
