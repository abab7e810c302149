"""Summary of recorded sets: frames, forces, losses, and the lag between camera and load cell."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypedDict

import numpy as np
import numpy.typing as npt

from gripper_force.config import config_from_text
from gripper_force.errors import DataError
from gripper_force.jobs.dataset import label_frames
from gripper_force.jobs.recording.lag import camera_lags_s, load_cell_lag_s
from gripper_force.runtime.log_reader import LogReader
from gripper_force.types import NS_PER_S, Frame, GraspStatus, LoadCellSample, Request, RequestKind
from gripper_force.vision.preprocess import downscale

_SIDE_PX: Final = 48
"""Side of the images that the lag is estimated from."""

_STRONG_SHARE: Final = 0.5
"""Touches below this share of the strongest are left out of the lag: friction shapes their release."""

_GAP_PERIODS: Final = 1.75
"""A gap between frames of more than this many typical gaps is a lost frame and no jitter."""

_SLOW_HZ: Final = 50.0


@dataclass(frozen=True, slots=True)
class TouchLag:
    """Lags between the timestamps of one touch; NaN if unknown. See `gripper_force.jobs.recording.lag`.

    Attributes:
        force_n: Force at the start of the release.
        lag_ms: Time by which the camera's timestamps are late against the load cell's (negative: early).
        camera_ms: Time by which the camera's timestamps are late against the servo's.
        load_cell_ms: Time by which the load cell's timestamps are late against the servo's.
    """

    force_n: float
    lag_ms: float
    camera_ms: float
    load_cell_ms: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Totals:
    """Content of one set or of several.

    Attributes:
        touches: Number of touches.
        frames: Number of frames.
        camera_hz: Frame rate; of several sets the median.
        camera_hz_asked: Configured frame rate; of several sets the median.
        frames_lost: Frames lost.
        samples: Load-cell samples.
        samples_rejected: Samples that are not valid.
        load_cell_hz: Rate of valid samples; of several sets the median.
        peak_n: Largest force at a frame.
        histogram: Number of frames by force, in bins of 1 N named by their lower end.
        lag_ms: Median over strong touches of the time by which the camera's timestamps are late against the
            load cell's (negative: early); None if unknown.
        lag_spread_ms: Half the span of the middle 68 % of these; None for fewer than two touches.
        camera_lag_ms: Median time by which the camera's timestamps are late against the servo's.
        load_cell_lag_ms: Median time by which the load cell's timestamps are late against the servo's.
    """

    touches: int
    frames: int
    camera_hz: float
    camera_hz_asked: float
    frames_lost: int
    samples: int
    samples_rejected: int
    load_cell_hz: float
    peak_n: float
    histogram: dict[int, int]
    lag_ms: float | None
    lag_spread_ms: float | None
    camera_lag_ms: float | None
    load_cell_lag_ms: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class SetSummary(Totals):
    """Content of one set.

    Attributes:
        log: The log.
        object: The object touched.
        set: Name of the set.
        lags: Lags of each touch.
    """

    log: Path
    object: str
    set: str
    lags: list[TouchLag]


@dataclass(frozen=True, slots=True)
class RecordingSummary:
    """Content of recorded sets.

    Attributes:
        sets: Each set.
        overall: All sets together.
        warnings: Problems of the recording, one sentence each.
    """

    sets: list[SetSummary]
    overall: Totals
    warnings: list[str]


def summarise_recording(paths: Sequence[Path]) -> RecordingSummary:
    """Summarises recorded sets and measures the lag between camera and load cell.

    Args:
        paths: Logs of the sets.

    Raises:
        LogError: A log can't be read.
        DataError: A log holds no frames.
    """
    sets = [_summary(path) for path in paths]
    overall = Totals(
        touches=sum(one.touches for one in sets),
        frames=sum(one.frames for one in sets),
        camera_hz=float(np.median([one.camera_hz for one in sets])),
        camera_hz_asked=float(np.median([one.camera_hz_asked for one in sets])),
        frames_lost=sum(one.frames_lost for one in sets),
        samples=sum(one.samples for one in sets),
        samples_rejected=sum(one.samples_rejected for one in sets),
        load_cell_hz=float(np.median([one.load_cell_hz for one in sets])),
        peak_n=max(one.peak_n for one in sets),
        histogram=_merged(one.histogram for one in sets),
        **_lag_medians([lag for one in sets for lag in one.lags]),
    )
    return RecordingSummary(sets, overall, _warnings(overall))


class _LagMedians(TypedDict):
    """The fields of `Totals` about lag."""

    lag_ms: float | None
    lag_spread_ms: float | None
    camera_lag_ms: float | None
    load_cell_lag_ms: float | None


def _summary(path: Path) -> SetSummary:
    reader = LogReader(path)
    config = config_from_text(reader.config, str(path))
    records: dict[type, list[Any]] = defaultdict(list)
    images = []
    for record in reader.records(Frame, LoadCellSample, GraspStatus, Request):
        if isinstance(record, Frame):
            images.append(downscale(record.gray, config.vision.region, _SIDE_PX))
            records[Frame].append((record.t_ns, record.seq))
        else:
            records[type(record)].append(record)
    if len(images) < 2:
        raise DataError(f"{path} holds no camera frames; delete it, and record the set again")
    frame_ns, seq = np.array(records[Frame], np.int64).T
    samples = sorted(records[LoadCellSample], key=lambda sample: sample.t_ns)
    valid_ns = np.array([sample.t_ns for sample in samples if sample.valid], np.int64)
    forces_n, labelled = label_frames(frame_ns, samples, 0)
    release_ns = releases_ns(records[Request])
    lags = touch_lags(frame_ns, np.stack(images), samples, records[GraspStatus], release_ns)
    return SetSummary(
        log=path,
        object=config.object,
        set=reader.metadata.get("set", path.stem),
        touches=len(release_ns),
        frames=len(images),
        camera_hz=_rate_hz(frame_ns),
        camera_hz_asked=config.camera.rate_hz,
        frames_lost=_lost(frame_ns, seq),
        samples=len(samples),
        samples_rejected=len(samples) - len(valid_ns),
        load_cell_hz=_rate_hz(valid_ns),
        peak_n=float(forces_n.max()),
        histogram=_histogram(forces_n[labelled]),
        lags=lags,
        **_lag_medians(lags),
    )


def touch_lags(
    frame_ns: npt.NDArray[np.int64],
    images: npt.NDArray[np.uint8],
    samples: list[LoadCellSample],
    statuses: list[GraspStatus],
    release_ns: list[int],
) -> list[TouchLag]:
    """Returns the lags of each touch.

    Args:
        frame_ns: Timestamps of the frames, (N,).
        images: The frames, made small, (N, H, W).
        samples: Load-cell samples by time.
        statuses: A status per cycle.
        release_ns: Start of the release of each touch.
    """
    valid = [sample for sample in samples if sample.valid]
    cell_s = np.array([sample.t_ns for sample in valid]) / NS_PER_S
    force_n = np.array([sample.force_n for sample in valid])
    servo_s = np.array([status.t_ns for status in statuses]) / NS_PER_S
    width_m = np.array([status.width_m for status in statuses])
    releases_s = (np.array(release_ns) / NS_PER_S).tolist()
    cameras_s = camera_lags_s(frame_ns / NS_PER_S, images, servo_s, width_m, releases_s)
    lags = []
    for release_s, camera_s in zip(releases_s, cameras_s.tolist(), strict=True):
        load_cell_s = load_cell_lag_s(cell_s, force_n, servo_s, width_m, release_s)
        release_n = float(np.interp(release_s, cell_s, force_n))
        lags.append(TouchLag(release_n, 1e3 * (camera_s - load_cell_s), 1e3 * camera_s, 1e3 * load_cell_s))
    return lags


def releases_ns(requests: list[Request]) -> list[int]:
    """Returns the release time of each touch, without the final release that only opens the jaws."""
    kinds = [request.kind for request in requests]
    pairs = zip([RequestKind.RELEASE, *kinds], requests, strict=False)
    return [
        request.t_ns
        for before, request in pairs
        if before == RequestKind.GRASP and request.kind == RequestKind.RELEASE
    ]


def _lag_medians(lags: list[TouchLag]) -> _LagMedians:
    strongest_n = max((lag.force_n for lag in lags), default=0.0)
    strong = [lag for lag in lags if lag.force_n >= _STRONG_SHARE * strongest_n]
    known = [lag for lag in strong if np.isfinite(lag.lag_ms)]
    if not known:
        return {"lag_ms": None, "lag_spread_ms": None, "camera_lag_ms": None, "load_cell_lag_ms": None}
    low_ms, high_ms = np.percentile([lag.lag_ms for lag in known], [16, 84])
    return {
        "lag_ms": float(np.median([lag.lag_ms for lag in known])),
        "lag_spread_ms": float(high_ms - low_ms) / 2 if len(known) > 1 else None,
        "camera_lag_ms": float(np.median([lag.camera_ms for lag in known])),
        "load_cell_lag_ms": float(np.median([lag.load_cell_ms for lag in known])),
    }


def _warnings(overall: Totals) -> list[str]:
    warnings = []
    if overall.camera_hz < 0.95 * overall.camera_hz_asked:
        warnings.append(
            f"the camera gave {overall.camera_hz:.1f} frames/s instead of {overall.camera_hz_asked:g}; check "
            "exposure, cable and camera.rate_hz"
        )
    if overall.frames_lost:
        total = overall.frames + overall.frames_lost
        warnings.append(f"{overall.frames_lost} of {total} frames were lost")
    if overall.load_cell_hz < _SLOW_HZ:
        warnings.append(
            f"the load cell gave {overall.load_cell_hz:.0f} valid samples/s; below {_SLOW_HZ:g} the lag is "
            "unreliable, and forces at frames are interpolated"
        )
    half_frame_ms = 500 / overall.camera_hz
    lag_ms = overall.lag_ms
    if lag_ms is None:
        warnings.append("the lag between camera and load cell is unknown: no touch was clear enough")
    elif abs(lag_ms) > half_frame_ms:
        warnings.append(
            f"the camera's timestamps are {abs(lag_ms):.0f} ms {'late' if lag_ms > 0 else 'early'} against "
            f"the load cell's, more than half a frame ({half_frame_ms:.0f} ms): forces are assigned to wrong "
            "frames"
        )
    return warnings


def _histogram(forces_n: npt.NDArray[np.float32]) -> dict[int, int]:
    """Counts frames by force, in bins of 1 N named by their lower end."""
    whole, counts = np.unique(np.floor(forces_n).astype(int), return_counts=True)
    return {int(n): int(count) for n, count in zip(whole, counts, strict=True)}


def _merged(histograms: Iterable[dict[int, int]]) -> dict[int, int]:
    total: dict[int, int] = defaultdict(int)
    for histogram in histograms:
        for n, count in histogram.items():
            total[n] += count
    return dict(sorted(total.items()))


def _rate_hz(t_ns: npt.NDArray[np.int64]) -> float:
    return (len(t_ns) - 1) * NS_PER_S / float(t_ns[-1] - t_ns[0]) if len(t_ns) > 1 else 0.0


def _lost(t_ns: npt.NDArray[np.int64], seq: npt.NDArray[np.int64]) -> int:
    """Counts lost frames by their numbers and by gaps in time, because not every driver numbers them."""
    gaps_ns = np.diff(t_ns)
    period_ns = gaps_ns[gaps_ns < _GAP_PERIODS * np.median(gaps_ns)].mean()
    return int(max((np.diff(seq) - 1).sum(), (np.rint(gaps_ns / period_ns) - 1).clip(0).sum()))
