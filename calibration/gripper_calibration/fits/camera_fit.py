"""A camera's region of interest by markers on the jaws, its exposure from a ladder, its lag from touches."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt
from scipy.stats import t as student

from gripper_force.errors import DataError
from gripper_force.profiles.rig_profile import CalibratedValue
from gripper_force.types import Gray
from gripper_force.vision.preprocess import Region

Floats = npt.NDArray[np.float64]
Markers = dict[int, Floats]
"""Number of each marker that is seen whole, and its corners (4, 2) in pixels."""

MARKERS: Final = (0, 1)
"""Numbers of the markers on the two jaws, of OpenCV's dictionary DICT_4X4_50."""

_DETECTED_PX: Final = 512
"""Small pictures are enlarged to this: the detector wants some five pixels for a marker's module."""

_MARGIN: Final = 0.5
"""What the region shows beyond the markers, as a share of a marker's side."""

_ALIKE: Final = 2.0
"""Markers on two jaws that one camera sees are not of sides that differ by more."""

_CLIPPED: Final = 250
_MOST_CLIPPED: Final = 0.005
_LEAST_MEAN: Final = 40.0
_GOOD_MEAN: Final = 90.0
"""In the middle of what the shipped network was trained with, from 62 to 110."""

_STRONG: Final = 0.5
"""Touches of less than this share of the strongest tell little: friction shapes how they let go."""

_FEWEST: Final = 3
METHOD_MS: Final = 5.0
"""What the lag of a set may be off by, whatever its touches say: docs/decisions/0011."""


@dataclass(frozen=True, slots=True)
class ExposureStep:
    """One exposure of the ladder.

    Attributes:
        exposure_us: The exposure.
        mean: Mean gray value.
        clipped: Share of the pixels that are clipped, or nearly.
    """

    exposure_us: int
    mean: float
    clipped: float

    @classmethod
    def of(cls, exposure_us: int, gray: Gray) -> "ExposureStep":
        """Judges a picture."""
        return cls(exposure_us, float(gray.mean()), float(np.mean(gray >= _CLIPPED)))

    @property
    def usable(self) -> bool:
        """Whether the picture is neither clipped nor dark."""
        return self.clipped <= _MOST_CLIPPED and self.mean >= _LEAST_MEAN


@dataclass(frozen=True, slots=True)
class Touch:
    """What one touch says of the camera's timestamps.

    Attributes:
        force_n: Force when the jaws were told to let go.
        lag_ms: Time by which the camera's timestamps are late against the load cell's; NaN: not told.
        correlation_ms: The shift at which picture and force are most alike, which is more: what gives way
            also flows.
    """

    force_n: float
    lag_ms: float
    correlation_ms: float


def choose_exposure(ladder: Sequence[ExposureStep]) -> ExposureStep:
    """The usable rung whose picture is best lit. Raises `DataError` where none is usable."""
    usable = [rung for rung in ladder if rung.usable]
    if not usable:
        seen = ", ".join(
            f"{rung.exposure_us} us: mean {rung.mean:.0f}, {100 * rung.clipped:.1f} % clipped"
            for rung in ladder
        )
        raise DataError(
            f"no exposure gives a picture that is neither dark nor clipped ({seen}); change the light, the "
            "gain or the aperture, or name other exposures with --exposure-us"
        )
    return min(usable, key=lambda rung: abs(np.log(rung.mean / _GOOD_MEAN)))


def find_markers(gray: Gray) -> Markers:
    """The jaws' markers that are seen whole in a picture (H, W) uint8."""
    factor = max(1, -(-_DETECTED_PX // max(gray.shape)))
    large = cv2.resize(gray, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    corners, numbers, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(large)
    if numbers is None:
        return {}
    found = {int(n): c.reshape(4, 2) for n, c in zip(np.ravel(numbers), corners, strict=True)}
    return {n: (c.astype(np.float64) + 0.5) / factor - 0.5 for n, c in found.items() if n in MARKERS}


def region_about(seen: Sequence[Markers], width: int, height: int) -> Region:
    """The square about both markers and all between them, wherever both are seen, within the picture.

    Args:
        seen: Markers of several pictures, with the jaws at several widths.
        width: Of the pictures.
        height: Of the pictures.

    Raises:
        DataError: No picture shows both markers whole.
    """
    both = [markers for markers in seen if _are_a_pair(markers)]
    if not both:
        counts = " and ".join(f"marker {n} in {sum(n in one for one in seen)}" for n in MARKERS)
        raise DataError(
            f"no picture shows both markers whole: of {len(seen)} there is {counts}; see that both "
            "(DICT_4X4_50) are on the jaws, lit, not hidden, and in the picture when the jaws are nearly "
            "closed, or choose with --region"
        )
    corners = np.concatenate([corners for markers in both for corners in markers.values()])
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = _MARGIN * float(np.median([_side(c) for markers in both for c in markers.values()]))
    side = min(round(float((high - low).max()) + 2 * margin), width, height)
    left, top = (
        int(np.clip(round(middle - side / 2), 0, length - side))
        for middle, length in zip((low + high) / 2, (width, height), strict=True)
    )
    return left, top, side, side


def lag_of(touches: Sequence[Touch]) -> CalibratedValue:
    """The lag over touches in ms, with a 95 % interval: their scatter, and what the method may be off by.

    Raises:
        DataError: Fewer than three touches tell it.
    """
    lags_ms = np.array([touch.lag_ms for touch in telling(touches)])
    count = len(lags_ms)
    if count < _FEWEST:
        raise DataError(
            f"{count} of {len(touches)} touches tell the camera's lag, and it takes {_FEWEST}; ask for "
            "more --touches, see that the picture shows the jaws, and that the load cell gives 80 samples/s"
        )
    value = float(np.median(lags_ms))
    scatter_ms = float(student.ppf(0.975, count - 1) * lags_ms.std(ddof=1) / np.sqrt(count))
    half_ms = float(np.hypot(scatter_ms, METHOD_MS))
    return CalibratedValue(value=value, low=value - half_ms, high=value + half_ms)


def telling(touches: Sequence[Touch]) -> list[Touch]:
    """The strong touches whose lag can be told."""
    strongest_n = max((touch.force_n for touch in touches), default=0.0)
    return [t for t in touches if t.force_n >= _STRONG * strongest_n and np.isfinite(t.lag_ms)]


def _are_a_pair(markers: Markers) -> bool:
    if len(markers) < len(MARKERS):
        return False
    sides = [_side(corners) for corners in markers.values()]
    return max(sides) <= _ALIKE * min(sides)


def _side(corners: Floats) -> float:
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).mean())
