"""What a camera sees of the jaws, how long to expose, and how late its pictures come, from some touches."""

import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import cv2
import numpy as np

from gripper_calibration.fits.camera_fit import (
    ExposureStep,
    Markers,
    Touch,
    choose_exposure,
    find_markers,
    lag_of,
    region_about,
    telling,
)
from gripper_calibration.plots.camera_plot import draw
from gripper_force.config import Config
from gripper_force.errors import ConfigError, DataError, DeviceTimeoutError
from gripper_force.jobs.recording.lag import camera_lags_s, load_cell_lag_s
from gripper_force.jobs.recording.record import RecordingPlan, record
from gripper_force.jobs.recording.summary import releases_ns
from gripper_force.profiles.rig_profile import CalibratedValue, CameraCalibration, read_rig, update_rig
from gripper_force.runtime.assembly import checkpoint_of, settled
from gripper_force.runtime.backends import open_devices
from gripper_force.runtime.log import LogReader
from gripper_force.types import (
    NS_PER_MS,
    NS_PER_S,
    Frame,
    GraspStatus,
    Gray,
    LoadCellSample,
    Request,
    ServoState,
)
from gripper_force.vision.estimator import open_estimator
from gripper_force.vision.preprocess import Region, downscale

EXPOSURES_US: Final = (500, 1000, 2000, 4000, 8000, 16000)
"""The ladder, as far as half of a frame's period: what is exposed for longer is late and blurred."""

TOUCHES: Final = 10

_SETTLE_NS: Final = 300 * NS_PER_MS
_PATIENCE_NS: Final = 3 * NS_PER_S
_POLL_NS: Final = 5 * NS_PER_MS
_SMALL_PX: Final = 48
_LOOKED_AT: Final = 200
"""Pictures of the touches that are searched for markers."""

_REFERENCE_FRAMES: Final = 10
_TIMED_FRAMES: Final = 60

Progress = Callable[[str, float], None]
"""Told of the step and the force in newtons, some times a second."""


@dataclass(frozen=True, slots=True)
class CameraObservation:
    """What one recording of touches shows.

    Attributes:
        reference: Mean of the first pictures, with open jaws.
        markers: Markers of pictures that were searched.
        widest: Of those that show both, the picture where they are furthest apart; else the reference.
        widest_markers: The markers in it.
        touches: What each touch says of the lag.
        use_ms: From the camera's timestamp to the cycle that has the picture, median over all.
        rate_hz: Rate of the pictures.
    """

    reference: Gray
    markers: list[Markers]
    widest: Gray
    widest_markers: Markers
    touches: list[Touch]
    use_ms: float
    rate_hz: float


