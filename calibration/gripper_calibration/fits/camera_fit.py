"""Fits of a camera: region of interest from markers on the jaws, exposure, and lag from touches."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt
from scipy.special import stdtrit

from gripper_force.errors import DataError
from gripper_force.profiles.rig_profile import CalibratedValue
from gripper_force.types import Gray
from gripper_force.vision.preprocess import Region

Floats = npt.NDArray[np.float64]
Markers = dict[int, Floats]
"""Corners (4, 2) in pixels of each fully visible marker, by its number."""

MARKERS: Final = (0, 1)
"""Numbers of the markers on the two jaws, in OpenCV's dictionary DICT_4X4_50."""

_DETECTION_PX: Final = 512
"""Smaller images are enlarged to this size: the detector needs about five pixels per marker module."""

_MARGIN: Final = 0.5
"""Margin of the region around the markers, as a share of a marker's side."""

_MAX_SIDE_RATIO: Final = 2.0
"""Markers whose sides differ by more are not the pair on the jaws."""

_CLIPPED_GRAY: Final = 250
_MAX_CLIPPED: Final = 0.005
_MIN_MEAN: Final = 40.0
_BEST_MEAN: Final = 90.0
"""Near the middle of the mean gray values in the training data of the shipped network, 62 to 110."""

_MIN_FORCE_SHARE: Final = 0.5
"""Touches below this share of the largest force are not used: friction shapes their release."""

_MIN_TOUCHES: Final = 3
METHOD_ERROR_MS: Final = 5.0
"""Error of the method, independent of the scatter of the touches: docs/decisions/0011."""


@dataclass(frozen=True, slots=True)
class ExposureCandidate:
    """Gray values of an image at one candidate exposure.

    Attributes:
        exposure_us: The exposure; None for an automatic one.
        mean: Mean gray value.
        clipped: Share of pixels that are clipped or nearly clipped.
    """

    exposure_us: int | None
    mean: float
    clipped: float

    @classmethod
    def measure(cls, exposure_us: int | None, gray: Gray) -> "ExposureCandidate":
        """Returns the candidate with the gray values of an image (H, W) uint8."""
        return cls(exposure_us, float(gray.mean()), float(np.mean(gray >= _CLIPPED_GRAY)))

    @property
    def text(self) -> str:
        """The exposure for a sentence."""
        return "automatic exposure" if self.exposure_us is None else f"{self.exposure_us} us"

    @property
    def usable(self) -> bool:
        """True if the image is neither clipped nor dark."""
        return self.clipped <= _MAX_CLIPPED and self.mean >= _MIN_MEAN


@dataclass(frozen=True, slots=True)
class CameraLag:
    """Lag of the camera's timestamps in one touch.

    Attributes:
        force_n: Force when the release began.
        lag_ms: Time by which the camera's timestamps are late against the load cell's; NaN if undetermined.
        correlation_ms: Time shift with the highest correlation of image and force. It is larger than the lag,
            because soft materials also flow.
    """

    force_n: float
    lag_ms: float
    correlation_ms: float


def select_exposure(candidates: Sequence[ExposureCandidate]) -> ExposureCandidate:
    """Returns the usable candidate with the best mean gray value.

    Raises:
        DataError: No candidate is usable.
    """
    usable = [candidate for candidate in candidates if candidate.usable]
    if not usable:
        measurements = ", ".join(
            f"{c.text}: mean {c.mean:.0f}, {100 * c.clipped:.1f} % clipped" for c in candidates
        )
        raise DataError(
            f"the image is dark or clipped at every exposure ({measurements}); change the light, the gain or the "
            "aperture, or pass other exposures with --exposure-us"
        )
    return nearest_exposure(usable)


def nearest_exposure(candidates: Sequence[ExposureCandidate]) -> ExposureCandidate:
    """Returns the usable candidate with the best mean gray value; of all candidates if none is usable."""
    return min(candidates, key=lambda one: (not one.usable, abs(np.log(max(one.mean, 1.0) / _BEST_MEAN))))


def find_markers(gray: Gray) -> Markers:
    """Returns the jaws' markers that are fully visible in an image (H, W) uint8."""
    factor = max(1, -(-_DETECTION_PX // max(gray.shape)))
    large = cv2.resize(gray, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    corners, numbers, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(large)
    if numbers is None:
        return {}
    markers = {int(n): c.reshape(4, 2) for n, c in zip(np.ravel(numbers), corners, strict=True)}
    return {n: (c.astype(np.float64) + 0.5) / factor - 0.5 for n, c in markers.items() if n in MARKERS}


def region_around(markers_by_image: Sequence[Markers], width: int, height: int) -> Region:
    """Returns the square around both markers in all images that show both, within the image.

    Args:
        markers_by_image: Markers in several images, with the jaws at several widths.
        width: Width of the images in pixels.
        height: Height of the images in pixels.

    Raises:
        DataError: No image shows both markers.
    """
    pairs = [markers for markers in markers_by_image if _is_pair(markers)]
    if not pairs:
        counts = " and ".join(f"marker {n} in {sum(n in one for one in markers_by_image)}" for n in MARKERS)
        raise DataError(
            f"no image shows both markers completely: of {len(markers_by_image)} images, {counts}; check that "
            "both (DICT_4X4_50) are on the jaws, lit, not hidden and within the image when the jaws are nearly "
            "closed, or set the region with --region"
        )
    corners = np.concatenate([corners for markers in pairs for corners in markers.values()])
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = _MARGIN * float(np.median([_side_px(c) for markers in pairs for c in markers.values()]))
    side = min(round(float((high - low).max()) + 2 * margin), width, height)
    left, top = (
        int(np.clip(round(middle - side / 2), 0, length - side))
        for middle, length in zip((low + high) / 2, (width, height), strict=True)
    )
    return left, top, side, side


def estimate_lag(touches: Sequence[CameraLag]) -> CalibratedValue:
    """Returns the median lag in ms, with a 95 % interval from the scatter and the error of the method.

    Raises:
        DataError: Fewer than three touches determine the lag.
    """
    lags_ms = np.array([touch.lag_ms for touch in usable_touches(touches)])
    count = len(lags_ms)
    if count < _MIN_TOUCHES:
        raise DataError(
            f"only {count} of {len(touches)} touches determine the camera's lag, and {_MIN_TOUCHES} are needed; "
            "pass more --touches, and check that the image shows the jaws and that the load cell delivers 80 "
            "samples/s"
        )
    value = float(np.median(lags_ms))
    mean_ms = float(stdtrit(count - 1, 0.975) * lags_ms.std(ddof=1) / np.sqrt(count))
    # The median of many normal draws scatters sqrt(pi / 2) times as much as their mean, that of few a bit less.
    scatter_ms = np.sqrt(np.pi / 2) * mean_ms
    half_ms = float(np.hypot(scatter_ms, METHOD_ERROR_MS))
    return CalibratedValue(value=value, low=value - half_ms, high=value + half_ms)


def usable_touches(touches: Sequence[CameraLag]) -> list[CameraLag]:
    """Returns the touches that are strong enough to estimate the lag from, and determine it."""
    largest_n = max((touch.force_n for touch in touches), default=0.0)
    return [t for t in touches if t.force_n >= _MIN_FORCE_SHARE * largest_n and np.isfinite(t.lag_ms)]


def _is_pair(markers: Markers) -> bool:
    if len(markers) < len(MARKERS):
        return False
    sides = [_side_px(corners) for corners in markers.values()]
    return max(sides) <= _MAX_SIDE_RATIO * min(sides)


def _side_px(corners: Floats) -> float:
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).mean())
