"""Geometry between the servo's horn and the jaws: a rack and pinion, a linkage, or a measured table.

All linkages are functions of the closing angle: the rotation of the horn from the open jaws, positive while the
jaws close.
"""

import math
from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Final

from gripper_force.config import GripperConfig, LinkageConfig
from gripper_force.errors import ConfigError

_INTERVALS: Final = 512
"""Intervals of the table that a linkage is evaluated with: its widths are exact to 0.1 um."""

_SEARCH_STEP_RAD: Final = 0.01
_LARGEST_ANGLE_RAD: Final = 255 * 2 * math.pi
"""Largest closing angle: a Dynamixel's multi-turn range."""

_DIFFERENCE_RAD: Final = 1e-5

_MIN_SHARE: Final = 0.1
"""Least travel per radian as a share of the greatest. Below it the linkage is near its dead centre, where the
force by the motor current is arbitrarily wrong."""


@dataclass(frozen=True, slots=True)
class RackAndPinion:
    """One pinion that drives two racks: the travel per radian is constant.

    Attributes:
        radius_m: Pitch radius of the pinion.
        open_width_m: Distance between the open jaws.
    """

    radius_m: float
    open_width_m: float

    def width_m(self, closing_rad: float) -> float:
        """Returns the distance between the jaws at a closing angle."""
        return self.open_width_m - 2 * self.radius_m * closing_rad

    def closing_rad(self, width_m: float) -> float:
        """Returns the closing angle at a distance between the jaws."""
        return (self.open_width_m - width_m) / (2 * self.radius_m)

    def jaw_m_per_rad(self, closing_rad: float) -> float:
        """Returns half of the width's decrease per radian: the travel of each of two jaws."""
        return self.radius_m

    def jaw_m_per_rad_range(self, closing_rad: float) -> tuple[float, float]:
        """Returns the least and the greatest plausible travel of a jaw per radian."""
        return self.radius_m, self.radius_m


@dataclass(frozen=True, slots=True)
class TabulatedLinkage:
    """A linkage in equal steps of the closing angle. Beyond both ends it continues with constant travel.

    Attributes:
        step_rad: Step of the closing angle.
        widths_m: Distance between the jaws, falling.
        jaw_m_per_rads: Travel of one jaw per radian at the same angles.
        least_m_per_rads: Least travel within `GripperConfig.position_bound_rad` of the same angles.
        greatest_m_per_rads: Greatest travel there.
    """

    step_rad: float
    widths_m: tuple[float, ...]
    jaw_m_per_rads: tuple[float, ...]
    least_m_per_rads: tuple[float, ...]
    greatest_m_per_rads: tuple[float, ...]

    def width_m(self, closing_rad: float) -> float:
        """Returns the distance between the jaws at a closing angle."""
        end_rad = self.step_rad * (len(self.widths_m) - 1)
        inside_rad = min(max(closing_rad, 0.0), end_rad)
        i, share = self._interval(inside_rad)
        width_m = self.widths_m[i] + share * (self.widths_m[i + 1] - self.widths_m[i])
        return width_m - 2 * self.jaw_m_per_rad(inside_rad) * (closing_rad - inside_rad)

    def closing_rad(self, width_m: float) -> float:
        """Returns the closing angle at a distance between the jaws."""
        inside_m = min(max(width_m, self.widths_m[-1]), self.widths_m[0])
        i = bisect_right(self.widths_m, -inside_m, key=lambda width_m: -width_m) - 1
        i = min(max(i, 0), len(self.widths_m) - 2)
        share = (self.widths_m[i] - inside_m) / (self.widths_m[i] - self.widths_m[i + 1])
        closing_rad = self.step_rad * (i + share)
        return closing_rad + (inside_m - width_m) / (2 * self.jaw_m_per_rad(closing_rad))

    def jaw_m_per_rad(self, closing_rad: float) -> float:
        """Returns half of the width's decrease per radian: the travel of each of two jaws."""
        i, share = self._interval(closing_rad)
        share = min(max(share, 0.0), 1.0)
        return self.jaw_m_per_rads[i] + share * (self.jaw_m_per_rads[i + 1] - self.jaw_m_per_rads[i])

    def jaw_m_per_rad_range(self, closing_rad: float) -> tuple[float, float]:
        """Returns the least and the greatest plausible travel of a jaw per radian."""
        i, _ = self._interval(closing_rad)
        return min(self.least_m_per_rads[i : i + 2]), max(self.greatest_m_per_rads[i : i + 2])

    def _interval(self, closing_rad: float) -> tuple[int, float]:
        i = min(max(int(closing_rad / self.step_rad), 0), len(self.widths_m) - 2)
        return i, closing_rad / self.step_rad - i


