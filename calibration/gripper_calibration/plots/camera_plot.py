"""A camera's calibration as a picture: what it sees, how it was exposed, and its lag in each touch."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Polygon, Rectangle

from gripper_calibration.fits.camera_fit import ExposureStep, Markers, Touch, telling
from gripper_calibration.plots.style import DATA, FIT, GRAY, OTHER, name, picture, text_of
from gripper_force.profiles.rig_profile import CameraCalibration
from gripper_force.types import Gray


def draw(
    found: CameraCalibration,
    frame: Gray,
    markers: Markers,
    ladder: Sequence[ExposureStep],
    pictures: Sequence[Gray],
    touches: Sequence[Touch],
    path: Path,
) -> None:
    """The frame with region and markers, the ladder of exposures, and the lag by each touch."""
    title = f"Camera: {found.exposure_us} us, {text_of(found.delay_ms, 'ms from contact to use')}"
    with picture(path, title, 6.4) as figure:
        upper, lower = figure.subfigures(2, 1, squeeze=False, height_ratios=(1, 1.5))[:, 0]
        for axes, rung, gray in zip(
            upper.subplots(1, len(ladder), squeeze=False)[0], ladder, pictures, strict=True
        ):
            chosen = rung.exposure_us == found.exposure_us
            _show(axes, gray, f"{rung.exposure_us} us{', chosen' if chosen else ''}")
            axes.set_xlabel(f"mean {rung.mean:.0f}, clipped {100 * rung.clipped:.1f} %")
            for spine in axes.spines.values():
                spine.set(visible=True, color=FIT if chosen else GRAY, linewidth=2.5 if chosen else 0.5)
        left, right = lower.subplots(1, 2, width_ratios=(1, 1.7))
        _show(left, frame, f"region {list(found.region)}, {'by markers' if found.markers else 'by hand'}")
        x, y, width, height = found.region
        left.add_patch(Rectangle((x - 0.5, y - 0.5), width, height, fill=False, color=FIT, lw=1.5))
        for number, corners in markers.items():
            left.add_patch(Polygon(corners, fill=False, color=OTHER, lw=1.2))
            left_px, top_px = corners.min(axis=0)
            left.text(left_px, top_px - 2, f"marker {number}", color=FIT, va="bottom")
        _lags(right, found, touches)


def _lags(axes: Axes, found: CameraCalibration, touches: Sequence[Touch]) -> None:
    used = telling(touches)
    weak = [touch for touch in touches if touch not in used]
    lag = found.lag_ms
    assert lag.low is not None
    assert lag.high is not None
    axes.axhspan(lag.low, lag.high, color=FIT, alpha=0.12)
    axes.axhline(lag.value, color=FIT, label=f"lag {text_of(lag, 'ms')}")
    for some, mark, colour, label in (
        (used, "o", DATA, "by way of the encoder"),
        (weak, "x", GRAY, "not used: weak, or not clear"),
    ):
        axes.plot([t.force_n for t in some], [t.lag_ms for t in some], mark, color=colour, ms=5, label=label)
    axes.plot(
        [t.force_n for t in touches],
        [t.correlation_ms for t in touches],
        "^",
        color=OTHER,
        ms=4,
        label="picture against force: what flows adds to it",
    )
    shown = np.array([lag.low, lag.high, *(t.correlation_ms for t in touches), *(t.lag_ms for t in used)])
    shown = shown[np.isfinite(shown)]
    axes.set_ylim(shown.min() - 3, shown.max() + 12)
    axes.legend(loc="upper left", ncols=2)
    name(axes, "how late the camera's timestamps are", "force of the touch, N", "ms")


def _show(axes: Axes, gray: Gray, title: str) -> None:
    axes.imshow(gray, cmap="gray", vmin=0, vmax=255, interpolation="nearest")
    axes.set(xticks=[], yticks=[])
    axes.grid(False)
    axes.set_title(title)
