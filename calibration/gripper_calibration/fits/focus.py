"""Blur of an image without a reference: Crete et al. 2007, https://doi.org/10.1117/12.702790."""

from typing import Final

import cv2
import numpy as np

from gripper_force.types import Gray

_TAPS: Final = 9
"""Length of the averaging filter, as in the paper."""

MAX_BLUR: Final = 0.5
"""Blur above which contours are too soft: see tests/calibration/fits/test_focus.py."""


def blur(gray: Gray) -> float:
    """Returns the blur of an image (H, W): 0 sharp, 1 without any edge.

    An image that was blurred before hardly changes when it is blurred again.
    """
    image = gray.astype(np.float64)
    return max(_along(image), _along(image.T.copy()))


def _along(image: np.ndarray) -> float:
    """Blur along the first axis."""
    reblurred = cv2.blur(image, (1, _TAPS), borderType=cv2.BORDER_REFLECT)
    steps, steps_again = np.abs(np.diff(image, axis=0)), np.abs(np.diff(reblurred, axis=0))
    total = float(steps.sum())
    if total == 0.0:
        return 1.0
    return 1.0 - float(np.maximum(steps - steps_again, 0.0).sum()) / total
