"""Sequential image-based attention of Shin et al. 2019, equations 1 to 6, with weighted average pooling.

Both modules take the feature maps of the newest frame and of the ``n`` frames before it, concatenated over
channels, oldest first (the paper's X_tn), and excite the newest: X' = M(X_tn) * X + X.
The paper counts ``n`` in two ways; as in its table of frame counts, n = 1 means the maps of t-1 and t.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class SpatialAttention(nn.Module):
    """SSAM: one gate for each position (equations 1 to 3)."""

    def __init__(self, channels: int, earlier_frames: int) -> None:
        super().__init__()
        # Weighted average pooling (WAP) over channels: Y_s + b is one 1x1 convolution.
        self.pool = nn.Conv2d((earlier_frames + 1) * channels, 1, 1)

    def forward(self, stack: Tensor, newest: Tensor) -> tuple[Tensor, Tensor]:
        """Excites the newest map.

        Args:
            stack: Maps of the last n+1 frames, (N, (n+1)*C, H, W).
            newest: Map of the newest frame, (N, C, H, W).

        Returns:
            The excited map X', (N, C, H, W), and the gates M_s in 0..1, (N, 1, H, W).
        """
        gates = torch.sigmoid(self.pool(stack))
        return gates * newest + newest, gates


class ChannelAttention(nn.Module):
    """SCAM: one gate for each channel (equations 4 to 6)."""

    def __init__(self, channels: int, earlier_frames: int, positions: int, reduction: int) -> None:
        super().__init__()
        stacked = (earlier_frames + 1) * channels
        # WAP over positions, with weights that all channels share; it starts as the plain average.
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
        pooled = stack.flatten(2) @ self.pool  # (N, (n+1)*C)
        # The rectifier between F_0 and F_1 follows squeeze-and-excitation, which the paper builds on.
        gates = torch.sigmoid(self.excite(F.relu(self.squeeze(pooled))))[:, :, None, None]
        return gates * newest + newest, gates
