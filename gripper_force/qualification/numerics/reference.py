"""An ensemble in float64, and error bounds for lower precisions.

The bounds come from float64 as well. Reduced precision is modelled as exact arithmetic on slightly perturbed
weights and activations (N. J. Higham, "Accuracy and Stability of Numerical Algorithms", 2002, sections 1.5
and 3.1). The float64 network is run a few times with its weights and the inputs of its convolutions perturbed
at random by the rounding error of a precision. An engine may differ by a few times the largest deviation of
these runs. So an ill-conditioned network gets a large bound, and a well-conditioned one a small bound.
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

from gripper_force.jobs.int8_export import export_int8
from gripper_force.types import Gray
from gripper_force.vision.checkpoint import load_checkpoint
from gripper_force.vision.engines import Engine, Floats, Precision, open_engine
from gripper_force.vision.export import export
from gripper_force.vision.header import Model
from gripper_force.vision.model_files import read_model
from gripper_force.vision.network import ForceNetwork

_DRAWS: Final = 4
"""Random perturbations for a bound."""

_MARGIN: Final = 4.0
"""Bound over the largest deviation: draws are few, and perturb only weights and inputs of convolutions."""

EPS: Final = 2.0**-24
"""Relative rounding error of float32."""

Float64Result = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Rounding:
    """Relative rounding errors of a precision.

    Attributes:
        sums: Of a sum; it grows with the square root of the number of products (N. J. Higham and T. Mary, "A
            new approach to probabilistic rounding error analysis", 2019, doi:10.1137/18M1226312).
        numbers: Of each weight, and of each input of a convolution.
        steps: Quantisation step over the largest weight of a channel, and over the range of the inputs of a
            convolution.
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
    """An engine with a precision.

    Attributes:
        engine: Key of `gripper_force.vision.engines.ENGINES`.
        precision: Key of `ROUNDING`.
        file: Ending of the model file.
    """

    engine: str
    precision: str
    file: str

    @property
    def name(self) -> str:
        """Engine and precision as text."""
        return f"{self.engine}, {self.precision}"


ENGINE_VARIANTS: Final = (
    EngineVariant("torch", "float32", ".safetensors"),
    EngineVariant("openvino", "float32", ".xml"),
    EngineVariant("openvino", "bfloat16", ".xml"),
    EngineVariant("openvino", "int8", "-int8.xml"),
    EngineVariant("onnxruntime", "float32", ".onnx"),
)


class ReferenceEnsemble:
    """An ensemble in float64, and the engines that run it.

    Attributes:
        model: The checkpoint.
        networks: Networks in float64.
        reported_n: Largest error that the last export reported, in N.
    """

    def __init__(self, model: Model, folder: Path) -> None:
        self.model = model
        self.networks = [
            copy.deepcopy(network).double() for network in load_checkpoint(model.path).force_networks
        ]
        self.reported_n = math.nan
        self._folder = folder

    def open(self, variant: EngineVariant, clips: Sequence[Gray] = ()) -> Engine:
        """Opens an engine; its model file is exported at the first use.

        Args:
            variant: Engine and precision.
            clips: Recordings to calibrate int8 on, (T, H, W) each.

        Raises:
            CheckpointError: The exported model computes something else.
        """
        model = self.model
        if variant.engine != "torch":
            path = self._folder / f"{model.path.stem}{variant.file}"
            if not path.exists():
                int8 = variant.precision == "int8"
                reported = export_int8(model, path, clips) if int8 else export(model, path)
                self.reported_n = reported["largest_n"]
            model = read_model(path)
        precision: Precision = "bfloat16" if variant.precision == "bfloat16" else "float32"
        return open_engine(model, variant.engine, precision)

    def forces_n(self, inputs: Floats | Float64Result) -> Float64Result:
        """Forces of each member in N, (M, T), for prepared frames (T, S, S)."""
        return _forces_n(self.networks, inputs)

    def bound_n(
        self, inputs: Floats | Float64Result, rounding: Rounding, input_error: float = 0.0
    ) -> Float64Result:
        """Error bound of each member in N, (M,); see the module.

        Args:
            inputs: Prepared frames, (T, S, S).
            rounding: Rounding errors of the precision.
            input_error: Largest error of the inputs themselves.
        """
        true_n = self.forces_n(inputs)
        rng = np.random.default_rng(0)
        generator = torch.Generator().manual_seed(0)
        largest_n = np.zeros(len(self.networks))
        for _ in range(_DRAWS):
            networks = [_perturbed(network, rounding, generator) for network in self.networks]
            perturbed_n = _forces_n(networks, inputs + input_error * rng.choice((-1.0, 1.0), inputs.shape))
            largest_n = np.maximum(largest_n, np.abs(perturbed_n - true_n).max(1))
        # The output is scaled by the label scale, whose rounding error always remains.
        scale_n = np.array([network.config.label_scale_n for network in self.networks])
        bound_n: Float64Result = _MARGIN * (largest_n + EPS * scale_n)
        return bound_n


@torch.inference_mode()
def _forces_n(networks: Sequence[ForceNetwork], inputs: Floats | Float64Result) -> Float64Result:
    clip = torch.from_numpy(inputs.astype(np.float64))[None, :, None]  # (1, T, 1, S, S)
    return np.stack([network(clip)[0].numpy() for network in networks])


@torch.no_grad()
def _perturbed(network: ForceNetwork, rounding: Rounding, generator: torch.Generator) -> ForceNetwork:
    """Copy of a network whose weights and convolution inputs are perturbed by their rounding errors."""

    def signs(like: Tensor) -> Tensor:
        return torch.randint(0, 2, like.shape, generator=generator).to(like) * 2 - 1

    def rounded(_convolution: nn.Module, given: tuple[Tensor]) -> Tensor:
        x = given[0]
        return x + signs(x) * (x.abs() * rounding.numbers + (x.max() - x.min()) * rounding.steps / 2)

    perturbed = copy.deepcopy(network)
    for module in perturbed.modules():
        convolves = isinstance(module, nn.Conv2d)
        for weight in module.parameters(recurse=False):
            products = weight[0].numel() if weight.dim() > 1 else 1
            error = weight.abs() * (rounding.sums * math.sqrt(products) + rounding.numbers)
            if convolves and weight.dim() > 1:
                error = error + weight.abs().amax((1, 2, 3), keepdim=True) * rounding.steps
            weight.add_(signs(weight) * error)
        if convolves and (rounding.numbers or rounding.steps):
            module.register_forward_pre_hook(rounded)
    return perturbed
