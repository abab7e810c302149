"""Prediction interval of a corrected estimate, with a stated coverage.

*With three or more touches*, the interval is conformal (after the jackknife+ of R. F. Barber et al., Annals
of Statistics 49 (2021) 486, doi:10.1214/20-AOS1965). Each touch is corrected by all others. Its errors are
divided by a model of how errors grow with force, and the quantile at the stated coverage is taken, with equal
weight for each touch. The frames of one touch have correlated errors, so the number of draws is the number of
touches, not of frames. A new touch scatters about the mean of K touches by sqrt(1 + 1/K) times as much as
they do, and the quantile is enlarged by this factor. docs/calibration.md has the measured coverage of new
touches.

*With one or two touches* that quantile does not exist, and the interval follows from the model of the line.
"""

from typing import Final

import numpy as np
from scipy.optimize import nnls
from scipy.special import ndtri

from gripper_calibration.fits.output_curve import LinearFit
from gripper_calibration.fits.touches import Floats
from gripper_force.profiles.object_profile import Interval

MIN_TOUCHES: Final = 3
_MIN_BASE_N: Final = 0.01


def model_interval(line: LinearFit, coverage: float) -> Interval:
    """Returns the interval from a line's model: scatter of frames and touches, and uncertainty of the line."""
    z = float(ndtri(0.5 + coverage / 2))
    gain_std, offset_std_n = np.sqrt(np.diag(line.covariance) + np.square(line.touch_std))
    base_n = z * float(np.hypot(line.frame_std_n, offset_std_n))
    return Interval(coverage=coverage, base_n=max(base_n, _MIN_BASE_N), share=z * float(gain_std))


def conformal_interval(
    predicted_n: Floats, force_n: Floats, touch: np.ndarray[tuple[int], np.dtype[np.int64]], coverage: float
) -> Interval:
    """Returns the interval from the errors of left-out touches.

    Args:
        predicted_n: Estimates of each touch, corrected by the other touches, (N,).
        force_n: Load-cell forces, (N,).
        touch: Number of the touch of each frame, (N,).
        coverage: Share of frames that the interval must contain.
    """
    error_n = np.abs(predicted_n - force_n)
    squares = np.column_stack([np.ones_like(predicted_n), np.square(predicted_n.clip(0))])
    base_n2, share2 = nnls(squares, np.square(error_n))[0]
    base_n, share = max(float(np.sqrt(base_n2)), _MIN_BASE_N), float(np.sqrt(share2))
    ratio = error_n / np.hypot(base_n, share * predicted_n)
    numbers, index, counts = np.unique(touch, return_inverse=True, return_counts=True)
    weight = 1.0 / (len(numbers) * counts[index])
    order = np.argsort(ratio)
    below = np.cumsum(weight[order])
    quantile = float(ratio[order][min(int(np.searchsorted(below, coverage)), len(ratio) - 1)])
    factor = quantile * float(np.sqrt(1 + 1 / len(numbers)))
    return Interval(coverage=coverage, base_n=max(factor * base_n, _MIN_BASE_N), share=factor * share)
