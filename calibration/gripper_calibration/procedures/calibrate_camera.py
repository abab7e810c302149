"""Calibration of a camera: exposure, region of interest and lag, from touches of a compliant object."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import cv2
import numpy as np

from gripper_calibration.fits.camera_fit import (
    CameraLag,
    ExposureCandidate,
    Markers,
    estimate_lag,
    find_markers,
    region_around,
    select_exposure,
    usable_touches,
)
from gripper_calibration.plots.camera_plot import draw
from gripper_calibration.procedures.estimate_time import estimate_ms
from gripper_force.config import CAMERA_OTHER_KEYS, Config
from gripper_force.errors import ConfigError, DataError, DeviceTimeoutError
from gripper_force.jobs.profile_files import rig_to_update, update_rig
from gripper_force.jobs.recording.lag import camera_lags_s
from gripper_force.jobs.recording.record import RecordingPlan, record
from gripper_force.jobs.recording.summary import releases_ns, touch_lags
from gripper_force.profiles.object_profile import BUNDLED, read_object, user_folder
from gripper_force.profiles.rig_profile import CalibratedValue, CameraCalibration
from gripper_force.progress import Progress, no_progress
from gripper_force.runtime.backends import open_devices
from gripper_force.runtime.log_reader import LogReader
from gripper_force.runtime.resolve import ResolvedConfig, resolve, resolve_vision
from gripper_force.schema import Tree, differences
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
from gripper_force.vision.preprocess import Region, downscale

EXPOSURES_US: Final = (500, 1000, 2000, 4000, 8000, 16000)
"""Candidate exposures. Those above half a frame's period are skipped: their images are late and blurred."""

TOUCHES: Final = 10
"""Default number of touches."""

_SETTLE_NS: Final = 300 * NS_PER_MS
_TIMEOUT_NS: Final = 3 * NS_PER_S
_POLL_NS: Final = 5 * NS_PER_MS
_SMALL_PX: Final = 48
_MAX_SEARCHED: Final = 200
"""Images of the touches that are searched for markers."""

_REFERENCE_FRAMES: Final = 10


@dataclass(frozen=True, slots=True)
class CameraObservation:
    """Evaluation of one recording of touches.

    Attributes:
        reference: Mean of the first images, with open jaws, (H, W) uint8.
        markers: Markers in each searched image.
        widest: The image with both markers furthest apart, or the reference if none shows both.
        widest_markers: The markers in it.
        touches: Lag of each touch.
        use_ms: Median time from the camera's timestamp to the control cycle that gets the frame.
        rate_hz: Frame rate.
    """

    reference: Gray
    markers: list[Markers]
    widest: Gray
    widest_markers: Markers
    touches: list[CameraLag]
    use_ms: float
    rate_hz: float


@dataclass(frozen=True, slots=True)
class CameraResult:
    """Result of `calibrate_camera`.

    Attributes:
        calibration: The section of the rig profile.
        correlation_lag_ms: Median time shift with the highest correlation of image and force.
        use_ms: Median time from the camera's timestamp to the control cycle that gets the frame.
        compute_ms: Time of one estimate.
        touches: Number of touches.
        touches_that_tell: Number of touches that determine the lag.
        rig: The rig profile.
        report: The figure, PNG.
        outdated: Profiles and bundles of the user, and the network, that were made with the settings before and not
            with these, each with its difference.
    """

    calibration: CameraCalibration
    correlation_lag_ms: float
    use_ms: float
    compute_ms: float
    touches: int
    touches_that_tell: int
    rig: Path
    report: Path
    outdated: tuple[str, ...]