Linkage = RackAndPinion | TabulatedLinkage
"""Relation between the closing angle and the width."""


@lru_cache(maxsize=8)
def make_linkage(gripper: GripperConfig) -> Linkage:
    """Returns the linkage of a configured gripper.

    Raises:
        ConfigError: A length is missing, or the jaws cannot close with these lengths.
    """
    config = gripper.linkage
    match config.kind:
        case "rack":
            return RackAndPinion(gripper.pinion_radius_m, gripper.open_width_m)
        case "crank_slider":
            closed_m = _crank_slider(config)
        case "four_bar":
            closed_m = _four_bar(config)
        case "finger" | "fingers":
            closed_m = _finger(config)
        case "table":
            closed_m = _table(config, gripper.open_width_m)
    return _tabulate(closed_m, gripper.open_width_m, gripper.position_bound_rad)


def _tabulate(closed_m: Callable[[float], float], open_width_m: float, error_rad: float) -> TabulatedLinkage:
    """Tabulates a decrease of the width by closing angle, up to the closed jaws."""
    if math.isnan(closed_m(0.0)):
        raise ConfigError(
            "gripper.linkage cannot be assembled with open jaws: its lengths do not meet; check them and "
            "gripper.linkage.open_crank_rad"
        )
    end_rad = 0.0
    while (reached_m := closed_m(end_rad)) < open_width_m:
        end_rad += _SEARCH_STEP_RAD
        # Also not a number: the rod is too short.
        if not closed_m(end_rad) > reached_m or end_rad > _LARGEST_ANGLE_RAD:
            raise ConfigError(
                f"gripper.linkage closes by {1e3 * reached_m:.1f} mm at most, less than gripper.open_width_m "
                f"{1e3 * open_width_m:g} mm; check the lengths and the angle of the open jaws"
            )
    low_rad = end_rad - _SEARCH_STEP_RAD
    for _ in range(60):
        middle_rad = (low_rad + end_rad) / 2
        low_rad, end_rad = (
            (low_rad, middle_rad) if closed_m(middle_rad) > open_width_m else (middle_rad, end_rad)
        )
    step_rad = end_rad / _INTERVALS
    angles_rad = [i * step_rad for i in range(_INTERVALS + 1)]
    slopes = [
        (closed_m(angle_rad + _DIFFERENCE_RAD) - closed_m(angle_rad - _DIFFERENCE_RAD))
        / (4 * _DIFFERENCE_RAD)
        for angle_rad in angles_rad
    ]
    if not min(slopes) > _MIN_SHARE * max(slopes):
        raise ConfigError(
            f"gripper.linkage is near its dead centre: the travel per radian varies by more than a factor of "
            f"{1 / _MIN_SHARE:g} between open and closed; check the lengths, the angle of the open jaws and "
            "gripper.open_width_m"
        )
    widths_m = [open_width_m - closed_m(angle_rad) for angle_rad in angles_rad]
    reach = math.ceil(min(error_rad / step_rad, _INTERVALS))
    near = [slopes[max(i - reach, 0) : i + reach + 1] for i in range(_INTERVALS + 1)]
    return TabulatedLinkage(
        step_rad, tuple(widths_m), tuple(slopes), tuple(map(min, near)), tuple(map(max, near))
    )


