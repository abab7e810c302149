"""How far off a corrected estimate is at most, with a stated probability.

*From three touches on* by conformal prediction: the errors on each touch, as corrected by all others (after
the jackknife+ of R. F. Barber et al., Annals of Statistics 49 (2021) 486, doi:10.1214/20-AOS1965), are
divided by their own growth with the force, and the quantile that leaves the promised share below is taken,
each touch counting the same. Frames of one touch err together, so there are as many draws as touches, not
frames: of K touches, a new one is spread about their mean by sqrt(1 + 1/K) times as much as they are, and so
the quantile grows. docs/calibration.md shows how often new touches were within.

*With one or two* that quantile is not to be had, and the interval is what the line's model says.
"""

from typing import Final

import numpy as np
from scipy.optimize import nnls
from scipy.special import ndtri

from gripper_calibration.fits.output_curve import LinearFit
from gripper_calibration.fits.touches import Floats
from gripper_force.profiles.object_profile import Interval

FEWEST: Final = 3
_LEAST_N: Final = 0.01


def by_model(line: LinearFit, coverage: float) -> Interval:
    """The interval of a line: scatter of frames and of touches, and what is not known of the line."""
    z = float(ndtri(0.5 + coverage / 2))
    gain_std, offset_std_n = np.sqrt(np.diag(line.covariance) + np.square(line.touch_std))
    base_n = z * float(np.hypot(line.frame_std_n, offset_std_n))
    return Interval(coverage=coverage, base_n=max(base_n, _LEAST_N), share=z * float(gain_std))


def by_conformal(
    predicted_n: Floats, force_n: Floats, touch: np.ndarray[tuple[int], np.dtype[np.int64]], coverage: float
) -> Interval:
    """The interval that left-out touches tell.

    Args:
        predicted_n: Estimates of each touch, corrected by the others, (N,).
        force_n: What the load cell felt, (N,).
        touch: Number of each frame's touch, (N,).
        coverage: Share of frames that the interval is to hold.
    """
    error_n = np.abs(predicted_n - force_n)
    squares = np.column_stack([np.ones_like(predicted_n), np.square(predicted_n.clip(0))])
    base_n2, share2 = nnls(squares, np.square(error_n))[0]
    base_n, share = max(float(np.sqrt(base_n2)), _LEAST_N), float(np.sqrt(share2))
    ratio = error_n / np.hypot(base_n, share * predicted_n)
    numbers, index, counts = np.unique(touch, return_inverse=True, return_counts=True)
    weight = 1.0 / (len(numbers) * counts[index])
    order = np.argsort(ratio)
    below = np.cumsum(weight[order])
    quantile = float(ratio[order][min(int(np.searchsorted(below, coverage)), len(ratio) - 1)])
    factor = quantile * float(np.sqrt(1 + 1 / len(numbers)))
    return Interval(coverage=coverage, base_n=max(factor * base_n, _LEAST_N), share=factor * share)
