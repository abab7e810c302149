"""Plausibility checks on camera frames.

A network returns a force for any image, so flat, badly exposed, garbled and disturbed frames are rejected first.
"""

from statistics import median
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from gripper_force.config import MAX_COVERED
from gripper_force.errors import DataError, UnfamiliarFrameError
from gripper_force.types import Gray
from gripper_force.vision.preprocess import FLAT_STD

MAX_RATIOS: Final = {"brightness": 1.6, "contrast": 2.5, "roughness": 2.5}
"""Largest ratios of a frame to the first frame of the stream, in either direction. The extremes observed in
presses are 1.15, 1.33 and 1.2 in simulation, and 1.06, 1.04 and 1.1 with a finger camera."""

MAX_SHIFT: Final = 0.0086
"""Largest shift of the still part of the image, as a share of its side."""

MAX_ZOOM: Final = 0.014
"""Largest change of its scale."""

MAX_SLOPE: Final = 0.06
"""Largest difference of the change of light between the middle and an edge, as a share of the mean brightness."""

MAX_BLUR: Final = 0.25
"""Largest loss of fine detail of the still part of the image, as a share of the first frame's."""

_BLOCKS: Final = 8
"""Blocks along a side, in which fine detail is compared."""

_SAMPLED_SIDE: Final = 32
"""Pixels along a side that the motion is fitted to."""

_FIT_SCALES: Final = np.geomspace(12, 3, 6, dtype=np.float32)
"""Scale of the robust fit in gray levels, at each of its steps."""

_STILL_LEVELS: Final = 2 * float(_FIT_SCALES[-1])
"""Gray levels by which a pixel that follows a change may differ from it."""

_MIN_PX: Final = 64
"""Side of the smallest image in which disturbances are looked for: the limits are half a pixel there."""

_MIN_STILL: Final = 0.25
"""Smallest share of the image that must follow the fitted change. In presses it is 0.5 or more."""

_LARGE_SHIFT: Final = 0.3
"""Largest shift that is looked for by correlation, as a share of the image's side. The fit finds small ones."""

_FEW_STILL: Final = 0.6
"""Share of the image that follows the fitted change, below which a larger shift is looked for."""

_EXPLAINED: Final = 0.05
"""Share of the image that a large shift must explain beyond what no shift explains. In presses it explains less."""

_SMOOTHING_PX: Final = 0.8
"""Standard deviation of the smoothing against noise, in pixels."""

_DETAIL_NOISE: Final = 1.0
"""Fine detail that is only noise, in squared gray levels: a block without texture can lose none."""

Floats = npt.NDArray[np.float32]