def calibrate(
    config: Config,
    rig: Path,
    *,
    region: Region | None = None,
    exposures_us: Sequence[int] = EXPOSURES_US,
    touches: int = TOUCHES,
    progress: Progress = lambda _step, _force_n: None,
) -> dict[str, Any]:
    """Tries exposures, touches the object, writes the rig profile's section and pictures beside it.

    Args:
        config: The run, with an object between the jaws that gives way, and is not wider than the picture.
        rig: The rig profile to write, or to replace the section of.
        region: Region of interest of the frame, chosen by hand; None: from the markers on the jaws.
        exposures_us: The ladder.
        touches: How often to touch.
        progress: Told of the step and the force.

    Returns:
        The section, what each touch says, and the paths.

    Raises:
        ConfigError: There is no camera or load cell, the region is not within the frame, or the profile can't
            be read or written.
        DeviceError: A device failed. The servo was stopped as configured.
        DataError: No exposure is usable, the markers are not seen, or the touches tell no lag.
    """
    if config.camera.backend in ("none", "playback"):
        raise ConfigError(
            f"calibrate camera needs one that can be set, and camera.backend is {config.camera.backend}; "
            "name yours"
        )
    if rig.exists():
        read_rig(rig)  # before anything has moved
    config = _with(config, "calibration", rig=None, object=None)  # what they say of the camera is found anew
    config = _with(config, "vision", region=region)
    ladder, pictures = _climb(config, exposures_us, progress)
    rung = choose_exposure(ladder)
    config = _with(config, "camera", exposure_us=rung.exposure_us)
    with TemporaryDirectory() as aside:

        def tell(_set: int, touch: int, force_n: float) -> None:
            progress(f"touch {touch} of {touches}", force_n)

        (log,) = record(config, RecordingPlan(1, touches), Path(aside), tell)
        seen = watch(log, region)
    height, width = seen.reference.shape
    found_region = region_about(seen.markers, width, height) if region is None else region
    lag = lag_of(seen.touches)
    taken_ms = compute_ms(_with(config, "vision", region=found_region), seen.reference)
    wait_ms = seen.use_ms + taken_ms + 500 / seen.rate_hz
    camera = config.camera
    found = CameraCalibration(
        date=datetime.now(UTC).replace(microsecond=0),
        backend=camera.backend,
        side_px=camera.side_px,
        rate_hz=camera.rate_hz,
        gain=camera.gain,
        exposure_us=rung.exposure_us,
        mean=rung.mean,
        clipped=rung.clipped,
        region=found_region,
        markers=region is None,
        lag_ms=lag,
        delay_ms=_shifted(lag, wait_ms),
        reference=f"{rig.stem}-reference.png",
    )
    update_rig(rig, found)
    _write(rig.with_name(found.reference), seen.reference)
    report = rig.with_name(f"{rig.stem}-camera.png")
    draw(found, seen.widest, seen.widest_markers, ladder, pictures, seen.touches, report)
    telling_ms = [touch.correlation_ms for touch in telling(seen.touches)]
    return {
        **found.model_dump(mode="json"),
        "correlation_lag_ms": float(np.nanmedian(telling_ms)),
        "use_ms": seen.use_ms,
        "compute_ms": taken_ms,
        "touches": len(seen.touches),
        "touches_that_tell": len(telling_ms),
        "rig": rig,
        "report": report,
    }


