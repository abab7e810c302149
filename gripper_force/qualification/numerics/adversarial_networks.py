"""Numerically hard small networks."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Final

import torch
from torch import nn

from gripper_force.vision.backbones import Vgg
from gripper_force.vision.checkpoint_writer import save_checkpoint
from gripper_force.vision.header import Header, Model, NetworkConfig, Residual
from gripper_force.vision.model_files import read_model
from gripper_force.vision.network import ForceNetwork
from gripper_force.vision.preprocess import Preprocess

Change = Callable[[ForceNetwork], None]

KNOWN_N: Final = (0.5, 9.5)
"""Forces in N at which the validation error of these networks is given."""


def scaled(factor: float, recurrence: float = 1.0) -> Change:
    """Scales the weights of gates and tanh layers by ``factor``, recurrent ones by ``recurrence``."""

    def change(network: ForceNetwork) -> None:
        for part in (network.attention, network.blstm, network.dense):
            assert part is not None
            for name, weight in part.named_parameters():
                weight.mul_(recurrence if "weight_hh" in name else factor)

    return change


def _variance(variance: float) -> Change:
    def change(network: ForceNetwork) -> None:
        for module in network.modules():
            if isinstance(module, nn.BatchNorm2d):
                assert module.running_var is not None
                module.running_var.fill_(variance)

    return change


def _denormal(network: ForceNetwork) -> None:
    for name, weight in network.named_parameters():
        if "second.2" in name or "dense" in name:
            weight.mul_(1e-39)


def faint(network: ForceNetwork) -> None:
    """Makes activations denormal in float32, and scales them up in the next layer."""
    first, second = _pair(network, 2)
    assert first.bias is not None
    first.weight.mul_(1e-39)
    first.bias.mul_(1e-39)
    second.weight.mul_(1e38)


def outlier(network: ForceNetwork) -> None:
    """Scales a channel of each pair of layers by 1000 and back in the next layer; forces do not change."""
    for i in range(5):
        first, second = _pair(network, i)
        assert first.bias is not None
        first.weight[0] *= 1e3
        first.bias[0] *= 1e3
        second.weight[:, 0] /= 1e3


def overflow(network: ForceNetwork) -> None:
    """Scales weights so that their products overflow float32."""
    for i in range(5):
        for convolution in _pair(network, i):
            convolution.weight.mul_(1e15)


def _pair(network: ForceNetwork, index: int) -> tuple[nn.Conv2d, nn.Conv2d]:
    backbone = network.backbone
    assert isinstance(backbone, Vgg)
    first, second = backbone.first[index], backbone.second[index]
    assert isinstance(first, nn.Conv2d)
    assert isinstance(second, nn.Conv2d)
    return first, second


HARD: Final[dict[str, Change]] = {
    "random weights": lambda _network: None,
    "one channel x 1000": outlier,
    "denormal weights, x 1e-39": _denormal,
    "gates and tanh saturated, weights x 100": scaled(1e2),
    "gates and tanh saturated, weights x 10^4": scaled(1e4),
    "batch-norm variance 1e-12": _variance(1e-12),
    "batch-norm variance 1e-38": _variance(1e-38),
    "batch-norm variance 0": _variance(0.0),
}
STEEP: Final = tuple(HARD)[3:]
"""Changes after which the 8 significant bits of bfloat16 leave no correct digit."""


def drawn(change: Change, attention: str = "ssam", size: int = 32) -> ForceNetwork:
    """Small network with random weights, changed by ``change``."""
    shape = {"attention": attention, "size": size, "width": 0.25, "hidden": 16, "head": 32}
    network = ForceNetwork(NetworkConfig.model_validate(shape))
    with torch.no_grad():
        for weight in network.backbone.parameters():
            if weight.dim() == 4:
                # PyTorch's initial weights are so small that the image signal vanishes; this is He's scale.
                weight.mul_(math.sqrt(6))
        change(network)
    return network.eval().requires_grad_(False)


def saved(path: Path, *networks: ForceNetwork) -> Model:
    """Saves an ensemble as a checkpoint, and returns its model."""
    header = Header(
        members=tuple(network.config for network in networks),
        preprocess=Preprocess(size=networks[0].config.size),
        residuals=tuple(Residual(force_n=force_n, std_n=0.1) for force_n in KNOWN_N),
        data_digest="",
        metrics={},
    )
    save_checkpoint(path, networks, header)
    return read_model(path)
