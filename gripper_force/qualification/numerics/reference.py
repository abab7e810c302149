"""An ensemble in float64, and how far off it may be in fewer digits.

The bounds come from float64 as well. To compute in few digits is to compute exactly with weights and
activations that are a little off (N. J. Higham, "Accuracy and Stability of Numerical Algorithms", 2002,
sections 1.5 and 3.1). So the float64 network is run with its weights, and what goes into its convolutions,
moved at random by what the precision rounds away, a few times; an engine may be off by a few times as much as
the farthest of these runs. An ill-conditioned network gets the wide bound that it deserves, a good one a
narrow one.
"""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from gripper_force.types import Gray
from gripper_force.vision.checkpoint import load_checkpoint
from gripper_force.vision.engines import Engine, Floats, Precision, open_engine
from gripper_force.vision.export import export
from gripper_force.vision.header import Model
from gripper_force.vision.model_files import read_model
from gripper_force.vision.network import ForceNetwork

_DRAWS: Final = 4
_MARGIN: Final = 4.0
"""How many times the farthest of the draws an engine may be off: the draws are few, and round nothing but
weights and what goes into convolutions."""

EPS: Final = 2.0**-24
"""What float32 rounds away, as a share."""

Float64Result = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Rounding:
    """What a precision rounds away, as shares.

    Attributes:
        sums: Of a sum, for each of its products; it grows with their root (N. J. Higham and T. Mary, "A new
            approach to probabilistic rounding error analysis", 2019, doi:10.1137/18M1226312).
        numbers: Of each weight, and of each number that goes into a convolution.
        steps: Of the largest weight of a channel, and of the range of what goes into a convolution.
    """

    sums: float = EPS
    numbers: float = 0.0
    steps: float = 0.0


ROUNDING: Final = {
    "float32": Rounding(),
    "bfloat16": Rounding(numbers=2.0**-9),
    "int8": Rounding(steps=1 / 255),
}


@dataclass(frozen=True, slots=True)
class EngineVariant:
    """A variant to compute.

    Attributes:
        engine: One of `gripper_force.vision.engines.ENGINES`.
        precision: One of `ROUNDING`.
        file: Ending of the file that it runs.
    """

    engine: str
    precision: str
    file: str

    @property
    def name(self) -> str:
        """In words."""
        return f"{self.engine}, {self.precision}"


ENGINE_VARIANTS: Final = (
    EngineVariant("torch", "float32", ".safetensors"),
    EngineVariant("openvino", "float32", ".xml"),
    EngineVariant("openvino", "bfloat16", ".xml"),
    EngineVariant("openvino", "int8", "-int8.xml"),
    EngineVariant("onnxruntime", "float32", ".onnx"),
)


class ReferenceEnsemble:
    """An ensemble in float64, and beside it the engines that run it.

    Attributes:
        model: Its checkpoint.
        networks: In float64.
        said_n: Largest error that its last export told of.
    """

    def __init__(self, model: Model, folder: Path) -> None:
        self.model = model
        self.networks = [copy.deepcopy(network).double() for network in load_checkpoint(model.path).networks]
        self.said_n = math.nan
        self._folder = folder

    def open(self, variant: EngineVariant, clips: Sequence[Gray] = ()) -> Engine:
        """An engine, its file made at the first use.

        Args:
            variant: Which.
            clips: Recordings to scale int8 on.

        Raises:
            CheckpointError: What the export made computes something else.
        """
        model = self.model
        if variant.engine != "torch":
            path = self._folder / f"{model.path.stem}{variant.file}"
            if not path.exists():
                said = export(model, path, clips if variant.precision == "int8" else None)
                self.said_n = said["largest_n"]
            model = read_model(path)
        precision: Precision = "bfloat16" if variant.precision == "bfloat16" else "float32"
        return open_engine(model, variant.engine, precision)

    def forces_n(self, inputs: Floats | Float64Result) -> Float64Result:
        """Each member's forces for prepared frames (T, S, S), (M, T)."""
        return _forces_n(self.networks, inputs)

    def bound_n(self, inputs: Floats | Float64Result, rounding: Rounding, off: float = 0.0) -> Float64Result:
        """How far off each member may be, (M,); see the module.

        Args:
            inputs: Prepared frames, (T, S, S).
            rounding: What is lost.
            off: How far the inputs themselves may be off.
        """
        true_n = self.forces_n(inputs)
        rng = np.random.default_rng(0)
        generator = torch.Generator().manual_seed(0)
        farthest_n = np.zeros(len(self.networks))
        for _ in range(_DRAWS):
            networks = [_moved(network, rounding, generator) for network in self.networks]
            moved_n = _forces_n(networks, inputs + off * rng.choice((-1.0, 1.0), inputs.shape))
            farthest_n = np.maximum(farthest_n, np.abs(moved_n - true_n).max(1))
        # The last digit of the label's scale is lost in any case.
        scale_n = np.array([network.config.label_scale_n for network in self.networks])
        bound_n: Float64Result = _MARGIN * (farthest_n + EPS * scale_n)
        return bound_n


@torch.inference_mode()
def _forces_n(networks: Sequence[ForceNetwork], inputs: Floats | Float64Result) -> Float64Result:
    clip = torch.from_numpy(inputs.astype(np.float64))[None, :, None]  # (1, T, 1, S, S)
    return np.stack([network(clip)[0].numpy() for network in networks])


@torch.no_grad()
def _moved(network: ForceNetwork, rounding: Rounding, generator: torch.Generator) -> ForceNetwork:
    """A copy whose weights are off by what is rounded away, and what goes into its convolutions as well."""

    def signs(like: Tensor) -> Tensor:
        return torch.randint(0, 2, like.shape, generator=generator).to(like) * 2 - 1

    def rounded(_convolution: nn.Module, given: tuple[Tensor]) -> Tensor:
        x = given[0]
        return x + signs(x) * (x.abs() * rounding.numbers + (x.max() - x.min()) * rounding.steps / 2)

    moved = copy.deepcopy(network)
    for module in moved.modules():
        convolves = isinstance(module, nn.Conv2d)
        for weight in module.parameters(recurse=False):
            products = weight[0].numel() if weight.dim() > 1 else 1
            off = weight.abs() * (rounding.sums * math.sqrt(products) + rounding.numbers)
            if convolves and weight.dim() > 1:
                off = off + weight.abs().amax((1, 2, 3), keepdim=True) * rounding.steps
            weight.add_(signs(weight) * off)
        if convolves and (rounding.numbers or rounding.steps):
            module.register_forward_pre_hook(rounded)
    return moved
