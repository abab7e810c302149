"""Sequential image-based attention of Shin et al. 2019, equations 1 to 6, and SE and CBAM for comparison.

SSAM and SCAM take the feature maps of the newest frame and of the ``n`` frames before it, concatenated over
channels, oldest first (the paper's X_tn), and excite the newest: X' = M(X_tn) * X + X.
The paper counts ``n`` in two ways; here, as in its table of frame counts, n = 1 means the maps of t-1 and t.
For n = 0 that table repeats the numbers of the baseline without attention; here n = 0 follows the equations:
attention to the newest map alone (the paper's "traditional" attention in table 3). SE and CBAM use the newest
map only. All modules take the stack and the newest map.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gripper_force.vision.header import Pooling


class SpatialAttention(nn.Module):
    """SSAM: one gate per position (equations 1 to 3)."""

    def __init__(self, channels: int, earlier_frames: int, pooling: Pooling) -> None:
        super().__init__()
        self.pool: nn.Conv2d | None = None
        if pooling == "wap":
            # Weighted average pooling (WAP) over channels: Y_s + b is one 1x1 convolution.
            self.pool = nn.Conv2d((earlier_frames + 1) * channels, 1, 1)
        else:
            # The paper gives no equation for this case. With equal weights, b is the only parameter.
            self.bias = nn.Parameter(torch.zeros(1))

    def forward(self, stack: Tensor, newest: Tensor) -> tuple[Tensor, Tensor]:
        """Excites the newest map.

        Args:
            stack: Maps of the last n+1 frames, (N, (n+1)*C, H, W).
            newest: Map of the newest frame, (N, C, H, W).

        Returns:
            The excited map X', (N, C, H, W), and the gates M_s in 0..1, (N, 1, H, W).
        """
        squeezed = stack.mean(1, keepdim=True) + self.bias if self.pool is None else self.pool(stack)
        gates = torch.sigmoid(squeezed)
        return gates * newest + newest, gates


class ChannelAttention(nn.Module):
    """SCAM: one gate per channel (equations 4 to 6)."""

    def __init__(
        self, channels: int, earlier_frames: int, positions: int, reduction: int, pooling: Pooling
    ) -> None:
        super().__init__()
        stacked = (earlier_frames + 1) * channels
        self.pool: nn.Parameter | None = None
        if pooling == "wap":
            # WAP over positions, with weights shared by all channels; initialised as the plain average.
            self.pool = nn.Parameter(torch.full((positions,), 1 / positions))
        self.squeeze = nn.Linear(stacked, max(1, stacked // reduction))
        # The paper's M_c has nC gates for the C channels of X_t. Only gates for X_t's own channels can be
        # multiplied with it, so F_1 maps to C.
        self.excite = nn.Linear(max(1, stacked // reduction), channels)

    def forward(self, stack: Tensor, newest: Tensor) -> tuple[Tensor, Tensor]:
        """Excites the newest map.

        Args:
            stack: Maps of the last n+1 frames, (N, (n+1)*C, H, W).
            newest: Map of the newest frame, (N, C, H, W).

        Returns:
            The excited map X', (N, C, H, W), and the gates M_c in 0..1, (N, C, 1, 1).
        """
        pooled = stack.mean((2, 3)) if self.pool is None else stack.flatten(2) @ self.pool  # (N, (n+1)*C)
        # The ReLU between F_0 and F_1 is that of squeeze-and-excitation, which the paper extends.
        gates = torch.sigmoid(self.excite(F.relu(self.squeeze(pooled))))[:, :, None, None]
        return gates * newest + newest, gates


class SqueezeExcitation(nn.Module):
    """SE of Hu et al. 2018 (https://arxiv.org/abs/1709.01507, equations 2 to 4), without biases as there."""

    def __init__(self, channels: int, reduction: int) -> None:
        super().__init__()
        self.perceptron = _perceptron(channels, reduction)

    def forward(self, _stack: Tensor, newest: Tensor) -> tuple[Tensor, Tensor]:
        """Scales the channels of the newest map, (N, C, H, W), and returns it and the gates (N, C, 1, 1)."""
        gates = torch.sigmoid(self.perceptron(newest.mean((2, 3))))[:, :, None, None]
        return gates * newest, gates


class Cbam(nn.Module):
    """CBAM of Woo et al. 2018 (https://arxiv.org/abs/1807.06521, equations 1 to 3).

    Channel attention, then spatial attention. The authors' public code adds a batch normalisation to the 7x7
    convolution; this follows the paper.
    """

    def __init__(self, channels: int, reduction: int) -> None:
        super().__init__()
        self.perceptron = _perceptron(channels, reduction)
        self.convolution = nn.Conv2d(2, 1, 7, padding=3, bias=False)

    def forward(self, _stack: Tensor, newest: Tensor) -> tuple[Tensor, Tensor]:
        """Scales the newest map, (N, C, H, W), and returns it and the gates of positions, (N, 1, H, W)."""
        squeezed = self.perceptron(newest.mean((2, 3))) + self.perceptron(newest.amax((2, 3)))  # (N, C)
        maps = torch.sigmoid(squeezed)[:, :, None, None] * newest
        over_channels = torch.cat([maps.mean(1, keepdim=True), maps.amax(1, keepdim=True)], dim=1)
        gates = torch.sigmoid(self.convolution(over_channels))
        return gates * maps, gates


def _perceptron(channels: int, reduction: int) -> nn.Sequential:
    inner = max(1, channels // reduction)
    return nn.Sequential(
        nn.Linear(channels, inner, bias=False), nn.ReLU(), nn.Linear(inner, channels, bias=False)
    )
