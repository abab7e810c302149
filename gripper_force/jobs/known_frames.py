"""Subspace of the features of known frames, and typical distances to it: the fits that networks and objects share."""

from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from gripper_force.jobs.dataset import CONTACT_N
from gripper_force.profiles.object_profile import OodLimit
from gripper_force.vision.ood import GeometricMean, orthonormal

Floats = npt.NDArray[np.float64]

DIMENSIONS: Final = 128
"""Dimensions of the subspace near which the features of known frames lie. Of 64 to 200, 128 tells the 25 kinds of
objects for training best from the objects of the paper."""

EDGES_N: Final = (0.25, 1.0, 2.0, 4.0, 8.0)
"""Edges between the bins of estimated force that have a limit each."""

_FLOOR: Final = 0.05
"""Floor as a share of the median squared distance in contact: without contact, the distances are noise."""
_MAX_FRAMES: Final = 4000
"""Frames for a subspace. Adjacent frames carry nearly the same data."""


def fit_subspace(
    features: npt.NDArray[np.float32], force_n: Floats, dimensions: int = DIMENSIONS
) -> tuple[Floats, Floats, float]:
    """Fits the subspace near which features lie.

    Args:
        features: Features, (N, F).
        force_n: Load-cell forces, (N,).
        dimensions: Dimensions of the subspace, R; fewer if the features vary in fewer.

    Returns:
        The mean without contact (F,), the orthonormal axes (F, R), and the floor.
    """
    read_out = features.astype(np.float64)
    free = force_n < CONTACT_N
    if not free.any():
        free = np.ones_like(free)
    mean = read_out[free].mean(0)
    total = np.square(read_out - mean).sum(1)
    floor = max(_FLOOR * float(np.median(total[~free] if (~free).any() else total)), 1e-6)
    deviation = read_out[:: -(-len(read_out) // _MAX_FRAMES)] - mean
    if len(deviation) < deviation.shape[1]:  # the smaller of the two products has the same directions
        values, frames = np.linalg.eigh(deviation @ deviation.T)  # rising
        vectors = deviation.T @ frames
    else:
        values, vectors = np.linalg.eigh(deviation.T @ deviation)
    keep = np.flatnonzero(values > values[-1] * 1e-9)[-dimensions:]
    axes = vectors[:, keep] / np.linalg.norm(vectors[:, keep], axis=0)
    return mean, orthonormal(axes.astype(np.float16)), floor


def typical_shares(shares: Sequence[Floats], estimates_n: Sequence[Floats]) -> tuple[OodLimit, ...]:
    """Returns the typical share of each bin of estimated force that has frames, with a limit of 1.

    Args:
        shares: Shares of the residual of the frames of each log, (N,) each.
        estimates_n: Their estimates, (N,) each.
    """
    share, estimate_n = np.concatenate(shares), np.concatenate(estimates_n)
    bins = np.digitize(estimate_n, EDGES_N)
    return tuple(
        OodLimit(
            force_n=float(np.median(estimate_n[bins == number])),
            typical=max(float(np.median(share[bins == number])), 1e-9),
            limit=1.0,
        )
        for number in np.unique(bins)
    )


def smooth_ratios(limits: Sequence[OodLimit], share: Floats, estimate_n: Floats) -> Floats:
    """Returns the smoothed ratio to the typical share, (N,), for the frames of one log."""
    typical = np.interp(estimate_n, [limit.force_n for limit in limits], [limit.typical for limit in limits])
    return GeometricMean().step(share / typical)
