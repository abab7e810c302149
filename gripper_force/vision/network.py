"""The force network of Shin et al. 2019: backbone, attention, average pooling, BLSTM, two dense layers.

- Every frame passes the backbone once, also while streaming. The state keeps the maps of the last n frames,
  and the LSTM's state in each of the next 20 windows. A frame then takes one matrix product of 20 rows;
  computing a window from its start would take 20 products in sequence. The results are equal.
- Frames before the first count as copies of the first. The paper does not define them; a gripper at rest
  before contact gives such frames.
- The backward LSTM is read at the last step, as in the authors' public code. There it has processed one
  frame only.
"""

from typing import Final, NamedTuple, Self

import torch
import torch.nn.functional as F
from torch import Tensor, nn

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

    There the backward direction has processed only the last frame, from a zero state. Its recurrent weights
    and its forget gate have no effect, so it is one linear layer with three gates.
    """

    def __init__(self, inputs: int, hidden: int) -> None:
        super().__init__()
        self.forward_lstm = nn.LSTM(inputs, hidden, batch_first=True)
        self.backward_linear = nn.Linear(inputs, 3 * hidden)

    def forward(self, windows: Tensor) -> Tensor:
        """Maps windows (N, L, F) to the last step's two hidden states (N, 2*hidden)."""
        forward_hidden = self.forward_lstm(windows)[0][:, -1]  # (N, hidden)
        return torch.cat([forward_hidden, self.backward_output(windows[:, -1])], dim=1)

    def advance(self, newest: Tensor, hidden: Tensor, cell: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Processes the next vector of a stream in all windows that contain it.

        Args:
            newest: The vector, (B, F).
            hidden: Hidden states of the windows in progress, (B, L, hidden): row k has processed k vectors.
            cell: Cell states of the same windows, (B, L, hidden).

        Returns:
            The output of `forward` for the window that ends here, (B, 2*hidden), and the next states.
        """
        input_weight, hidden_weight, input_bias, hidden_bias = self.forward_lstm.all_weights[0]
        from_input = F.linear(newest, input_weight, input_bias + hidden_bias)  # (B, 4*hidden)
        gates = from_input[:, None] + F.linear(hidden, hidden_weight)  # (B, L, 4*hidden)
        next_hidden, next_cell = lstm_cell(gates, cell)  # (B, L, hidden) each
        output = torch.cat([next_hidden[:, -1], self.backward_output(newest)], dim=1)
        # Row 0 has processed nothing and stays zero; every other row moves on by one.
        hidden = torch.cat([hidden[:, :1], next_hidden[:, :-1]], 1)
        return output, hidden, torch.cat([cell[:, :1], next_cell[:, :-1]], 1)

    def backward_output(self, newest: Tensor) -> Tensor:
        """Returns the backward direction's hidden state at the last vector of each window, (N, hidden)."""
        gate_in, candidate, gate_out = self.backward_linear(newest).chunk(3, dim=1)
        cell = torch.sigmoid(gate_in) * torch.tanh(candidate)
        return torch.sigmoid(gate_out) * torch.tanh(cell)


def lstm_cell(gates: Tensor, cell: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the next hidden and cell states, (..., hidden), for the sums before the gates, (..., 4*hidden)."""
    gate_in, forget, candidate, gate_out = gates.chunk(4, dim=-1)
    next_cell = torch.sigmoid(forget) * cell + torch.sigmoid(gate_in) * torch.tanh(candidate)
    return torch.sigmoid(gate_out) * torch.tanh(next_cell), next_cell


class StreamState(NamedTuple):
    """State of a stream between frames.

    Attributes:
        maps: Feature maps of the last n frames, concatenated over channels, oldest first, (B, n*C, H, W).
        hidden: Hidden states of the LSTM, (B, window, hidden); see `LastStepBlstm.advance`.
        cell: Cell states of the LSTM, (B, window, hidden).
    """

    maps: Tensor
    hidden: Tensor
    cell: Tensor


class Output(NamedTuple):
    """Output for one frame of a stream.

    Attributes:
        force_n: Forces, (B,).
        features: Inputs of the last layer, (B, head).
        gates: Attention gates: (B, 1, H, W) of SSAM and CBAM, (B, C, 1, 1) of SCAM and SE, None without
            attention.
    """

    force_n: Tensor
    features: Tensor
    gates: Tensor | None


class ForceNetwork(nn.Module):
    """Estimates the contact force for each frame of a sequence."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.backbone: Backbone = BACKBONES[config.backbone](config.width)
        channels = self.backbone.out_channels
        self.attention = _attention(config, channels)
        self.blstm = LastStepBlstm(channels, config.hidden)
        self.dense = nn.Linear(2 * config.hidden, config.head)
        self.out = nn.Linear(config.head, len(config.outputs))
        self.to_channels_last()

    def to_channels_last(self) -> Self:
        """Puts the channels last in memory, which is faster and gives the same numbers."""
        moved: Self = self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        return moved

    def forward(self, clips: Tensor, start: int = 0) -> Tensor:
        """Estimates the force for the frames of clips, with one pass of the backbone for all windows.

        Args:
            clips: Prepared frames, (B, T, 1, S, S). Frames before the first count as copies of it.
            start: Index of the first frame of each clip to estimate.

        Returns:
            Forces in N, (B, T - start).
        """
        features = self.features(clips, start)  # (B, T - start, head)
        return self.force_n(features.flatten(0, 1)).view(features.shape[:2])

    def features(self, clips: Tensor, start: int = 0) -> Tensor:
        """Returns the inputs of the last layer, (B, T - start, head); arguments are those of `forward`."""
        pooled, _ = self.pooled(clips)
        batch, length = pooled.shape[:2]
        window = self.config.window
        padded = torch.cat([pooled[:, :1].expand(-1, window - 1, -1), pooled], dim=1)
        windows = padded.unfold(1, window, 1)[:, start:].transpose(2, 3)  # (B, T - start, window, C)
        return self._head(windows.flatten(0, 1)).view(batch, length - start, -1)

    def pooled(self, clips: Tensor, earlier_maps: Tensor | None = None) -> tuple[Tensor, Tensor | None]:
        """Computes each frame's map after attention, averaged.

        Args:
            clips: As for `forward`.
            earlier_maps: Maps of the frames before the clips, which the last call returned; None at their beginning.

        Returns:
            The averages, (B, T, C), and the maps of the last frames, (B, n, C, H, W), None without earlier frames.
        """
        batch, length = clips.shape[:2]
        flat = self.backbone(clips.flatten(0, 1))  # (B*T, C, H, W)
        maps = flat.view(batch, length, *flat.shape[1:])
        stack = flat
        if n := self.config.maps_kept:
            if earlier_maps is None:
                earlier_maps = maps[:, :1].expand(-1, n, -1, -1, -1)
            padded = torch.cat([earlier_maps, maps], dim=1)  # (B, n + T, C, H, W)
            earlier_maps = padded[:, length:]
            stack = torch.cat([padded[:, k : k + length] for k in range(n + 1)], dim=2).flatten(0, 1)
        return self._pool(stack, flat)[0].view(batch, length, -1), earlier_maps

    def force_n(self, features: Tensor) -> Tensor:
        """Applies the last layer: features (N, head) to forces in N, (N,)."""
        with torch.autocast(features.device.type, enabled=False):
            force = F.linear(features, self.out.weight[:1], self.out.bias[:1])
        return force.squeeze(1) * self.config.label_scale_n

    def outputs(self, features: Tensor) -> Tensor:
        """Applies the last layer: features (N, head) to `NetworkConfig.outputs`, (N, outputs), not scaled."""
        with torch.autocast(features.device.type, enabled=False):
            out: Tensor = self.out(features)
        return out

    def step(self, frame: Tensor, state: StreamState | None) -> tuple[Output, StreamState]:
        """Estimates the force for the next frame of a stream. Equals `forward` on the whole stream.

        Args:
            frame: Prepared frame, (B, 1, S, S).
            state: State that the last step returned; None for the first frame.

        Returns:
            The estimate, and the state for the next step.
        """
        if state is None:
            state = self.zero_state(len(frame))
            for _ in range(self.config.context):
                _, state = self.step(frame, state)
        newest = self.backbone(frame)  # (B, C, H, W)
        stack, next_maps = newest, state.maps
        if n := self.config.maps_kept:
            stack = torch.cat([state.maps, newest], dim=1)  # (B, (n+1)*C, H, W)
            # Slicing takes engines as long as a layer, so it is avoided for n = 1.
            next_maps = newest if n == 1 else stack[:, newest.shape[1] :]
        pooled, gates = self._pool(stack, newest)
        output, hidden, cell = self.blstm.advance(pooled, state.hidden, state.cell)
        features = torch.tanh(self.dense(output))
        return Output(self.force_n(features), features, gates), StreamState(next_maps, hidden, cell)

    def zero_state(self, batch: int = 1) -> StreamState:
        """Returns a state of zeros. It affects the outputs of `NetworkConfig.context` steps."""
        config = self.config
        side = config.size // STRIDES[config.backbone]
        like = self.out.weight
        maps = like.new_zeros(batch, config.maps_kept * self.backbone.out_channels, side, side)
        hidden = like.new_zeros(batch, config.window, config.hidden)
        return StreamState(maps, hidden, torch.zeros_like(hidden))

    def _pool(self, stack: Tensor, newest: Tensor) -> tuple[Tensor, Tensor | None]:
        """Applies attention to the newest maps (N, C, H, W) with the stack (N, (n+1)*C, H, W), and averages.

        Returns:
            The averages, (N, C), and the gates.
        """
        gates = None
        if self.attention is not None:
            newest, gates = self.attention(stack, newest)
        return newest.mean((2, 3)), gates

    def _head(self, windows: Tensor) -> Tensor:
        """Maps windows of pooled vectors (N, window, C) to features, (N, head)."""
        # Mixed precision only speeds up the backbone; here it would only cost precision.
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
