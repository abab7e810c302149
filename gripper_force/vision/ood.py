"""Out-of-distribution score of a frame: the part of its features that no known frame shows.

The features of known frames lie near a linear subspace of few dimensions. The score is the squared distance of
a frame's features from that subspace, as a share of their squared distance from the mean without contact. It
thus compares what is unfamiliar in a frame with all that the frame shows, so one limit suits light and firm
contacts better than the distance alone: the Q statistic of J. E. Jackson and G. S. Mudholkar, Technometrics 21
(1979) 341-349, doi:10.1080/00401706.1979.10489779, which grows with the force. docs/decisions/0024 compares them.
"""

import numpy as np
import numpy.typing as npt

from gripper_force.vision.header import OodModel

Floats = npt.NDArray[np.float64]


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
    deviation = (features - mean).astype(np.float32)
    total = np.square(deviation).sum(1, dtype=np.float64)
    residual = total - np.square(deviation @ axes).sum(1, dtype=np.float64)
    share: Floats = residual.clip(0) / (total + floor)
    return share


class OodScore:
    """Scores features with the model of a checkpoint."""

    def __init__(self, model: OodModel) -> None:
        self._mean = np.frombuffer(model.mean, np.float32)
        self._axes = np.frombuffer(model.axes, np.float16).reshape(len(self._mean), -1).astype(np.float32)
        self._floor = model.floor
        self._forces_n = [limit.force_n for limit in model.limits]
        self._limits = [limit.limit for limit in model.limits]
        self._std = model.std_base, model.std_growth

    def score(self, features: npt.NDArray[np.float32], estimate_n: npt.ArrayLike) -> Floats:
        """Returns the score over its limit, (N,), for features (N, F) and estimates (N,); above 1 is rejected."""
        share = residual_share(features, self._mean, self._axes, self._floor)
        return share / np.interp(estimate_n, self._forces_n, self._limits)

    def std_factor(self, score: npt.ArrayLike) -> Floats:
        """Returns the factor of the claimed standard deviation, (N,), for scores over the limit (N,)."""
        base, growth = self._std
        return np.hypot(base, growth * np.asarray(score, np.float64))
