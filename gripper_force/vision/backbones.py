"""Convolutional backbones: one frame in, one feature map out."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

VGG_CHANNELS = (16, 32, 64, 128, 256)
VGG_STRIDE = 16


class Vgg(nn.Module):
    """The VGG-like network of Shin et al. 2019, table 2: five pairs of 3x3 convolutions.

    A 2x2 max pooling follows each of the first four pairs, and batch normalisation follows each pooling; the
    latter is in the authors' public code, not in the paper.
    """

    def __init__(self, width: float) -> None:
        super().__init__()
        channels = [max(1, round(width * c)) for c in VGG_CHANNELS]
        inputs = [1, *channels[:-1]]
        self.out_channels = channels[-1]
        self.first = nn.ModuleList(
            nn.Conv2d(i, c, 3, padding=1) for i, c in zip(inputs, channels, strict=True)
        )
        self.second = nn.ModuleList(nn.Conv2d(c, c, 3, padding=1) for c in channels)
        self.norm = nn.ModuleList(nn.BatchNorm2d(c) for c in channels[:-1])

    def forward(self, frames: Tensor) -> Tensor:
        """Maps frames (N, 1, S, S) to feature maps (N, C, S/16, S/16)."""
        x = frames
        for i, (first, second) in enumerate(zip(self.first, self.second, strict=True)):
            x = second(F.relu(first(x)))
            if i < len(self.norm):
                # Pooling before the rectifier gives the same numbers for a quarter of its work.
                x = self.norm[i](F.relu(F.max_pool2d(x, 2)))  # (N, C_i, S / 2^(i+1), S / 2^(i+1))
        return torch.relu(x)
