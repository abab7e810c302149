"""Figure of a camera's calibration: exposures, region, and the lag of each touch."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Polygon, Rectangle

from gripper_calibration.fits.camera_fit import CameraLag, ExposureCandidate, Markers, usable_touches
from gripper_calibration.plots.style import DATA, FIT, GRAY, OTHER, value_text
from gripper_force.jobs.report.plots import label_axes, saved_figure
from gripper_force.profiles.rig_profile import CameraCalibration
from gripper_force.types import Gray


def draw(
    calibration: CameraCalibration,
    frame: Gray,
    markers: Markers,
    candidates: Sequence[ExposureCandidate],
    images: Sequence[Gray],
    touches: Sequence[CameraLag],
    path: Path,
) -> None:
    """Draws the candidate exposures, the region and markers, and the lag of each touch.

    Args:
        calibration: The result.
        frame: An image with open jaws or with both markers, (H, W) uint8.
        markers: Markers in that image.
        candidates: Candidate exposures.
        images: An image at each of them.
        touches: Lag of each touch.
        path: File to write.

    Raises:
        DataError: The file can't be written.
    """
    chosen = next(one for one in candidates if one.exposure_us == calibration.exposure_us)
    title = f"Camera: {chosen.text}, {value_text(calibration.delay_ms, 'ms from contact to use')}"
    with saved_figure(path, title, 6.4) as figure:
        upper, lower = figure.subfigures(2, 1, squeeze=False, height_ratios=(1, 1.5))[:, 0]
        for axes, candidate, gray in zip(
            upper.subplots(1, len(candidates), squeeze=False)[0], candidates, images, strict=True
        ):
            selected = candidate is chosen
            _show(axes, gray, f"{candidate.text}{', selected' if selected else ''}")
            axes.set_xlabel(f"mean {candidate.mean:.0f}, clipped {100 * candidate.clipped:.1f} %")
            for spine in axes.spines.values():
                spine.set(visible=True, color=FIT if selected else GRAY, linewidth=2.5 if selected else 0.5)
        left, right = lower.subplots(1, 2, width_ratios=(1, 1.7))
        _show(
            left,
            frame,
            f"region {list(calibration.region)}, {'from markers' if calibration.markers else 'given'}",
        )
        x, y, width, height = calibration.region
        left.add_patch(Rectangle((x - 0.5, y - 0.5), width, height, fill=False, color=FIT, lw=1.5))
        for number, corners in markers.items():
            left.add_patch(Polygon(corners, fill=False, color=OTHER, lw=1.2))
            left_px, top_px = corners.min(axis=0)
            left.text(left_px, top_px - 2, f"{number}", color=FIT, va="bottom")
        _plot_lags(right, calibration, touches)


def _plot_lags(axes: Axes, calibration: CameraCalibration, touches: Sequence[CameraLag]) -> None:
    used = usable_touches(touches)
    unused = [touch for touch in touches if touch not in used]
    lag = calibration.lag_ms
    assert lag.low is not None
    assert lag.high is not None
    axes.axhspan(lag.low, lag.high, color=FIT, alpha=0.12)
    axes.axhline(lag.value, color=FIT, label=f"lag {value_text(lag, 'ms')}")
    for subset, mark, colour, label in (
        (used, "o", DATA, "through the encoder"),
        (unused, "x", GRAY, "not used: weak or undetermined"),
    ):
        axes.plot(
            [t.force_n for t in subset], [t.lag_ms for t in subset], mark, color=colour, ms=5, label=label
        )
    axes.plot(
        [t.force_n for t in touches],
        [t.correlation_ms for t in touches],
        "^",
        color=OTHER,
        ms=4,
        label="correlation of image and force (includes flow)",
    )
    shown = np.array([lag.low, lag.high, *(t.correlation_ms for t in touches), *(t.lag_ms for t in used)])
    shown = shown[np.isfinite(shown)]
    axes.set_ylim(shown.min() - 3, shown.max() + 12)
    axes.legend(loc="upper left")
    label_axes(axes, "lag of the camera's timestamps", "force of the touch, N", "lag, ms")


def _show(axes: Axes, gray: Gray, title: str) -> None:
    axes.imshow(gray, cmap="gray", vmin=0, vmax=255, interpolation="nearest")
    axes.set(xticks=[], yticks=[])
    axes.grid(False)
    axes.set_title(title)
