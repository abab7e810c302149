"""Fit of the out-of-distribution limit from left-out touches."""

from collections.abc import Iterable
from typing import Final

import numpy as np

from gripper_calibration.fits.touches import Floats

SUBSPACE_DIMENSIONS: Final = 32
"""Dimensions of the subspace near which the features of one object lie."""

DEFAULT_LIMIT: Final = 1.0
"""Limit with one or two touches, which do not show how touches differ: a deviation off the subspace as large as
the calibration frames' mean square distance from their mean."""

_QUANTILE: Final = 0.995
_MIN_TOUCHES: Final = 3


def fit_ood_limit(left_out: Iterable[Floats]) -> float:
    """Returns the out-of-distribution limit.

    Args:
        left_out: For each touch, the out-of-distribution scores of its frames against all other touches,
            (N,) each.
    """
    worst = [float(np.quantile(ood_score, _QUANTILE)) for ood_score in left_out]
    if len(worst) < _MIN_TOUCHES:
        return DEFAULT_LIMIT
    return 1.5 * (1 + 2 / len(worst)) * max(worst)
