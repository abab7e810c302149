"""Remarks of the step ``camera``. `test_run` runs the step."""

import numpy as np

from gripper_calibration.setup import camera as module


def test_markers_of_very_different_size_are_not_called_one_marker() -> None:
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float64)
    gray = np.zeros((128, 128), np.uint8)
    (remark, _) = module._markers({0: 10 * square, 1: 60 + 30 * square}, None, gray)
    assert remark.startswith("markers: both seen, but one is more than twice as large")
    (remark, _) = module._markers({0: 10 * square}, None, gray)
    assert remark.startswith("markers: only 0 is seen")
