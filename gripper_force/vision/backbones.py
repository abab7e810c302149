"""Convolutional backbones: one gray frame in, feature maps out."""

from itertools import pairwise

import torch.nn.functional as F
from torch import Tensor, nn

VGG_CHANNELS = (16, 32, 64, 128, 256)
"""Channels of the five pairs of convolutions, table 2 of Shin et al. 2019."""


class Backbone(nn.Module):
    """Maps frames (N, 1, S, S) to non-negative feature maps (N, out_channels, S/s, S/s), s from `STRIDES`."""

    out_channels: int


class Vgg(Backbone):
    """The VGG-like network of Shin et al. 2019, table 2: five pairs of 3x3 convolutions.

    A 2x2 max pooling follows each of the first four pairs, and batch normalisation follows each pooling. The
    batch normalisation is in the authors' public code, not in the paper.
    """

    def __init__(self, width: float) -> None:
        super().__init__()
        channels = [_scaled(c, width) for c in VGG_CHANNELS]
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
            x = second(F.relu(first(x), inplace=True))
            if i < len(self.norm):
                # Pooling before the ReLU gives the same numbers with a quarter of its operations.
                x = self.norm[i](
                    F.relu(F.max_pool2d(x, 2), inplace=True)
                )  # (N, C_i, S / 2^(i+1), S / 2^(i+1))
        return F.relu(x, inplace=True)


class ResNet18(Backbone):
    """The 18-layer network of He et al. 2016 (https://arxiv.org/abs/1512.03385, table 1) without its head.

    Shin et al. name it without sizes (table 6); only the gray input differs from the original. Their public
    code holds an unused fragment that normalises before the convolutions instead.
    """

    def __init__(self, width: float) -> None:
        super().__init__()
        channels = [_scaled(c, width) for c in (64, 128, 256, 512)]
        self.out_channels = channels[-1]
        self.stem = _convolution(1, channels[0], 7, stride=2)
        blocks = [_Residual(channels[0], channels[0], 1), _Residual(channels[0], channels[0], 1)]
        for inputs, outputs in pairwise(channels):
            blocks += [_Residual(inputs, outputs, 2), _Residual(outputs, outputs, 1)]
        self.blocks = nn.Sequential(*blocks)

    def forward(self, frames: Tensor) -> Tensor:
        """Maps frames (N, 1, S, S) to feature maps (N, C, S/32, S/32)."""
        # Pooling before the ReLU, as in `Vgg`.
        x = F.relu(F.max_pool2d(self.stem(frames), 3, stride=2, padding=1))  # (N, C_0, S/4, S/4)
        maps: Tensor = self.blocks(x)
        return maps


class Mobile(Backbone):
    """A small network of inverted residuals as in MobileNetV2 (Sandler et al. 2018).

    For a frame of 64 pixels on a CPU, the original's 17 blocks take longer than `Vgg`, because calls take
    more time than arithmetic. Six blocks at the stride of `Vgg` take about half of its time.
    """

    def __init__(self, width: float) -> None:
        super().__init__()
        stem, *channels, self.out_channels = (_scaled(c, width) for c in (16, 24, 48, 96, 256))
        self.stem = _convolution(1, stem, 3, stride=2)
        blocks = []
        for inputs, outputs in pairwise([stem, *channels]):
            blocks += [_InvertedResidual(inputs, outputs, 2), _InvertedResidual(outputs, outputs, 1)]
        self.blocks = nn.Sequential(*blocks)
        self.last = _convolution(channels[-1], self.out_channels, 1)

    def forward(self, frames: Tensor) -> Tensor:
        """Maps frames (N, 1, S, S) to feature maps (N, C, S/16, S/16)."""
        return F.relu6(self.last(self.blocks(F.relu6(self.stem(frames)))))


class _Residual(nn.Module):
    """Two 3x3 convolutions with a shortcut."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.first = _convolution(inputs, outputs, 3, stride)
        self.second = _convolution(outputs, outputs, 3)
        self.shortcut = _convolution(inputs, outputs, 1, stride) if stride > 1 else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(self.second(F.relu(self.first(x))) + self.shortcut(x))


class _InvertedResidual(nn.Module):
    """Inverted residual: 1x1 expansion, 3x3 depthwise convolution, 1x1 projection without ReLU."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        inner = 4 * inputs
        self.widen = _convolution(inputs, inner, 1)
        self.filter = _convolution(inner, inner, 3, stride, groups=inner)
        self.narrow = _convolution(inner, outputs, 1)
        self.shortcut = stride == 1

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.narrow(F.relu6(self.filter(F.relu6(self.widen(x)))))
        return x + y if self.shortcut else y


def _convolution(inputs: int, outputs: int, kernel: int, stride: int = 1, groups: int = 1) -> nn.Sequential:
    convolution = nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, groups=groups, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(outputs))


def _scaled(channels: int, width: float) -> int:
    return max(1, round(width * channels))