def _crank_slider(config: LinkageConfig) -> Callable[[float], float]:
    """Two rods from one crank disc to two sliding jaws.

    Distance of a jaw from the axis, with the crank's angle from the perpendicular of the rail:
    ``crank * sin(angle) + sqrt(rod**2 - (crank * cos(angle) - offset)**2)``. See the gripper of Interbotix,
    https://docs.trossenrobotics.com/interbotix_xsarms_docs/.
    """
    crank_m, rod_m = _length(config, "crank_m"), _length(config, "rod_m")

    def jaw_m(angle_rad: float) -> float:
        across_m = crank_m * math.cos(angle_rad) - config.offset_m
        inside_m2 = rod_m**2 - across_m**2
        return crank_m * math.sin(angle_rad) + math.sqrt(inside_m2) if inside_m2 >= 0 else math.nan

    open_rad = config.open_crank_rad
    return lambda closing_rad: 2 * (jaw_m(open_rad) - jaw_m(open_rad - closing_rad))


def _four_bar(config: LinkageConfig) -> Callable[[float], float]:
    """Two mirrored four-bars whose rockers carry the fingers.

    Angles are measured from the base line, from the crank's to the rocker's pivot. The rocker's angle follows
    from Freudenstein's equation (https://en.wikipedia.org/wiki/Freudenstein_equation).
    """
    crank_m, coupler_m = _length(config, "crank_m"), _length(config, "rod_m")
    rocker_m, base_m, finger_m = (_length(config, key) for key in ("rocker_m", "base_m", "finger_m"))

    def rocker_rad(angle_rad: float) -> float:
        x_m, y_m = crank_m * math.cos(angle_rad) - base_m, crank_m * math.sin(angle_rad)
        diagonal_m = math.hypot(x_m, y_m)
        if diagonal_m == 0:
            return math.nan
        cosine = (diagonal_m**2 + rocker_m**2 - coupler_m**2) / (2 * diagonal_m * rocker_m)
        if not -1 <= cosine <= 1:
            return math.nan
        return math.atan2(y_m, x_m) - math.acos(cosine)

    open_rad, start_rad = config.open_crank_rad, config.open_finger_rad

    def closed_m(closing_rad: float) -> float:
        turned_rad = rocker_rad(open_rad) - rocker_rad(open_rad - closing_rad)
        turned_rad = math.remainder(turned_rad, 2 * math.pi)
        return 2 * finger_m * (math.sin(start_rad) - math.sin(start_rad - turned_rad))

    return closed_m


def _finger(config: LinkageConfig) -> Callable[[float], float]:
    """One finger on the horn that closes against a fixed one, or two fingers that turn alike."""
    finger_m, start_rad = _length(config, "finger_m"), config.open_finger_rad
    reach_m = finger_m if config.kind == "finger" else 2 * finger_m
    return lambda closing_rad: reach_m * (math.sin(start_rad) - math.sin(start_rad - closing_rad))


def _table(config: LinkageConfig, open_width_m: float) -> Callable[[float], float]:
    """Monotone cubic through measured rows (PCHIP), continued straight up to the closed jaws."""
    from scipy.interpolate import PchipInterpolator

    rows = config.table
    angles_rad, widths_m = [row[0] for row in rows], [row[1] for row in rows]
    falls = all(b[0] > a[0] and b[1] < a[1] for a, b in pairwise(rows))
    if len(rows) < 3 or not falls or angles_rad[0] != 0 or abs(widths_m[0] - open_width_m) > 1e-6:
        raise ConfigError(
            "gripper.linkage.table needs three or more rows of closing angle (rad) and width (m): angles rise "
            "from 0, widths fall from gripper.open_width_m"
        )
    curve = PchipInterpolator(angles_rad, widths_m)
    slope = curve.derivative()
    first_slope, last_slope = float(slope(0.0)), float(slope(angles_rad[-1]))

    def closed_m(closing_rad: float) -> float:
        if closing_rad > angles_rad[-1]:
            return open_width_m - (widths_m[-1] + last_slope * (closing_rad - angles_rad[-1]))
        return open_width_m - float(curve(closing_rad)) if closing_rad > 0 else -first_slope * closing_rad

    return closed_m


def _length(config: LinkageConfig, key: str) -> float:
    length_m: float | None = getattr(config, key)
    if length_m is None:
        raise ConfigError(
            f"gripper.linkage.kind={config.kind} needs gripper.linkage.{key}; measure and set it"
        )
    return length_m