def calibrate_camera(
    config: Config,
    rig: Path,
    *,
    region: Region | None = None,
    exposures_us: Sequence[int] | None = None,
    touches: int = TOUCHES,
    progress: Progress = no_progress,
) -> CameraResult:
    """Selects an exposure, touches the object, and writes the rig profile's section and figures beside it.

    Args:
        config: The configuration. A compliant object, not wider than the image, is between the jaws.
        rig: Rig profile to write; an existing one keeps its other sections.
        region: Region of interest of the frame in pixels; None: from the markers on the jaws.
        exposures_us: Candidate exposures; None: `candidate_exposures_us`.
        touches: Number of touches.
        progress: Called with the step and the force a few times per second.

    Raises:
        ConfigError: There is no camera or load cell, the region is not within the frame, or the profile can't
            be read or written.
        DeviceError: A device failed. The servo was stopped as configured.
        DataError: No exposure is usable, the markers are not visible, or the lag is undetermined.
    """
    if config.camera.backend in ("none", "playback"):
        raise ConfigError(
            f"calibrate camera needs a camera with settings, but camera.backend is {config.camera.backend}; "
            "set the backend of yours"
        )
    rig_to_update(rig)  # raises if it can't be read or written
    old_config = config
    config = config.with_values(
        calibration={"rig": None, "object": None},  # their camera settings are replaced
        vision={"region": region},
    )
    candidates, images = try_exposures(config, exposures_us or candidate_exposures_us(config), progress)
    selected = select_exposure(candidates)
    config = config.with_values(camera={"exposure_us": selected.exposure_us})
    with TemporaryDirectory() as temporary_folder:
        (log,) = record(config, RecordingPlan(1, touches), Path(temporary_folder), progress)
        evaluation = observe(log, region)
    height, width = evaluation.reference.shape
    found_region = region_around(evaluation.markers, width, height) if region is None else region
    lag = estimate_lag(evaluation.touches)
    computing_ms = compute_ms(config.with_values(vision={"region": found_region}), evaluation.reference)
    wait_ms = evaluation.use_ms + computing_ms + 500 / evaluation.rate_hz
    camera = config.camera
    calibration = CameraCalibration(
        date=datetime.now(UTC).replace(microsecond=0),
        backend=camera.backend,
        side_px=camera.side_px,
        rate_hz=camera.rate_hz,
        gain=camera.gain,
        image=camera.model_dump(mode="json", exclude=CAMERA_OTHER_KEYS | set(CameraCalibration.model_fields)),
        exposure_us=selected.exposure_us,
        mean=selected.mean,
        clipped=selected.clipped,
        region=found_region,
        markers=region is None,
        lag_ms=lag,
        delay_ms=_shifted(lag, wait_ms),
        reference=f"{rig.stem}-reference.png",
    )
    update_rig(rig, calibration)
    _write(rig.with_name(calibration.reference), evaluation.reference)
    report = rig.with_name(f"{rig.stem}-camera.png")
    draw(
        calibration,
        evaluation.widest,
        evaluation.widest_markers,
        candidates,
        images,
        evaluation.touches,
        report,
    )
    correlations_ms = [touch.correlation_ms for touch in usable_touches(evaluation.touches)]
    return CameraResult(
        calibration=calibration,
        correlation_lag_ms=float(np.nanmedian(correlations_ms)),
        use_ms=evaluation.use_ms,
        compute_ms=computing_ms,
        touches=len(evaluation.touches),
        touches_that_tell=len(correlations_ms),
        rig=rig,
        report=report,
        outdated=_outdated(old_config, config.with_values(vision={"region": found_region})),
    )


def _outdated(old: Config, new: Config) -> tuple[str, ...]:
    """Names the profiles and the network that match the camera settings of ``old``, but not those of ``new``."""
    checks: list[tuple[str, Callable[[Tree], list[str]]]] = []
    for path in sorted([*user_folder().glob("*.yaml"), *user_folder().glob(f"*/{BUNDLED}")]):
        try:
            camera = read_object(path).camera
        except ConfigError:  # damaged: a run with it says so
            continue
        checks.append(
            (f"the {'bundle' if path.name == BUNDLED else 'profile'} {path}", partial(differences, camera))
        )
    if (model := resolve_vision(old)[1]) is not None:
        checks.append((f"the network {model.path}", model.header.mismatches))
    return tuple(
        f"{name} ({', '.join(mismatches)})"
        for name, find_mismatches in checks
        if (mismatches := find_mismatches(new.rig_settings())) and not find_mismatches(old.rig_settings())
    )


