"""The modules against the paper's equations, written out with loops over positions and channels."""

import numpy as np
import pytest
import torch

from gripper_force.vision.attention import ChannelAttention, SpatialAttention

C, H, W = 3, 2, 4


def sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x))


@pytest.fixture(params=[0, 1, 2])
def earlier(request: pytest.FixtureRequest) -> int:
    torch.manual_seed(request.param)
    return int(request.param)


@torch.no_grad()
def test_ssam_is_equations_1_to_3(earlier: int) -> None:
    module = SpatialAttention(C, earlier)
    stack = torch.randn(1, (earlier + 1) * C, H, W)
    weights, bias = module.pool.weight[0, :, 0, 0].numpy(), module.pool.bias.item()
    x = stack[0].numpy()
    expected = np.empty((C, H, W))
    for i, j in np.ndindex(H, W):
        gate = sigmoid(sum(w * value for w, value in zip(weights, x[:, i, j], strict=True)) + bias)
        expected[:, i, j] = gate * x[-C:, i, j] + x[-C:, i, j]
    excited, gates = module(stack, stack[:, -C:])
    np.testing.assert_allclose(excited[0], expected, rtol=1e-5)
    assert gates.shape == (1, 1, H, W)


@torch.no_grad()
def test_scam_is_equations_4_to_6(earlier: int) -> None:
    module = ChannelAttention(C, earlier, positions=H * W, reduction=2)
    torch.nn.init.normal_(module.pool)
    stack = torch.randn(1, (earlier + 1) * C, H, W)
    x = stack[0].numpy()
    y = np.array([(module.pool.numpy() * channel.ravel()).sum() for channel in x])
    hidden = np.maximum(module.squeeze.weight.numpy() @ y + module.squeeze.bias.numpy(), 0)
    gate = sigmoid(module.excite.weight.numpy() @ hidden + module.excite.bias.numpy())
    expected = gate[:, None, None] * x[-C:] + x[-C:]
    excited, gates = module(stack, stack[:, -C:])
    np.testing.assert_allclose(excited[0], expected, rtol=1e-5)
    assert gates.shape == (1, C, 1, 1)


@torch.no_grad()
def test_wap_of_positions_starts_as_the_average() -> None:
    module = ChannelAttention(C, 0, positions=H * W, reduction=2)
    x = torch.randn(1, C, H, W)
    torch.testing.assert_close(x.flatten(2) @ module.pool, x.mean((2, 3)))
