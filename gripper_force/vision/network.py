"""The force network of Shin et al. 2019: backbone, attention, average pooling, BLSTM, two dense layers.

Three facts shape this module. Every frame passes the backbone once, also while streaming: the maps of the
last n frames are kept, and of each of the next 20 windows how far the LSTM has come in it. So each frame
takes one product of 20 rows, where a window from its beginning takes 20 products one after the other; the
result is the same. Frames before the first count as copies of the first; the paper leaves that open, and a
still hand before contact looks just so. And the backward LSTM is read at the last step, as in the authors'
public code, where it has seen one frame only.
"""

from typing import Final, NamedTuple, Self

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from gripper_force.vision.attention import Cbam, ChannelAttention, SpatialAttention, SqueezeExcitation
from gripper_force.vision.backbones import Backbone, Mobile, ResNet18, Vgg
from gripper_force.vision.header import STRIDES, NetworkConfig

BACKBONES: Final[dict[str, type[Vgg | ResNet18 | Mobile]]] = {
    "vgg": Vgg,
    "resnet18": ResNet18,
    "mobile": Mobile,
}


class LastStepBlstm(nn.Module):
    """A bidirectional LSTM read at the last step.

    There the backward direction has seen the last frame only, from a zero state: its recurrent weights and
    its forget gate have no effect, so it is one linear layer with three gates.
    """

    def __init__(self, inputs: int, hidden: int) -> None:
        super().__init__()
        self.forward_lstm = nn.LSTM(inputs, hidden, batch_first=True)
        self.backward_linear = nn.Linear(inputs, 3 * hidden)

    def forward(self, windows: Tensor) -> Tensor:
        """Maps windows (N, L, F) to the last step's two hidden states (N, 2*hidden)."""
        forward_lstm = self.forward_lstm(windows)[0][:, -1]  # (N, hidden)
        return torch.cat([forward_lstm, self._backward(windows[:, -1])], dim=1)

    def advance(self, newest: Tensor, hidden: Tensor, cell: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Takes the next vector of a stream into all windows that it lies in.

        Args:
            newest: The vector, (B, F).
            hidden: Hidden states of the windows that have begun, (B, L, hidden): row k has seen k vectors.
            cell: Their cell states, (B, L, hidden).

        Returns:
            What `forward` gives for the window that ends here, (B, 2*hidden), and the next states.
        """
        into_weight, on_weight, into_bias, on_bias = self.forward_lstm.all_weights[0]
        into = F.linear(newest, into_weight, into_bias + on_bias)  # (B, 4*hidden)
        gates = into[:, None] + F.linear(hidden, on_weight)  # (B, L, 4*hidden)
        gate_in, forget, candidate, gate_out = gates.chunk(4, dim=2)
        after = torch.sigmoid(forget) * cell + torch.sigmoid(gate_in) * torch.tanh(candidate)
        shown = torch.sigmoid(gate_out) * torch.tanh(after)  # (B, L, hidden)
        read = torch.cat([shown[:, -1], self._backward(newest)], dim=1)
        # Row 0 has seen nothing: it stays as it is, zero, and each other row moves on by one.
        return read, torch.cat([hidden[:, :1], shown[:, :-1]], 1), torch.cat([cell[:, :1], after[:, :-1]], 1)

    def _backward(self, newest: Tensor) -> Tensor:
        gate_in, candidate, gate_out = self.backward_linear(newest).chunk(3, dim=1)
        cell = torch.sigmoid(gate_in) * torch.tanh(candidate)
        return torch.sigmoid(gate_out) * torch.tanh(cell)


class StreamState(NamedTuple):
    """What a stream remembers between frames.

    Attributes:
        maps: Feature maps of the last n frames side by side, oldest first, (B, n*C, H, W).
        hidden: LSTM of the windows that have begun, (B, window, hidden); see `LastStepBlstm.advance`.
        cell: Likewise.
    """

    maps: Tensor
    hidden: Tensor
    cell: Tensor


class Output(NamedTuple):
    """What a stream gives for a frame.

    Attributes:
        force_n: Forces, (B,).
        features: What the last layer makes them from, (B, head).
        gates: Attention: of positions (B, 1, H, W) from SSAM and CBAM, of channels (B, C, 1, 1) from SCAM and
            SE, None without attention.
    """

    force_n: Tensor
    features: Tensor
    gates: Tensor | None


class ForceNetwork(nn.Module):
    """Frames in, newtons out."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.backbone: Backbone = BACKBONES[config.backbone](config.width)
        channels = self.backbone.out_channels
        self.attention = _attention(config, channels)
        self.blstm = LastStepBlstm(channels, config.hidden)
        self.dense = nn.Linear(2 * config.hidden, config.head)
        self.out = nn.Linear(config.head, 1)
        self.in_fast_layout()

    def in_fast_layout(self) -> Self:
        """Puts the channels last in memory: faster, the same numbers."""
        moved: Self = self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        return moved

    def in_plain_layout(self) -> Self:
        """Puts the channels first, as PyTorch does by itself: to compare with."""
        moved: Self = self.to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]
        return moved

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
        stack = flat
        if n := self.config.maps_kept:
            begun = torch.cat([maps[:, :1].expand(-1, n, -1, -1, -1), maps], dim=1)  # (B, n + T, C, H, W)
            stack = torch.cat([begun[:, k : k + length] for k in range(n + 1)], dim=2).flatten(0, 1)
        pooled = self._pool(stack, flat)[0].view(batch, length, -1)
        window = self.config.window
        padded = torch.cat([pooled[:, :1].expand(-1, window - 1, -1), pooled], dim=1)
        windows = padded.unfold(1, window, 1)[:, start:].transpose(2, 3)  # (B, T - start, window, C)
        return self._read(windows.flatten(0, 1)).view(batch, length - start, -1)

    def force_n(self, features: Tensor) -> Tensor:
        """The last layer: features (N, head) to forces in N, (N,)."""
        with torch.autocast(features.device.type, enabled=False):
            force: Tensor = self.out(features).squeeze(1) * self.config.label_scale_n
        return force

    def step(self, frame: Tensor, state: StreamState | None) -> tuple[Output, StreamState]:
        """Estimates the force for the next frame of a stream, exactly as `forward` would.

        Args:
            frame: Prepared frame, (B, 1, S, S).
            state: What the last step returned; None for the first frame.

        Returns:
            The estimate, and the state for the next step.
        """
        if state is None:
            state = self.zero_state(len(frame))
            for _ in range(self.config.context):
                _, state = self.step(frame, state)
        newest = self.backbone(frame)  # (B, C, H, W)
        stack, kept = newest, state.maps
        if n := self.config.maps_kept:
            stack = torch.cat([state.maps, newest], dim=1)  # (B, (n+1)*C, H, W)
            # A map is not cut out of the stack without need: that takes engines as long as a layer.
            kept = newest if n == 1 else stack[:, newest.shape[1] :]
        pooled, gates = self._pool(stack, newest)
        read, hidden, cell = self.blstm.advance(pooled, state.hidden, state.cell)
        features = torch.tanh(self.dense(read))
        return Output(self.force_n(features), features, gates), StreamState(kept, hidden, cell)

    def zero_state(self, batch: int = 1) -> StreamState:
        """A state that remembers nothing: what a stream forgets after as many frames as `context` says."""
        config = self.config
        side = config.size // STRIDES[config.backbone]
        like = self.out.weight
        maps = like.new_zeros(batch, config.maps_kept * self.backbone.out_channels, side, side)
        hidden = like.new_zeros(batch, config.window, config.hidden)
        return StreamState(maps, hidden, torch.zeros_like(hidden))

    def _pool(self, stack: Tensor, newest: Tensor) -> tuple[Tensor, Tensor | None]:
        """Excites the maps (N, C, H, W), seen with those before (N, (n+1)*C, H, W), and averages: (N, C)."""
        gates = None
        if self.attention is not None:
            newest, gates = self.attention(stack, newest)
        return newest.mean((2, 3)), gates

    def _read(self, windows: Tensor) -> Tensor:
        """Maps windows of pooled vectors (N, window, C) to features, (N, head)."""
        # Mixed precision is for the backbone; here it would save nothing and cost digits of the label.
        with torch.autocast(windows.device.type, enabled=False):
            return torch.tanh(self.dense(self.blstm(windows.to(self.dense.weight.dtype))))


def _attention(config: NetworkConfig, channels: int) -> nn.Module | None:
    match config.attention:
        case "ssam":
            return SpatialAttention(channels, config.earlier_frames, config.pooling)
        case "scam":
            positions = (config.size // STRIDES[config.backbone]) ** 2
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
        network.step(torch.zeros(1, 1, config.size, config.size), network.zero_state())
    parameters = sum(parameter.numel() for parameter in network.parameters())
    return parameters, counter.get_total_flops() // 2
