"""How unlike the calibration's frames a frame may be before its estimate counts for nothing."""

from collections.abc import Iterable
from typing import Final

import numpy as np

from gripper_calibration.fits.touches import Floats

AXES: Final = 32
"""Dimensions of the plane near which the features of one object lie."""

UNKNOWN: Final = 1.0
"""With one or two touches nothing tells how touches differ: as unlike as frames are among each other."""

_QUANTILE: Final = 0.995
_FEWEST: Final = 3


def limit(left_out: Iterable[Floats]) -> float:
    """The gate's limit from the ood_score of each touch's frames to all other touches, (N,) each."""
    worst = [float(np.quantile(ood_score, _QUANTILE)) for ood_score in left_out]
    if len(worst) < _FEWEST:
        return UNKNOWN
    return 1.5 * (1 + 2 / len(worst)) * max(worst)
