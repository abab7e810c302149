"""Prediction interval of a corrected estimate, with a stated coverage in contact.

*With three or more touches*, the interval follows from the errors of touches that neither the correction nor its
selection used (see `cross_validation`). The frames of one touch have correlated errors, so a touch is one draw: the
variance of its errors grows with force, each touch has the same weight, and the half-width is the quantile of
Student's t with one degree of freedom less than touches, for a variance known from so few draws. That assumes that
the errors of touches are normal, so the interval is not conformal and has no guarantee without it. A distribution-free
interval does not exist for so few draws: the quantile needs nine (docs/decisions/0012 and 0030).
docs/calibration.md has the measured coverage of new touches.

*With one or two touches* the interval follows from the model of the line, whose prior stands for the missing touches.
"""

from typing import Final

import numpy as np
from scipy.optimize import minimize
from scipy.special import stdtrit

from gripper_calibration.fits.output_curve import LinearFit
from gripper_calibration.fits.touches import Floats
from gripper_force.jobs.dataset import CONTACT_N
from gripper_force.profiles.object_profile import Interval

MIN_TOUCHES: Final = 3
_MIN_BASE_N: Final = 0.01
_MIN_VARIANCE_N2: Final = 1e-12
"""Touches without any error would need none, and the search would end in a division by zero."""


def model_interval(line: LinearFit, coverage: float) -> Interval:
    """Returns the interval from a line's model: scatter of frames and touches, and uncertainty of the line."""
    quantile = float(stdtrit(line.degrees, 0.5 + coverage / 2))
    gain_std, offset_std_n = np.sqrt(np.diag(line.covariance) + np.square(line.touch_std))
    base_n = quantile * float(np.hypot(line.frame_std_n, offset_std_n))
    return Interval(coverage=coverage, base_n=max(base_n, _MIN_BASE_N), share=quantile * float(gain_std))


def touch_interval(
    predicted_n: Floats, force_n: Floats, touch: np.ndarray[tuple[int], np.dtype[np.int64]], coverage: float
) -> Interval:
    """Returns the interval from the errors of left-out touches.

    Args:
        predicted_n: Estimates of each touch, corrected by the other touches, (N,).
        force_n: Load-cell forces, (N,).
        touch: Number of the touch of each frame, (N,).
        coverage: Share of the frames in contact that the interval must contain.
    """
    contact = force_n > CONTACT_N
    if not contact.any():
        contact[:] = True
    square = np.square(predicted_n - force_n)
    weight = _touch_weights(touch[contact])
    size2, error2 = np.square(predicted_n[contact]), square[contact]

    def cost(log_std: Floats) -> float:
        base2, share2 = np.exp(2 * log_std)
        variance = np.maximum(base2 + share2 * size2, _MIN_VARIANCE_N2)
        return float(weight @ (np.log(variance) + error2 / variance))

    rms_n = max(float(np.sqrt(weight @ error2)), _MIN_BASE_N)
    base_n, share = np.exp(minimize(cost, np.log([rms_n, 0.05]), method="Nelder-Mead").x)
    if not contact.all():  # what scatters without contact is in the base
        base_n = max(base_n, float(np.sqrt(_touch_weights(touch[~contact]) @ square[~contact])))
    degrees = max(len(np.unique(touch[contact])) - 1, 1)
    quantile = float(stdtrit(degrees, 0.5 + coverage / 2))
    return Interval(
        coverage=coverage, base_n=max(quantile * float(base_n), _MIN_BASE_N), share=quantile * float(share)
    )


def _touch_weights(touch: np.ndarray[tuple[int], np.dtype[np.int64]]) -> Floats:
    """Returns the weight of each frame, (N,): equal for each touch, with the sum 1."""
    numbers, index, counts = np.unique(touch, return_inverse=True, return_counts=True)
    weight: Floats = 1.0 / (len(numbers) * counts[index])
    return weight
