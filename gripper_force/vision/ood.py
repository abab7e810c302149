"""Out-of-distribution score of a stream of frames: the part of their features that no known frame shows.

The features of known frames lie near a linear subspace of few dimensions. The score of a frame is its
squared distance from that subspace, divided by its squared distance from the mean without contact, and then by the
median of this ratio over known frames at that force. The ratio compares what is unfamiliar in a frame with all that
the frame shows. The distance alone, the Q statistic of J. E. Jackson and G. S. Mudholkar, Technometrics 21 (1979)
341-349, doi:10.1080/00401706.1979.10489779, grows with the force. An unknown object is unknown in all frames, so the
logarithm is averaged over the last frames: single known frames vary as much as known and unknown objects differ.
docs/decisions/0024 compares the scores.
"""

from typing import Final

import numpy as np
import numpy.typing as npt

from gripper_force.profiles.correction import KnownFrames
from gripper_force.vision.header import OodModel

Floats = npt.NDArray[np.float64]

FRAMES: Final = 20
"""Frames that the score is averaged over: a third of a second at 60 frames per second."""


def distance2(deviation: Floats, axes: npt.NDArray[np.floating]) -> Floats:
    """Returns the squared distances from a subspace, (N,), of deviations (N, F) from its mean, for its basis (F, R)."""
    # The difference of the two squares would cancel: a known frame is within a thousandth of the subspace.
    squared: Floats = np.square(deviation - (deviation @ axes) @ axes.T).sum(1)
    return squared


def residual_share(
    features: npt.NDArray[np.floating],
    mean: npt.NDArray[np.floating],
    axes: npt.NDArray[np.floating],
    floor: float,
) -> Floats:
    """Returns the squared distance from a subspace over the squared distance from the mean, 0 to 1, (N,).

    Args:
        features: Features, (N, F).
        mean: Mean, (F,).
        axes: Orthonormal basis of the subspace, (F, R).
        floor: Added to the squared distance from the mean: there is always noise.
    """
    deviation = features.astype(np.float64) - mean
    share: Floats = distance2(deviation, axes) / (np.square(deviation).sum(1) + floor)
    return share


def orthonormal(axes: npt.NDArray[np.floating]) -> Floats:
    """Returns an orthonormal basis, (F, R), of the subspace that stored axes span, (F, R)."""
    basis: Floats = np.linalg.qr(axes.astype(np.float64))[0]
    return basis


def known_frames(model: OodModel) -> KnownFrames:
    """Returns the known frames of a checkpoint."""
    mean = np.frombuffer(model.mean, np.float32)
    axes = np.frombuffer(model.axes, np.float16).reshape(len(mean), -1)
    return KnownFrames(mean, axes, model.floor, model.limits)


class OodScore:
    """Scores the frames of a stream."""

    def __init__(self, model: OodModel, known: KnownFrames | None = None) -> None:
        """Starts a stream.

        Args:
            model: Model of the checkpoint.
            known: Known frames of an object profile, in place of those of the checkpoint.
        """
        self._mean, axes, self._floor, limits = known or known_frames(model)
        self._axes = orthonormal(axes)
        self._forces_n, self._typical, self._limit = np.array(
            [(limit.force_n, limit.typical, limit.limit) for limit in limits]
        ).T
        self._std = model.std_base, model.std_growth
        self.reset()

    def reset(self) -> None:
        """Starts a new stream."""
        self._mean_ratio = GeometricMean()

    def score(self, features: npt.NDArray[np.float32], estimates_n: Floats) -> Floats:
        """Returns the score over its limit, (N,); above 1 a frame is rejected.

        Args:
            features: Features of the next frames of the stream, (N, F).
            estimates_n: Their estimates, (N,).
        """
        share = residual_share(features, self._mean, self._axes, self._floor)
        ratio = self._mean_ratio.step(share / np.interp(estimates_n, self._forces_n, self._typical))
        score: Floats = ratio / np.interp(estimates_n, self._forces_n, self._limit)
        return score

    def std_factor(self, score: npt.ArrayLike) -> Floats:
        """Returns the factor of the claimed standard deviation, (N,), for scores over the limit (N,)."""
        base, growth = self._std
        return np.hypot(base, growth * np.asarray(score, np.float64))


class GeometricMean:
    """Geometric mean over the last frames, with weights that decay by 1/e in `FRAMES` frames.

    It starts at 1: the first frames of a stream show no contact, so nothing in them can be unfamiliar, and a single
    frame varies too much to be judged alone.
    """

    def __init__(self) -> None:
        self._mean = 0.0

    def step(self, ratios: Floats) -> Floats:
        """Returns the mean up to each of the next ratios, (N,)."""
        means = np.empty(len(ratios))
        for i, value in enumerate(np.log(ratios.clip(1e-9))):
            self._mean += (value - self._mean) / FRAMES
            means[i] = self._mean
        return np.exp(means)
