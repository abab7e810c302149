"""The force network of Shin et al. 2019: backbone, attention, average pooling, BLSTM, two dense layers.

Three facts shape this module. Every frame passes the backbone once, also while streaming: only the maps of
the last n frames and the pooled vectors of the last 20 are kept, and the result equals a whole window's.
Frames before the first count as copies of the first; the paper leaves that open, and a still hand before
contact looks just so. And the backward LSTM is read at the last step, as in the authors' public code, where
it has seen one frame only.
"""

from dataclasses import dataclass
from typing import Annotated, Final, Literal, Self

import torch
from pydantic import Field, model_validator
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from gripper_force.schema import Positive, Section
from gripper_force.vision.attention import (
    Cbam,
    ChannelAttention,
    Pooling,
    SpatialAttention,
    SqueezeExcitation,
)
from gripper_force.vision.backbones import Backbone, Mobile, ResNet18, Vgg

BACKBONES: Final[dict[str, type[Vgg | ResNet18 | Mobile]]] = {
    "vgg": Vgg,
    "resnet18": ResNet18,
    "mobile": Mobile,
}

Attention = Literal["none", "ssam", "scam", "se", "cbam"]
BackboneName = Literal["vgg", "resnet18", "mobile"]

Count = Annotated[int, Field(ge=1, le=100_000)]


class NetworkConfig(Section):
    """The shape of one network.

    Attributes:
        attention: SSAM, SCAM, none (the paper's baseline), or SE or CBAM for comparison.
        earlier_frames: n, the frames before the newest that SSAM and SCAM see; the others see none.
        pooling: How SSAM and SCAM squeeze: weighted or global average pooling.
        reduction: r of the perceptron; the paper gives none, this is that of SE and CBAM.
        backbone: The paper's VGG-like network, its ResNet with 18 layers, or a small one for slow computers.
        size: Side of the input in pixels.
        width: Multiplier of the backbone's channels.
        window: Frames the BLSTM sees.
        hidden: Units of each direction of the BLSTM.
        head: Units of the dense layer.
        label_scale_n: The last layer's output 1 means this force.
    """

    attention: Attention = "none"
    earlier_frames: Annotated[int, Field(ge=0, le=20)] = 1
    pooling: Pooling = "wap"
    reduction: Count = 16
    backbone: BackboneName = "vgg"
    size: Annotated[int, Field(ge=16, le=1024)] = 128
    width: Annotated[float, Field(gt=0, le=100, allow_inf_nan=False)] = 1.0
    window: Annotated[int, Field(ge=1, le=1000)] = 20
    hidden: Count = 256
    head: Count = 1024
    label_scale_n: Positive = 20.0

    @model_validator(mode="after")
    def _fits(self) -> Self:
        stride = BACKBONES[self.backbone].stride
        if self.size % stride:
            raise ValueError(
                f"size {self.size} does not suit the backbone {self.backbone}: take a multiple of {stride}"
            )
        if self.pooling == "gap" and not self.sequential:
            raise ValueError(
                f"pooling gap is a choice of ssam and scam: with the attention {self.attention} leave it out"
            )
        return self

    @property
    def sequential(self) -> bool:
        """Whether attention may see earlier frames."""
        return self.attention in ("ssam", "scam")


class LastStepBlstm(nn.Module):
    """A bidirectional LSTM read at the last step.

    There the backward direction has seen the last frame only, from a zero state: its recurrent weights and
    its forget gate have no effect, so it is one linear layer with three gates.
    """

    def __init__(self, inputs: int, hidden: int) -> None:
        super().__init__()
        self.onward = nn.LSTM(inputs, hidden, batch_first=True)
        self.backward_gates = nn.Linear(inputs, 3 * hidden)

    def forward(self, windows: Tensor) -> Tensor:
        """Maps windows (N, L, F) to the last step's two hidden states (N, 2*hidden)."""
        onward = self.onward(windows)[0][:, -1]  # (N, hidden)
        gate_in, candidate, gate_out = self.backward_gates(windows[:, -1]).chunk(3, dim=1)
        cell = torch.sigmoid(gate_in) * torch.tanh(candidate)
        return torch.cat([onward, torch.sigmoid(gate_out) * torch.tanh(cell)], dim=1)


@dataclass(frozen=True, slots=True)
class StreamState:
    """What a stream remembers between frames.

    Attributes:
        maps: Feature maps of the last n frames, (B, n, C, H, W).
        pooled: Pooled vectors of the last frames of the window, (B, window, C).
        features: What the last layer makes the newest force from, (B, head).
        gates: Attention of the newest frame: of positions (B, 1, H, W) from SSAM and CBAM, of channels
            (B, C, 1, 1) from SCAM and SE, None without attention.
    """

    maps: Tensor
    pooled: Tensor
    features: Tensor
    gates: Tensor | None


