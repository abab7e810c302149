from collections.abc import Iterator
from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from torch import Tensor, nn

from gripper_force.qualification.bench.roofline import cost
from gripper_force.vision.header import NetworkConfig
from gripper_force.vision.network import ForceNetwork, LastStepBlstm, StreamState

TINY = NetworkConfig(size=16, width=0.25, window=5, hidden=6, head=7, reduction=4)
SIZES = {"vgg": 32, "resnet18": 64, "mobile": 32}


def build(config: NetworkConfig, seed: int = 0) -> ForceNetwork:
    """Returns a network in evaluation mode with random parameters and batch statistics."""
    torch.manual_seed(seed)
    network = ForceNetwork(config)
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            assert module.running_mean is not None
            assert module.running_var is not None
            nn.init.normal_(module.running_mean, std=0.1)
            nn.init.uniform_(module.running_var, 0.5, 1.5)
            nn.init.uniform_(module.weight, 0.5, 1.5)
            nn.init.normal_(module.bias, std=0.1)
    return network.eval()


def as_torch_blstm(blstm: LastStepBlstm) -> nn.LSTM:
    """Returns PyTorch's bidirectional LSTM with the same weights, and noise in those that have no effect."""
    hidden = blstm.forward_lstm.hidden_size
    full = nn.LSTM(blstm.forward_lstm.input_size, hidden, batch_first=True, bidirectional=True)
    for name, weight in blstm.forward_lstm.named_parameters():
        getattr(full, name).data.copy_(weight)
    keep = torch.cat([torch.arange(hidden), torch.arange(2 * hidden, 4 * hidden)])  # in, (forget,) cell, out
    full.get_parameter("weight_ih_l0_reverse").data[keep] = blstm.backward_linear.weight
    full.get_parameter("bias_ih_l0_reverse").data[keep] = blstm.backward_linear.bias
    full.get_parameter("bias_hh_l0_reverse").data.zero_()
    return full


def literal(network: ForceNetwork, frames: Tensor) -> Tensor:
    """Computes the newest force without a state: (context + 1, 1, S, S) to ()."""
    config = network.config
    maps = [network.backbone(frame[None]) for frame in frames]
    vectors = []
    for t in range(len(maps) - config.window, len(maps)):
        excited = maps[t]
        if network.attention is not None:
            seen = config.earlier_frames if config.attention in ("ssam", "scam") else 0
            excited, _ = network.attention(torch.cat(maps[t - seen : t + 1], dim=1), maps[t])
        vectors.append(excited.mean((2, 3)))
    states, _ = as_torch_blstm(network.blstm)(torch.stack(vectors, dim=1))
    forces: Tensor = network.out(torch.tanh(network.dense(states[:, -1])))
    return forces[0, 0] * config.label_scale_n


def history(network: ForceNetwork, clip: Tensor, t: int) -> Tensor:
    """Returns the frames that the estimate at t depends on, padded with copies of the first."""
    return clip[torch.arange(t - network.config.context, t + 1).clamp_min(0)]


def stream(network: ForceNetwork, clip: Tensor) -> Iterator[Tensor]:
    state: StreamState | None = None
    for frame in clip:
        seen, state = network.step(frame[None], state)
        yield seen.force_n[0]


def assert_same(actual: Tensor, expected: Tensor) -> None:
    torch.testing.assert_close(actual, expected, rtol=1e-5, atol=1e-5)


@torch.no_grad()
def test_last_step_equals_a_bidirectional_lstm() -> None:
    torch.manual_seed(0)
    blstm = LastStepBlstm(4, 6)
    windows = torch.randn(3, 20, 4)
    expected = as_torch_blstm(blstm)(windows)[0][:, -1]
    torch.testing.assert_close(blstm(windows), expected, rtol=1e-6, atol=1e-7)


@settings(max_examples=25, deadline=None)
@given(
    attention=st.sampled_from(["none", "ssam wap", "ssam gap", "scam wap", "scam gap", "se", "cbam"]),
    backbone=st.sampled_from(sorted(SIZES)),
    earlier=st.integers(0, 2),
    length=st.integers(1, 12),
    seed=st.integers(0, 99),
)
@torch.inference_mode()
def test_streaming_and_clips_equal_the_explicit_window(
    attention: str, backbone: str, earlier: int, length: int, seed: int
) -> None:
    name, *pooling = attention.split()
    size = SIZES[backbone]
    choices = {"attention": name, "backbone": backbone, "size": size, "earlier_frames": earlier}
    if pooling:
        choices["pooling"] = pooling[0]
    network = build(NetworkConfig.model_validate(TINY.model_dump() | choices), seed)
    clip = torch.randn(length, 1, size, size)
    expected = torch.stack([literal(network, history(network, clip, t)) for t in range(length)])
    assert_same(torch.stack(list(stream(network, clip))), expected)
    assert_same(network(clip[None])[0], expected)
    assert_same(network(clip[None], length - 1)[0], expected[-1:])