def watch(log: Path, region: Region | None) -> CameraObservation:
    """Looks for markers and lags in a recorded set of touches.

    Args:
        log: The set, as `gripper_force.jobs.recording.record` writes it.
        region: Region of interest, if it is known; then no markers are looked for.
    """
    records: dict[type, list[Any]] = defaultdict(list)
    frames: list[Frame] = []
    used_ms: list[float] = []
    waiting: list[Frame] = []
    for item in LogReader(log).records(Frame, ServoState, LoadCellSample, GraspStatus, Request):
        if isinstance(item, Frame):
            frames.append(item)
            waiting.append(item)
        elif isinstance(item, ServoState):  # of the cycle that had the frames before it
            used_ms += [(item.t_ns - frame.t_ns) / NS_PER_MS for frame in waiting]
            waiting = []
        else:
            records[type(item)].append(item)
    step = -(-len(frames) // _LOOKED_AT)
    looked_at = frames[::step] if region is None else []
    markers = [find_markers(frame.gray) for frame in looked_at]
    apart = [_apart_px(one) for one in markers]
    widest = int(np.argmax(apart)) if apart and max(apart) > 0 else None
    reference = np.mean([frame.gray for frame in frames[:_REFERENCE_FRAMES]], axis=0)
    as_gray: Gray = np.rint(reference).astype(np.uint8)
    frame_s = np.array([frame.t_ns for frame in frames]) / NS_PER_S
    return CameraObservation(
        reference=as_gray,
        markers=markers,
        widest=as_gray if widest is None else looked_at[widest].gray,
        widest_markers={} if widest is None else markers[widest],
        touches=_touches(frames, region, records),
        use_ms=float(np.median(used_ms)),
        rate_hz=float(1 / np.median(np.diff(frame_s))),
    )


def _touches(frames: list[Frame], region: Region | None, records: dict[type, list[Any]]) -> list[Touch]:
    frame_s = np.array([frame.t_ns for frame in frames]) / NS_PER_S
    images = np.stack([downscale(frame.gray, region, _SMALL_PX) for frame in frames])
    cells = sorted((s for s in records[LoadCellSample] if s.valid), key=lambda sample: sample.t_ns)
    cell_s = np.array([sample.t_ns for sample in cells]) / NS_PER_S
    force_n = np.array([sample.force_n for sample in cells])
    servo_s = np.array([status.t_ns for status in records[GraspStatus]]) / NS_PER_S
    width_m = np.array([status.width_m for status in records[GraspStatus]])
    releases_s = [t_ns / NS_PER_S for t_ns in releases_ns(records[Request])]
    by_servo_s = camera_lags_s(frame_s, images, servo_s, width_m, releases_s)
    by_force_s = camera_lags_s(frame_s, images, cell_s, force_n, releases_s)
    touches = []
    for at_s, camera_s, correlation_s in zip(releases_s, by_servo_s, by_force_s, strict=True):
        cell_lag_s = load_cell_lag_s(cell_s, force_n, servo_s, width_m, at_s)
        at_n = float(np.interp(at_s, cell_s, force_n))
        touches.append(Touch(at_n, 1e3 * (float(camera_s) - cell_lag_s), 1e3 * float(correlation_s)))
    return touches


def _climb(
    config: Config, exposures_us: Sequence[int], progress: Progress
) -> tuple[list[ExposureStep], list[Gray]]:
    longest_us = 0.5e6 / config.camera.rate_hz
    ladder, pictures = [], []
    for exposure_us in exposures_us:
        if exposure_us > longest_us:
            continue
        progress(f"exposure of {exposure_us} us", 0.0)
        gray = _picture(_with(config, "camera", exposure_us=exposure_us))
        region = config.vision.region
        part = gray if region is None else downscale(gray, region, min(region[2:]))
        ladder.append(ExposureStep.of(exposure_us, part))
        pictures.append(gray)
    if not ladder:
        raise ConfigError(
            f"no exposure of the ladder is as short as half of a frame's period, {longest_us:.0f} us at "
            f"camera.rate_hz {config.camera.rate_hz:g}; name shorter ones with --exposure-us"
        )
    return ladder, pictures


def _picture(config: Config) -> Gray:
    """The newest picture of a camera that has run for a while."""
    with open_devices(config) as devices:
        camera, clock = devices.camera, devices.clock
        assert camera is not None
        camera.start()
        begin_ns = now_ns = clock.now_ns()
        gray: Gray | None = None
        while gray is None or now_ns - begin_ns < _SETTLE_NS:
            now_ns += _POLL_NS
            clock.sleep_until_ns(now_ns)
            devices.check()
            if (frame := camera.newest()) is not None:
                gray = frame.gray
            if gray is None and now_ns - begin_ns > _PATIENCE_NS:
                raise DeviceTimeoutError(
                    f"the camera gave no frame for {_PATIENCE_NS / NS_PER_S:g} s at an exposure of "
                    f"{config.camera.exposure_us} us; check its cable, and see what doctor says"
                )
        return gray


def compute_ms(config: Config, gray: Gray) -> float:
    """What the network takes for a picture: on a simulated clock what it is said to, else as measured."""
    checkpoint = checkpoint_of(config)
    if checkpoint is None:
        return 0.0
    if config.clock == "lockstep":
        return config.vision.lockstep_compute_ms
    estimator = open_estimator(checkpoint, settled(config)[0].vision)
    each_ms = []
    for _ in range(_TIMED_FRAMES):
        begin_ns = time.perf_counter_ns()
        estimator.update(gray)
        each_ms.append((time.perf_counter_ns() - begin_ns) / NS_PER_MS)
    return float(np.median(each_ms))


def _with(config: Config, section: str, **values: object) -> Config:
    return config.model_copy(update={section: getattr(config, section).model_copy(update=values)})


def _shifted(estimate: CalibratedValue, by: float) -> CalibratedValue:
    low, high = (None if end is None else end + by for end in (estimate.low, estimate.high))
    return CalibratedValue(value=estimate.value + by, low=low, high=high)


def _apart_px(markers: Markers) -> float:
    if len(markers) < 2:
        return 0.0
    first, second = (corners.mean(axis=0) for corners in markers.values())
    return float(np.linalg.norm(first - second))


def _write(path: Path, gray: Gray) -> None:
    if not cv2.imwrite(str(path), gray):
        raise DataError(f"can't write the picture {path}; check its folder")
