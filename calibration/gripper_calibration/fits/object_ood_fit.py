"""Fit of the out-of-distribution score of one object: that of a checkpoint, with the known frames of its touches.

*With three or more touches* the subspace is that of the touches alone, so the score tells the object from others, also
if the network does not know it. Each touch is scored against the others, which shows how touches differ.

*With one or two touches* the subspace is that of the checkpoint, and its limits are widened by what the touches show.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np

from gripper_calibration.fits.touches import Floats, Touches
from gripper_force.jobs.known_frames import fit_subspace, smooth_ratios, typical_shares
from gripper_force.profiles.correction import KnownFrames
from gripper_force.profiles.object_profile import OodLimit
from gripper_force.vision.header import OodModel
from gripper_force.vision.ood import OodScore, known_frames, residual_share

DIMENSIONS: Final = 32
"""Dimensions of the subspace near which the features of one object lie."""

MIN_TOUCHES: Final = 3
"""Fewer touches do not show how touches differ."""

_MAX_FRAMES: Final = 600
"""Frames for a subspace. Adjacent frames carry nearly the same data, and the cost is cubic."""

_QUANTILE: Final = 0.995


def fit_object_ood(touches: Touches, model: OodModel) -> KnownFrames:
    """Returns the known frames of an object.

    Args:
        touches: One or more touches.
        model: Model of the network.
    """
    numbers = touches.numbers
    parts = [touches.only([number]) for number in numbers]
    if len(numbers) < MIN_TOUCHES:
        worst = [np.quantile(OodScore(model).score(p.features, p.estimate_n), _QUANTILE) for p in parts]
        frames = known_frames(model)
        widened = max(1.0, _margin(len(parts)) * float(max(worst)))
        return frames._replace(
            limits=tuple(one.model_copy(update={"limit": widened * one.limit}) for one in frames.limits)
        )
    return KnownFrames(*object_subspace(touches), object_limits(*left_out_shares(touches)))


def left_out_shares(touches: Touches) -> tuple[list[Floats], list[Floats]]:
    """Returns the shares of the residual of the frames of each touch, by the subspace of the others, and its estimates.

    Args:
        touches: Two or more touches.
    """
    parts = [touches.only([number]) for number in touches.numbers]
    subspaces = [object_subspace(touches.without([number])) for number in touches.numbers]
    shares = [
        residual_share(part.features, *subspace) for part, subspace in zip(parts, subspaces, strict=True)
    ]
    return shares, [part.estimate_n for part in parts]


def object_limits(
    shares: Sequence[Floats], estimates_n: Sequence[Floats], touches: int | None = None
) -> tuple[OodLimit, ...]:
    """Returns the limits that follow from touches, each scored against others.

    Args:
        shares: Shares of the residual of the frames of each touch, (N,) each.
        estimates_n: Their estimates, (N,) each.
        touches: Number of different touches; None: each is scored once.
    """
    typical = typical_shares(shares, estimates_n)
    ratios = [smooth_ratios(typical, *touch) for touch in zip(shares, estimates_n, strict=True)]
    limit = _margin(touches or len(ratios)) * max(float(np.quantile(ratio, _QUANTILE)) for ratio in ratios)
    return tuple(t.model_copy(update={"limit": limit}) for t in typical)


def object_subspace(touches: Touches) -> tuple[Floats, Floats, float]:
    """Returns mean, axes and floor of the features of touches, as `KnownFrames` has them."""
    thin = touches.thinned(_MAX_FRAMES)
    return fit_subspace(thin.features, thin.force_n, DIMENSIONS)


def _margin(touches: int) -> float:
    """Factor from the highest score of some touches to a limit: the fewer touches, the higher new ones may be."""
    return 1.5 * (1 + 2 / touches)