class ForceNetwork(nn.Module):
    """Frames in, newtons out."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.backbone: Backbone = BACKBONES[config.backbone](config.width)
        self.earlier_frames = config.earlier_frames if config.sequential else 0
        channels = self.backbone.out_channels
        self.attention = _attention(config, channels, self.backbone.stride)
        self.blstm = LastStepBlstm(channels, config.hidden)
        self.dense = nn.Linear(2 * config.hidden, config.head)
        self.out = nn.Linear(config.head, 1)
        self.in_fast_layout()

    def in_fast_layout(self) -> Self:
        """Puts the channels last in memory: faster, the same numbers."""
        moved: Self = self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        return moved

    @property
    def context(self) -> int:
        """Earlier frames that one estimate depends on."""
        return self.config.window - 1 + self.earlier_frames

    def forward(self, clips: Tensor, start: int = 0) -> Tensor:
        """Estimates the force for the frames of whole clips; one backbone pass serves all windows.

        Args:
            clips: Prepared frames, (B, T, 1, S, S). Frames before the first count as copies of it.
            start: First position of each clip to give an estimate for.

        Returns:
            Forces in N, (B, T - start).
        """
        features = self.features(clips, start)  # (B, T - start, head)
        return self.force_n(features.flatten(0, 1)).view(features.shape[:2])

    def features(self, clips: Tensor, start: int = 0) -> Tensor:
        """What the last layer makes each frame's force from, (B, T - start, head); see `forward`."""
        batch, length = clips.shape[:2]
        flat = self.backbone(clips.flatten(0, 1))  # (B*T, C, H, W)
        maps = flat.view(batch, length, *flat.shape[1:])
        earlier = maps[:, :1].expand(-1, self.earlier_frames, -1, -1, -1)
        pooled, _ = self._attend(torch.cat([earlier, maps], dim=1))  # (B, T, C)
        window = self.config.window
        padded = torch.cat([pooled[:, :1].expand(-1, window - 1, -1), pooled], dim=1)
        windows = padded.unfold(1, window, 1)[:, start:].transpose(2, 3)  # (B, T - start, window, C)
        return self._read(windows.flatten(0, 1)).view(batch, length - start, -1)

    def force_n(self, features: Tensor) -> Tensor:
        """The last layer: features (N, head) to forces in N, (N,)."""
        with torch.autocast(features.device.type, enabled=False):
            force: Tensor = self.out(features).squeeze(1) * self.config.label_scale_n
        return force

    def step(self, frame: Tensor, state: StreamState | None) -> tuple[Tensor, StreamState]:
        """Estimates the force for the next frame of a stream, exactly as `forward` would.

        Args:
            frame: Prepared frame, (B, 1, S, S).
            state: What the last step returned; None for the first frame.

        Returns:
            Forces in N, (B,), and the state for the next step.
        """
        newest = self.backbone(frame)[:, None]  # (B, 1, C, H, W)
        earlier = newest.expand(-1, self.earlier_frames, -1, -1, -1) if state is None else state.maps
        maps = torch.cat([earlier, newest], dim=1)  # (B, n + 1, C, H, W)
        pooled, gates = self._attend(maps)  # (B, 1, C)
        window = pooled.expand(-1, self.config.window, -1) if state is None else state.pooled
        window = torch.cat([window[:, 1:], pooled], dim=1)
        features = self._read(window)
        return self.force_n(features), StreamState(maps[:, 1:], window, features, gates)

    def _attend(self, maps: Tensor) -> tuple[Tensor, Tensor | None]:
        """Excites and pools the maps (B, n + T, C, H, W) that have n before them: (B, T, C), and gates."""
        n = self.earlier_frames
        length = maps.shape[1] - n
        newest = maps[:, n:].flatten(0, 1)  # (B*T, C, H, W)
        gates = None
        if self.attention is not None:
            shifted = [maps[:, k : k + length] for k in range(n + 1)]
            newest, gates = self.attention(torch.cat(shifted, dim=2).flatten(0, 1), newest)
        return newest.mean((2, 3)).view(maps.shape[0], length, -1), gates

    def _read(self, windows: Tensor) -> Tensor:
        """Maps windows of pooled vectors (N, window, C) to features, (N, head)."""
        # Mixed precision is for the backbone; here it would save nothing and cost digits of the label.
        with torch.autocast(windows.device.type, enabled=False):
            return torch.tanh(self.dense(self.blstm(windows.to(self.dense.weight.dtype))))


def _attention(config: NetworkConfig, channels: int, stride: int) -> nn.Module | None:
    match config.attention:
        case "ssam":
            return SpatialAttention(channels, config.earlier_frames, config.pooling)
        case "scam":
            positions = (config.size // stride) ** 2
            return ChannelAttention(
                channels, config.earlier_frames, positions, config.reduction, config.pooling
            )
        case "se":
            return SqueezeExcitation(channels, config.reduction)
        case "cbam":
            return Cbam(channels, config.reduction)
        case "none":
            return None


def cost(config: NetworkConfig) -> tuple[int, int]:
    """What a network takes.

    Returns:
        Its parameters, and the multiply-adds of one `ForceNetwork.step` in convolutions and matrix products.
        SCAM's weighted pooling, a few thousand, is not among them.
    """
    network = ForceNetwork(config).eval()
    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        network.step(torch.zeros(1, 1, config.size, config.size), None)
    # On a CPU the counter does not see into an LSTM.
    recurrent = config.window * sum(w.numel() for w in network.blstm.onward.parameters() if w.dim() > 1)
    parameters = sum(parameter.numel() for parameter in network.parameters())
    return parameters, recurrent + counter.get_total_flops() // 2
