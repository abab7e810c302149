"""Attention modules against their papers' equations, computed with loops over positions and channels."""

import numpy as np
import numpy.typing as npt
import pytest
import torch
from torch import Tensor, nn

from gripper_force.vision.attention import Cbam, ChannelAttention, SpatialAttention, SqueezeExcitation
from gripper_force.vision.header import Pooling

C, H, W = 4, 2, 3
Array = npt.NDArray[np.float64]

pooled_both_ways = pytest.mark.parametrize("pooling", ["wap", "gap"])


def sigmoid(x: Array) -> Array:
    return 1 / (1 + np.exp(-x))


def relu(x: Array) -> Array:
    return np.maximum(x, 0)


def drawn(module: nn.Module) -> dict[str, Array]:
    """Converts the module to float64 and draws random parameters."""
    for parameter in module.double().requires_grad_(False).parameters():
        nn.init.normal_(parameter)
    return {name: parameter.numpy() for name, parameter in module.named_parameters()}


@pytest.fixture(params=[0, 1, 2])
def stack(request: pytest.FixtureRequest) -> Tensor:
    torch.manual_seed(request.param)
    return torch.randn(1, (request.param + 1) * C, H, W, dtype=torch.float64)


def assert_excites(module: nn.Module, stack: Tensor, expected: Array, gates: Array) -> None:
    excited, seen = module(stack, stack[:, -C:])
    np.testing.assert_allclose(excited[0], expected, rtol=1e-12)
    np.testing.assert_allclose(seen[0], gates, rtol=1e-12)


@pooled_both_ways
def test_ssam_is_equations_1_to_3(stack: Tensor, pooling: Pooling) -> None:
    module = SpatialAttention(C, stack.shape[1] // C - 1, pooling)
    given, x = drawn(module), stack[0].numpy()
    weights = given["pool.weight"].ravel() if pooling == "wap" else np.full(len(x), 1 / len(x))
    bias = given["pool.bias" if pooling == "wap" else "bias"][0]
    gates, expected = np.empty((1, H, W)), np.empty((C, H, W))
    for i, j in np.ndindex(H, W):
        gates[0, i, j] = sigmoid(sum(w * v for w, v in zip(weights, x[:, i, j], strict=True)) + bias)
        expected[:, i, j] = gates[0, i, j] * x[-C:, i, j] + x[-C:, i, j]
    assert_excites(module, stack, expected, gates)


@pooled_both_ways
def test_scam_is_equations_4_to_6(stack: Tensor, pooling: Pooling) -> None:
    module = ChannelAttention(C, stack.shape[1] // C - 1, positions=H * W, reduction=2, pooling=pooling)
    given, x = drawn(module), stack[0].numpy()
    weights = given["pool"] if pooling == "wap" else np.full(H * W, 1 / (H * W))
    y = np.array([sum(w * v for w, v in zip(weights, channel.ravel(), strict=True)) for channel in x])
    hidden = relu(given["squeeze.weight"] @ y + given["squeeze.bias"])
    assert len(hidden) == len(x) // 2
    gates = sigmoid(given["excite.weight"] @ hidden + given["excite.bias"])
    expected = np.stack([gate * channel + channel for gate, channel in zip(gates, x[-C:], strict=True)])
    assert_excites(module, stack, expected, gates[:, None, None])


def test_se_is_equations_2_to_4_of_its_paper(stack: Tensor) -> None:
    module = SqueezeExcitation(C, reduction=2)
    (w_1, w_2), x = drawn(module).values(), stack[0, -C:].numpy()
    assert w_1.shape == (2, C)
    z = np.array([channel.sum() / (H * W) for channel in x])
    gates = sigmoid(w_2 @ relu(w_1 @ z))
    expected = np.stack([gate * channel for gate, channel in zip(gates, x, strict=True)])
    assert_excites(module, stack, expected, gates[:, None, None])


def test_cbam_is_equations_1_to_3_of_its_paper(stack: Tensor) -> None:
    module = Cbam(C, reduction=2)
    (w_0, w_1, kernel), x = drawn(module).values(), stack[0, -C:].numpy()
    mean, largest = np.array([[channel.mean(), channel.max()] for channel in x]).T
    of_channels = sigmoid(w_1 @ relu(w_0 @ mean) + w_1 @ relu(w_0 @ largest))
    refined = np.stack([gate * channel for gate, channel in zip(of_channels, x, strict=True)])
    planes = np.pad([refined.mean(0), refined.max(0)], ((0, 0), (3, 3), (3, 3)))
    gates = np.empty((1, H, W))
    for i, j in np.ndindex(H, W):
        gates[0, i, j] = sigmoid((kernel[0] * planes[:, i : i + 7, j : j + 7]).sum())
    assert_excites(module, stack, gates * refined, gates)


@torch.no_grad()
def test_wap_over_positions_is_initialised_as_average() -> None:
    module = ChannelAttention(C, 0, positions=H * W, reduction=2, pooling="wap")
    x = torch.randn(1, C, H, W)
    assert module.pool is not None
    torch.testing.assert_close(x.flatten(2) @ module.pool, x.mean((2, 3)))


def test_perceptron_has_at_least_one_unit() -> None:
    for module in (SqueezeExcitation(3, reduction=16), Cbam(3, reduction=16)):
        excited, _ = module(torch.ones(2, 3, 1, 1), torch.ones(2, 3, 1, 1))
        assert excited.shape == (2, 3, 1, 1)
