"""Comparison of the view before the contact with the views that a network knows.

A network sees how a frame differs from the reference, not the object: with small forces, an unknown object looks like a
known one. Its shape is in the reference. The view is described by histograms of oriented gradients (N. Dalal and B.
Triggs, CVPR 2005, 886-893, doi:10.1109/CVPR.2005.177), which change little with light and texture. Those of known views
lie near a linear subspace of few dimensions. docs/decisions/0036 compares descriptions.
"""

from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from gripper_force.types import Gray
from gripper_force.vision.header import VIEW_LENGTH, KnownViews
from gripper_force.vision.ood import distance2

_SIDES: Final = (64, 32, 16, 16)
_DIRECTIONS: Final = 18
"""Sides of the image, its blocks, their steps and their cells, in pixels. Blocks of four cells overlap by half, and
each is normalised: 9 blocks of 4 cells of 18 directions."""

Floats = npt.NDArray[np.float64]


def describe_view(reference: Gray) -> Floats:
    """Returns the description, (`VIEW_LENGTH`,), of a reference image (S, S)."""
    window, block, step, cell = [(side, side) for side in _SIDES]
    hog = cv2.HOGDescriptor(window, block, step, cell, _DIRECTIONS, _signedGradient=True)
    image = cv2.resize(reference, window, interpolation=cv2.INTER_AREA)
    return np.asarray(hog.compute(image), np.float64).reshape(VIEW_LENGTH)


def view_score(known: KnownViews, reference: Gray) -> float:
    """Returns the squared distance of a reference image (S, S) from the known views, over its limit."""
    mean = np.frombuffer(known.mean, np.float32)
    axes = np.frombuffer(known.axes, np.float16).reshape(VIEW_LENGTH, -1).astype(np.float64)
    return float(distance2(describe_view(reference)[None] - mean, axes)[0]) / known.limit