@torch.inference_mode()
def test_long_stream_does_not_drift() -> None:
    network = build(TINY.model_copy(update={"attention": "scam"}))
    clip = torch.randn(64, 1, 16, 16)[torch.arange(400) % 61]
    for force in stream(network, clip):
        newest = force
    assert_same(newest, literal(network, history(network, clip, len(clip) - 1)))


@pytest.mark.parametrize(
    ("attention", "backbone"), [("ssam", "vgg"), ("scam", "vgg"), ("scam", "resnet18"), ("cbam", "mobile")]
)
@torch.inference_mode()
def test_networks_of_full_width_stream_exactly(attention: str, backbone: str) -> None:
    network = build(NetworkConfig.model_validate({"attention": attention, "backbone": backbone, "size": 64}))
    clip = torch.randn(24, 1, 64, 64)
    *_, newest = stream(network, clip)
    assert_same(newest, literal(network, history(network, clip, 23)))


def test_batches_are_independent() -> None:
    network = build(TINY.model_copy(update={"attention": "scam"}))
    clips = torch.randn(3, 8, 1, 16, 16)
    together = network(clips)
    assert together.shape == (3, 8)
    for clip, forces in zip(clips, together, strict=True):
        assert_same(network(clip[None])[0], forces)


def test_full_size_network_matches_the_paper() -> None:
    network = ForceNetwork(NetworkConfig(attention="ssam"))
    assert network.blstm.forward_lstm.hidden_size == 256
    assert network.dense.out_features == 1024
    assert network.config.window == 20
    assert network.config.context == 20
    assert 2.4e6 < sum(parameter.numel() for parameter in network.parameters()) < 2.8e6


@pytest.mark.parametrize("backbone", SIZES)
@pytest.mark.parametrize("attention", ["ssam", "scam", "se", "cbam"])
def test_every_parameter_has_a_gradient(attention: str, backbone: str) -> None:
    size = SIZES[backbone]
    choices = {"attention": attention, "backbone": backbone, "size": size}
    network = build(NetworkConfig.model_validate(TINY.model_dump() | choices)).train()
    with torch.autocast("cpu", torch.bfloat16):
        forces = network(torch.randn(2, 3, 1, size, size))
    forces.square().mean().backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name


def test_attention_without_earlier_frames_keeps_no_maps() -> None:
    frame = torch.zeros(1, 1, 16, 16)
    for attention in ("none", "se", "cbam"):
        network = build(TINY.model_copy(update={"attention": attention, "earlier_frames": 2}))
        assert network.config.context == 4
        assert network.step(frame, None)[1].maps.shape[1] == 0
    network = build(TINY.model_copy(update={"attention": "ssam", "earlier_frames": 2}))
    assert network.config.context == 6
    assert network.step(frame, None)[1].maps.shape[1] == 2 * network.backbone.out_channels


@pytest.mark.parametrize(
    ("choices", "message"),
    [
        ({"backbone": "resnet18", "size": 48}, "size 48 .* resnet18; use a multiple of 32"),
        ({"size": 24}, "size 24 .* vgg; use a multiple of 16"),
        (
            {"attention": "se", "pooling": "gap"},
            "needs the attention ssam or scam, not se; leave",
        ),
        ({"attention": "none", "pooling": "gap"}, "ssam or scam, not none"),
        ({"attention": "eca"}, "attention"),
        ({"backbone": "vit"}, "backbone"),
    ],
)
def test_inconsistent_config_is_refused(choices: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        NetworkConfig.model_validate(choices)


def test_cost_is_the_sum_over_layers() -> None:
    channels, side, convolutions, weights = [1, 16, 32, 64, 128, 256], 64, 0, 0
    for inputs, outputs in pairwise(channels):
        pair = 9 * (inputs + outputs) * outputs
        convolutions += side**2 * pair
        weights += pair + 2 * outputs
        side //= 2
    weights += 2 * (16 + 32 + 64 + 128)  # batch normalisation
    blstm = 256 * 4 * (256 + 256)
    backward, dense, out = 256 * 3 * 256, 512 * 1024, 1024
    weights += blstm + 2 * 4 * 256 + backward + 3 * 256 + dense + 1024 + out + 1
    step = convolutions + 256 * 4 * 256 * (1 + 20) + backward + dense + out  # each window moves on by one
    assert cost(NetworkConfig(size=64)) == (weights, step)
    ssam = 2 * 256
    assert cost(NetworkConfig(attention="ssam", size=64)) == (weights + ssam + 1, step + 16 * ssam)