class FrameChecks:
    """Compares each frame of a stream with the first one, which must show no contact.

    Brightness, contrast and roughness are those of the whole frame. The other checks are for what disturbs a run:
    the camera is moved, zoomed or refocused, the light comes from elsewhere, something covers the view. In a grasp
    jaws and object move, but the rest of the image stays. So a change of the whole image, its shift, zoom and
    change of light, is fitted robustly: what does not follow it gets no weight (M-estimator of Geman and McClure on
    one step of Lucas and Kanade, IJCAI 1981; M. J. Black and P. Anandan, Computer Vision and Image Understanding 63
    (1996) 75-104, doi:10.1006/cviu.1996.0006). A shift beyond the range of that fit is found by phase correlation.
    """

    def __init__(self, max_covered: float = MAX_COVERED) -> None:
        """Starts a stream; ``max_covered`` is the largest share of the image that may lose its fine detail."""
        self._max_covered = max_covered
        self._first_values: tuple[float, float, float] | None = None

    def check(self, image: Gray) -> None:
        """Checks the next frame.

        Args:
            image: Cropped and resized frame, (S, S) uint8.

        Raises:
            DataError: The frame is flat, or differs from the first frame by more than a grasp explains.
            UnfamiliarFrameError: Part of the image lost its fine detail: something covers or blurs the view, or the
                object that was there is gone. Its force is NaN.
        """
        pixels = image.astype(np.float32)
        brightness, contrast = (float(value.item()) for value in cv2.meanStdDev(pixels))
        if contrast < FLAT_STD:
            raise DataError(
                f"the camera's image is flat (gray level {brightness:.0f}); check its lens, light and exposure"
            )
        steps = cv2.norm(pixels[:, 1:], pixels[:, :-1], cv2.NORM_L1) / pixels[:, 1:].size
        values = brightness, contrast, steps / contrast
        if self._first_values is None:
            self._first_values = values
            if len(pixels) >= _MIN_PX:
                self._set_first_frame(pixels)
        for (name, limit), present, first in zip(MAX_RATIOS.items(), values, self._first_values, strict=True):
            if not first / limit <= present <= first * limit:
                raise DataError(
                    f"the image's {name} changed from {first:.3g} to {present:.3g} since the first frame; check "
                    "the camera and the light"
                )
        changes = self.changes(pixels) if len(pixels) >= _MIN_PX else {}
        exceeded = {name: cause for name, (change, limit, cause) in changes.items() if change > limit}
        if exceeded:
            cause = next(iter(exceeded.values()))
            problem = f"{cause} since the first frame; check the camera, its lens and the light"
            raise UnfamiliarFrameError(problem) if "covered" in exceeded else DataError(problem)

    def changes(self, pixels: Floats) -> dict[str, tuple[float, float, str]]:
        """Returns each measured change of a frame since the first one by name, its limit, and a clause that names it.

        Args:
            pixels: Cropped and resized frame, (S, S).
        """
        smooth = cv2.GaussianBlur(pixels, (0, 0), _SMOOTHING_PX)
        directions, difference = self._fitted[:-1], self._fitted[-1]  # (7, N), (N,)
        difference[:] = (smooth - self._smooth).take(self._sampled)
        change = np.zeros(len(directions), np.float32)
        for scale in _FIT_SCALES:
            weight = 1 / np.square(1 + np.square((difference - change @ directions) / scale))
            sums = np.multiply(directions, weight, out=self._weighted) @ self._fitted.T  # (7, 8)
            change = cv2.solve(sums[:, :-1] + self._prior, sums[:, -1:], flags=cv2.DECOMP_CHOLESKY)[1][:, 0]
        still = np.abs(difference - change @ directions) < _STILL_LEVELS
        if still.mean() < _MIN_STILL:  # nothing to compare with
            change[:], still[:] = 0, False
        shift, zoom = float(np.hypot(*change[:2])), float(abs(change[2]))
        if still.mean() < _FEW_STILL:
            shift = max(shift, self._large_shift(smooth))
        slope = float(np.hypot(*change[5:])) / self._first_values[0] if self._first_values else 0.0
        detail = _block_means(np.square(cv2.Laplacian(smooth, cv2.CV_32F)))
        ratio = (detail + _DETAIL_NOISE) / (self._detail + _DETAIL_NOISE)
        still_ratios = ratio[_block_means(still.reshape(_SAMPLED_SIDE, -1).astype(np.float32)) > 0.7]
        blur = 1 - median(still_ratios.tolist()) if len(still_ratios) else 0.0
        covered = float((ratio < 0.3).mean())
        light_text = f"the light changed by {slope:.0%} more at one side than in the middle"
        cover = f"{covered:.0%} of the image lost its detail, as if it was covered, over vision.max_covered,"
        return {
            "shift": (shift, MAX_SHIFT, f"the camera's view moved by {shift:.1%} of its side"),
            "zoom": (zoom, MAX_ZOOM, f"the camera's view was zoomed by {zoom:.1%}"),
            "slope": (slope, MAX_SLOPE, light_text),
            "blur": (blur, MAX_BLUR, f"the image lost {blur:.0%} of its fine detail"),
            "covered": (covered, self._max_covered, cover),
        }

    def _large_shift(self, smooth: Floats) -> float:
        """Returns the shift since the first frame as a share of the side, if it explains the image better than none."""
        side = len(smooth)
        (right, down), _ = cv2.phaseCorrelate(
            self._smooth - self._smooth.mean(), smooth - smooth.mean(), self._window
        )
        if not MAX_SHIFT < max(abs(right), abs(down)) / side < _LARGE_SHIFT:
            return 0.0
        move = np.array([[1, 0, right], [0, 1, down]], np.float32)
        moved = cv2.warpAffine(self._smooth, move, (side, side), borderMode=cv2.BORDER_REPLICATE)
        explained = self._explained(smooth - moved) - self._explained(smooth - self._smooth)
        return float(np.hypot(right, down)) / side if explained > _EXPLAINED else 0.0

    def _explained(self, difference: Floats) -> float:
        """Returns the share of the pixels whose difference is the median, apart from noise."""
        sampled = difference.take(self._sampled)
        return float((np.abs(sampled - np.median(sampled)) < _STILL_LEVELS).mean())

    def _set_first_frame(self, pixels: Floats) -> None:
        """Prepares the comparison with the first frame."""
        self._smooth = cv2.GaussianBlur(pixels, (0, 0), _SMOOTHING_PX)
        self._detail = _block_means(np.square(cv2.Laplacian(self._smooth, cv2.CV_32F)))
        side = len(pixels)
        self._window = cv2.createHanningWindow((side, side), cv2.CV_32F)
        points = ((np.arange(_SAMPLED_SIDE) + 0.5) * side / _SAMPLED_SIDE).astype(int)
        self._sampled = (points[:, None] * side + points).ravel()  # (N,), indices of evenly spaced pixels
        y, x = np.meshgrid(*[np.linspace(-1, 1, side, dtype=np.float32)] * 2, indexing="ij")
        # Gray levels per shift by one side, and per zoom about the middle.
        right, down = (cv2.Sobel(self._smooth, cv2.CV_32F, dx, 1 - dx, scale=-side / 8) for dx in (1, 0))
        zoom = (right * x + down * y) / 2
        ones, zeros = np.ones_like(x), np.zeros_like(x)  # each frame replaces the zeros by its difference
        directions = (right, down, zoom, ones, self._smooth - self._smooth.mean(), x, y, zeros)
        self._fitted = np.stack([direction.take(self._sampled) for direction in directions])  # (8, N)
        # A new array for each step would take longer than the step.
        self._weighted = np.empty_like(self._fitted[:-1])
        # A direction that no texture shows stays at zero.
        self._prior = np.diag(np.array([side**2] * 3 + [1] * 4, np.float32) * self._fitted.shape[1] / 400)


def _block_means(image: Floats) -> Floats:
    """Returns the means of the blocks of an image, (B, B)."""
    return np.asarray(cv2.resize(image, (_BLOCKS, _BLOCKS), interpolation=cv2.INTER_AREA), np.float32)
