"""Step ``camera``: chooses the exposure, judges the picture, and sets the region."""

from datetime import date
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from gripper_calibration.fits.camera_fit import (
    MARKERS,
    ExposureCandidate,
    Markers,
    find_markers,
    nearest_exposure,
    region_around,
    select_exposure,
)
from gripper_calibration.fits.focus import MAX_BLUR, blur
from gripper_calibration.procedures.calibrate_camera import candidate_exposures_us, try_exposures
from gripper_calibration.setup.step import Found, StepResult, Task
from gripper_force.errors import DataError
from gripper_force.types import Gray
from gripper_force.vision.preprocess import Region

_SHOWN_PX: Final = 640
_DARK_GRAY: Final = 5
_MAX_DARK_SHARE: Final = 0.2
_MIN_REGION_SHARE: Final = 0.35
"""Side of the region as a share of the frame's: with less, the jaws have few pixels."""

_COLOURS: Final = {"region": (80, 200, 80), "marker": (60, 160, 255)}


def camera(task: Task) -> StepResult:
    """Takes pictures at several exposures and keeps the best one, with remarks.

    Raises:
        DataError: The picture is dark or clipped at every exposure. It is saved, too.
        GripperError: The camera failed.
    """
    config = task.config
    if config.camera.backend in ("none", "playback"):
        return StepResult(
            f"camera.backend={config.camera.backend}: no picture; a grasp controls force by motor current alone"
        )
    task.person.do("Open the jaws, put an object between them as in use, and switch on the light")
    config = config.with_values(vision={"region": None})
    is_given = "camera.exposure_us" in task.given
    exposures_us = (config.camera.exposure_us,) if is_given else candidate_exposures_us(config)
    candidates, images = try_exposures(config, exposures_us, task.progress)
    best = nearest_exposure(candidates)
    gray = images[candidates.index(best)]
    markers = find_markers(gray)
    region = _region(task, markers, gray)
    picture = task.folder / "camera.png"
    _save(gray, markers, region, picture)
    remarks = [*_light(gray, best), *_focus(gray, region), *_markers(markers, region, gray)]
    try:
        select_exposure([best] if is_given else candidates)
    except DataError as error:
        raise DataError(f"{error} (the picture: {picture})") from error
    today = date.today().isoformat()
    values = {}
    if not is_given:
        origin = f"mean gray value {best.mean:.0f}, {100 * best.clipped:.1f} % clipped, {today}"
        values["camera.exposure_us"] = Found(best.exposure_us, origin)
    if region is not None and "vision.region" not in task.given:
        values["vision.region"] = Found(list(region), f"around the markers on the jaws, {today}")
    size = f"{gray.shape[1]}x{gray.shape[0]}"
    return StepResult(
        f"{size} pixels, {best.text}, mean gray value {best.mean:.0f}",
        values,
        remarks,
        {"picture": picture},
        {
            "mean": best.mean,
            "clipped": best.clipped,
            "blur": blur(_part(gray, region)),
            "markers": sorted(markers),
        },
    )


def _region(task: Task, markers: Markers, gray: Gray) -> Region | None:
    region: Region | None = task.given.get("vision.region")
    if region is not None:
        return region
    height, width = gray.shape
    try:
        return region_around([markers], width, height)
    except DataError:  # not both markers
        return None


def _part(gray: Gray, region: Region | None) -> Gray:
    if region is None:
        return gray
    left, top, width, height = region
    return gray[top : top + height, left : left + width]


def _light(gray: Gray, best: ExposureCandidate) -> list[str]:
    remarks = []
    if best.clipped > 0:
        remarks.append(
            f"clipping: {100 * best.clipped:.1f} % of the pixels are white; a reflection hides the contact, so "
            "move the light until it is gone from the object"
        )
    else:
        remarks.append("clipping: none")
    dark = float(np.mean(gray <= _DARK_GRAY))
    if dark > _MAX_DARK_SHARE:
        remarks.append(
            f"light: {100 * dark:.0f} % of the pixels are black; light the jaws from the camera's side"
        )
    return remarks


def _focus(gray: Gray, region: Region | None) -> list[str]:
    blur_share = blur(_part(gray, region))
    if blur_share > MAX_BLUR:
        return [
            f"focus: blurred ({blur_share:.2f}; above {MAX_BLUR:g}); turn the lens, or set camera.lens_position, until "
            "edges of object and jaws are sharp"
        ]
    return [f"focus: sharp ({blur_share:.2f}; blurred above {MAX_BLUR:g})"]


def _markers(markers: Markers, region: Region | None, gray: Gray) -> list[str]:
    names = " and ".join(str(number) for number in sorted(markers))
    if len(markers) == len(MARKERS):
        remarks = ["markers: both seen"]
        if region is None:
            remarks = [
                "markers: both seen, but one is more than twice as large as the other; print both in one size, for a "
                "region around them"
            ]
    elif markers:
        remarks = [
            f"markers: only {names} is seen; bring both into view, lit and not hidden, for a region around them"
        ]
    else:
        remarks = ["markers: none (DICT_4X4_50, ids 0 and 1); they are optional"]
    if region is None:
        return [*remarks, "region: the whole frame; set vision.region to the part that shows the jaws"]
    share = region[2] / min(gray.shape)
    advice = "; bring the camera nearer, so that the jaws fill it" if share < _MIN_REGION_SHARE else ""
    return [*remarks, f"region: {100 * share:.0f} % of the frame's side{advice}"]


def _save(gray: Gray, markers: Markers, region: Region | None, path: Path) -> None:
    """Saves the enlarged picture with its region and markers drawn."""
    factor = max(1, _SHOWN_PX // max(gray.shape))
    picture = cv2.cvtColor(
        cv2.resize(gray, None, fx=factor, fy=factor, interpolation=cv2.INTER_NEAREST), cv2.COLOR_GRAY2BGR
    )
    for corners in markers.values():
        outline = np.rint((corners + 0.5) * factor).astype(np.int32)
        cv2.polylines(picture, [outline], True, _COLOURS["marker"], 2)
    if region is not None:
        left, top, width, height = (factor * one for one in region)
        cv2.rectangle(picture, (left, top), (left + width - 1, top + height - 1), _COLOURS["region"], 2)
    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), picture):
        raise DataError(f"can't write the picture {path}; check its folder")