def observe(log: Path, region: Region | None) -> CameraObservation:
    """Finds markers and lags in a recorded set of touches.

    Args:
        log: The set, as `gripper_force.jobs.recording.record` writes it.
        region: Region of interest, if it is known; markers are then not searched.
    """
    frames: list[Frame] = []
    samples: list[LoadCellSample] = []
    statuses: list[GraspStatus] = []
    requests: list[Request] = []
    used_ms: list[float] = []
    waiting: list[Frame] = []
    for item in LogReader(log).records(Frame, ServoState, LoadCellSample, GraspStatus, Request):
        if isinstance(item, Frame):
            frames.append(item)
            waiting.append(item)
        elif isinstance(item, ServoState):  # of the cycle that got the frames before it
            used_ms += [(item.t_ns - frame.t_ns) / NS_PER_MS for frame in waiting]
            waiting = []
        elif isinstance(item, LoadCellSample):
            samples.append(item)
        elif isinstance(item, GraspStatus):
            statuses.append(item)
        elif isinstance(item, Request):
            requests.append(item)
    step = -(-len(frames) // _MAX_SEARCHED)
    searched = frames[::step] if region is None else []
    markers = [find_markers(frame.gray) for frame in searched]
    distances = [_distance_px(one) for one in markers]
    widest = int(np.argmax(distances)) if distances and max(distances) > 0 else None
    mean = np.mean([frame.gray for frame in frames[:_REFERENCE_FRAMES]], axis=0)
    reference: Gray = np.rint(mean).astype(np.uint8)
    frame_s = np.array([frame.t_ns for frame in frames]) / NS_PER_S
    return CameraObservation(
        reference=reference,
        markers=markers,
        widest=reference if widest is None else searched[widest].gray,
        widest_markers={} if widest is None else markers[widest],
        touches=_touch_lags(frames, region, samples, statuses, releases_ns(requests)),
        use_ms=float(np.median(used_ms)),
        rate_hz=float(1 / np.median(np.diff(frame_s))),
    )


def _touch_lags(
    frames: list[Frame],
    region: Region | None,
    samples: list[LoadCellSample],
    statuses: list[GraspStatus],
    release_times_ns: list[int],
) -> list[CameraLag]:
    frame_ns = np.array([frame.t_ns for frame in frames], np.int64)
    images = np.stack([downscale(frame.gray, region, _SMALL_PX) for frame in frames])
    samples = sorted(samples, key=lambda sample: sample.t_ns)
    lags = touch_lags(frame_ns, images, samples, statuses, release_times_ns)
    cell_s = np.array([sample.t_ns for sample in samples if sample.valid]) / NS_PER_S
    force_n = np.array([sample.force_n for sample in samples if sample.valid])
    releases_s = [t_ns / NS_PER_S for t_ns in release_times_ns]
    by_force_s = camera_lags_s(frame_ns / NS_PER_S, images, cell_s, force_n, releases_s)
    return [
        CameraLag(lag.force_n, lag.lag_ms, 1e3 * float(correlation_s))
        for lag, correlation_s in zip(lags, by_force_s, strict=True)
    ]


def candidate_exposures_us(config: Config) -> Sequence[int | None]:
    """Returns the exposures to try. ``camera.exposure_us=null`` stays: some cameras have no other."""
    return EXPOSURES_US if config.camera.exposure_us is not None else (None,)


def try_exposures(
    config: Config, exposures_us: Sequence[int | None], progress: Progress
) -> tuple[list[ExposureCandidate], list[Gray]]:
    """Returns the gray values and an image at each exposure that is at most half a frame's period.

    Raises:
        ConfigError: All are longer.
        DeviceError: The camera failed.
    """
    longest_us = 0.5e6 / config.camera.rate_hz
    candidates, images = [], []
    for exposure_us in exposures_us:
        if exposure_us is not None and exposure_us > longest_us:
            continue
        progress("automatic exposure" if exposure_us is None else f"exposure of {exposure_us} us", 0)
        gray = _capture(config.with_values(camera={"exposure_us": exposure_us}))
        region = config.vision.region
        part = gray if region is None else downscale(gray, region, min(region[2:]))
        candidates.append(ExposureCandidate.measure(exposure_us, part))
        images.append(gray)
    if not candidates:
        raise ConfigError(
            f"every candidate exposure is longer than half a frame ({longest_us:.0f} us at camera.rate_hz "
            f"{config.camera.rate_hz:g}); pass shorter ones with --exposure-us"
        )
    return candidates, images


def _capture(config: Config) -> Gray:
    """Returns the newest image of a camera that has run for 0.3 s."""
    with open_devices(resolve(config, vision=False).config) as devices:
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
            if gray is None and now_ns - begin_ns > _TIMEOUT_NS:
                raise DeviceTimeoutError(
                    f"the camera gave no frame for {_TIMEOUT_NS / NS_PER_S:g} s with camera.exposure_us="
                    f"{config.camera.exposure_us}; check its cable, and run `gripper-force doctor`"
                )
        return gray


def compute_ms(config: Config, gray: Gray) -> float:
    """Time of one estimate of an image like this one."""
    config, model, _ = resolve_vision(config)
    return estimate_ms(ResolvedConfig(config, model), gray)


def _shifted(estimate: CalibratedValue, by: float) -> CalibratedValue:
    low, high = (None if end is None else end + by for end in (estimate.low, estimate.high))
    return CalibratedValue(value=estimate.value + by, low=low, high=high)


def _distance_px(markers: Markers) -> float:
    if len(markers) < 2:
        return 0.0
    first, second = (corners.mean(axis=0) for corners in markers.values())
    return float(np.linalg.norm(first - second))


def _write(path: Path, gray: Gray) -> None:
    if not cv2.imwrite(str(path), gray):
        raise DataError(f"can't write the image {path}; check its folder")
