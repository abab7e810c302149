"""Gaussian process on single frames, for a few recordings: a member of a checkpoint, as a network is.

Its features are principal components of the pooled frame, learned without labels. The force is the mean of a
Gaussian process with a Matern kernel plus a linear one (C. E. Rasmussen and C. K. I. Williams, "Gaussian Processes
for Machine Learning", MIT Press 2006, equations 2.25 and 4.17, https://gaussianprocess.org/gpml).
"""

from typing import Final

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gripper_force.vision.header import GaussianProcessConfig
from gripper_force.vision.network import Output

FAINT: Final = 0.04
"""Changes of a pooled frame up to this size count linearly, larger ones logarithmically."""


class GaussianProcess(nn.Module):
    """Estimates the contact force for each frame alone.

    Attributes:
        centre: Mean of the pooled frames, (grid²,).
        axes: Principal axes, in units of the first component, (grid², head).
        points: Features of the training frames that are kept, (points, head).
        weights: Weights of the kernel at these, (points,).
        slope: Weights of the linear kernel, (head,).
    """

    centre: Tensor
    axes: Tensor
    points: Tensor
    weights: Tensor
    slope: Tensor

    def __init__(self, config: GaussianProcessConfig) -> None:
        super().__init__()
        self.config = config
        pixels, head, points = config.grid**2, config.head, config.points
        shapes = {"centre": (pixels,), "axes": (pixels, head), "points": (points, head)}
        for name, shape in {**shapes, "weights": (points,), "slope": (head,)}.items():
            self.register_buffer(name, torch.zeros(shape))

    def features(self, clips: Tensor, start: int = 0) -> Tensor:
        """Returns the features of clips (B, T, 1, S, S) from frame ``start`` on, (B, T - start, head)."""
        frames = clips[:, start:]
        return self._features(frames.flatten(0, 1)).view(*frames.shape[:2], -1)

    def force_n(self, features: Tensor) -> Tensor:
        """Maps features (N, head) to forces in N, (N,)."""
        kernel = matern(features, self.points, self.config.length)
        force: Tensor = kernel @ self.weights + features @ self.slope
        return force

    def step(self, frame: Tensor) -> Output:
        """Estimates the force for a frame, (B, 1, S, S). There is no state."""
        features = self._features(frame)
        return Output(self.force_n(features), features, None)

    def _features(self, frames: Tensor) -> Tensor:
        """Maps frames (N, 1, S, S) to features, (N, head)."""
        return (pooled(frames, self.config.grid) - self.centre) @ self.axes


def pooled(frames: Tensor, grid: int) -> Tensor:
    """Averages prepared frames (N, 1, S, S) over squares and compresses strong changes, (N, grid²)."""
    return torch.asinh(F.avg_pool2d(frames, frames.shape[-1] // grid).flatten(1) / FAINT)


def matern(a: Tensor, b: Tensor, length: float) -> Tensor:
    """Returns the Matern kernel of smoothness 3/2 between features, (N, head) and (M, head), (N, M)."""
    squared = a.square().sum(1, keepdim=True) + b.square().sum(1) - 2 * a @ b.T
    distance = (3 * squared.clamp_min(0)).sqrt() / length
    return (1 + distance) * torch.exp(-distance)
