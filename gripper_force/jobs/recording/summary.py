"""What is in recorded sets: frames, forces, losses, and how far the clocks of camera and load cell agree."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from gripper_force.config import config_from_text
from gripper_force.errors import DataError
from gripper_force.jobs.dataset import label_frames
from gripper_force.jobs.recording.lag import camera_lags_s, load_cell_lag_s
from gripper_force.runtime.log import LogReader
from gripper_force.types import NS_PER_S, Frame, GraspStatus, LoadCellSample, Request, RequestKind
from gripper_force.vision.preprocess import downscale

_SMALL_PX: Final = 48
"""Side of the pictures that the lag is found from."""

_STRONG: Final = 0.5
"""Touches of less than this share of the strongest tell little: friction shapes how they let go."""

_HOLE: Final = 1.75
"""A gap between frames of so many times the usual one is no jitter."""

_SLOW_HZ: Final = 50.0

Summary = dict[str, Any]


@dataclass(frozen=True, slots=True)
class TouchLag:
    """Lags between the timestamps of one touch; NaN if unknown. See `gripper_force.jobs.recording.lag`.

    Attributes:
        force_n: Force when the jaws were told to let go.
        lag_ms: Time by which the camera's timestamps are late against the load cell's (negative: early).
        camera_ms: The same against the servo's.
        load_cell_ms: Time by which the load cell's are late against the servo's.
    """

    force_n: float
    lag_ms: float
    camera_ms: float
    load_cell_ms: float


def summarise(paths: Sequence[Path]) -> Summary:
    """What is in recorded sets, and how far the camera's clock agrees with the load cell's.

    Returns:
        ``sets``, a summary of each, ``overall`` with the same figures, and ``warnings``, a sentence each.
        ``lag_ms`` is the median over strong touches of the time by which the camera's timestamps are late
        against the load cell's (negative: early), ``lag_spread_ms`` half of the span of the middle 68 % of
        these. Its parts ``camera_lag_ms`` and ``load_cell_lag_ms`` are against the servo. See
        `gripper_force.jobs.recording.lag`.

    Raises:
        LogError: A log can't be read.
        DataError: A log holds no frames.
    """
    sets = [_summary(path) for path in paths]
    figures = ("frames", "frames_lost", "touches", "samples", "samples_rejected")
    lags = [lag for one in sets for lag in one["lags"]]
    overall: Summary = {name: sum(one[name] for one in sets) for name in figures}
    overall |= {
        name: float(np.median([one[name] for one in sets]))
        for name in ("camera_hz", "camera_hz_asked", "load_cell_hz")
    }
    overall["peak_n"] = max(one["peak_n"] for one in sets)
    overall["histogram"] = _added(one["histogram"] for one in sets)
    overall |= _lag_figures(lags)
    return {"sets": sets, "overall": overall, "warnings": _warnings(overall)}


def _summary(path: Path) -> Summary:
    reader = LogReader(path)
    config = config_from_text(reader.config, str(path))
    records: dict[type, list[Any]] = defaultdict(list)
    images = []
    for record in reader.records(Frame, LoadCellSample, GraspStatus, Request):
        if isinstance(record, Frame):
            images.append(downscale(record.gray, config.vision.region, _SMALL_PX))
            records[Frame].append((record.t_ns, record.seq))
        else:
            records[type(record)].append(record)
    if len(images) < 2:
        raise DataError(f"{path} holds no camera frames; take it away, and record it again")
    frame_ns, seq = np.array(records[Frame], np.int64).T
    cells = sorted(records[LoadCellSample], key=lambda sample: sample.t_ns)
    cell_ns = np.array([sample.t_ns for sample in cells if sample.valid], np.int64)
    forces_n, valid = label_frames(frame_ns, cells, 0)
    let_go_ns = releases_ns(records[Request])
    lags = _lags(frame_ns, np.stack(images), cells, records[GraspStatus], let_go_ns)
    return {
        "log": str(path),
        "object": config.object,
        "set": reader.metadata.get("set", path.stem),
        "touches": len(let_go_ns),
        "frames": len(images),
        "camera_hz": _rate_hz(frame_ns),
        "camera_hz_asked": config.camera.rate_hz,
        "frames_lost": _lost(frame_ns, seq),
        "samples": len(cells),
        "samples_rejected": len(cells) - len(cell_ns),
        "load_cell_hz": _rate_hz(cell_ns),
        "peak_n": float(forces_n.max()),
        "histogram": _histogram(forces_n[valid]),
        "lags": lags,
        **_lag_figures(lags),
    }


def _lags(
    frame_ns: npt.NDArray[np.int64],
    images: npt.NDArray[np.uint8],
    cells: list[LoadCellSample],
    statuses: list[GraspStatus],
    let_go_ns: list[int],
) -> list[TouchLag]:
    good = [sample for sample in cells if sample.valid]
    cell_s = np.array([sample.t_ns for sample in good]) / NS_PER_S
    force_n = np.array([sample.force_n for sample in good])
    servo_s = np.array([status.t_ns for status in statuses]) / NS_PER_S
    width_m = np.array([status.width_m for status in statuses])
    releases_s = (np.array(let_go_ns) / NS_PER_S).tolist()
    cameras_s = camera_lags_s(frame_ns / NS_PER_S, images, servo_s, width_m, releases_s)
    lags = []
    for at_s, camera_s in zip(releases_s, cameras_s.tolist(), strict=True):
        load_cell_s = load_cell_lag_s(cell_s, force_n, servo_s, width_m, at_s)
        at_n = float(np.interp(at_s, cell_s, force_n))
        lags.append(TouchLag(at_n, 1e3 * (camera_s - load_cell_s), 1e3 * camera_s, 1e3 * load_cell_s))
    return lags


def releases_ns(requests: list[Request]) -> list[int]:
    """When each touch was let go; the last release only opens the jaws."""
    kinds = [request.kind for request in requests]
    pairs = zip([RequestKind.RELEASE, *kinds], requests, strict=False)
    return [
        request.t_ns
        for before, request in pairs
        if before == RequestKind.GRASP and request.kind == RequestKind.RELEASE
    ]


def _lag_figures(lags: list[TouchLag]) -> dict[str, float | None]:
    strongest_n = max((lag.force_n for lag in lags), default=0.0)
    strong = [lag for lag in lags if lag.force_n >= _STRONG * strongest_n]
    found = [lag for lag in strong if np.isfinite(lag.lag_ms)]
    if not found:
        return dict.fromkeys(("lag_ms", "lag_spread_ms", "camera_lag_ms", "load_cell_lag_ms"))
    low_ms, high_ms = np.percentile([lag.lag_ms for lag in found], [16, 84])
    return {
        "lag_ms": float(np.median([lag.lag_ms for lag in found])),
        "lag_spread_ms": float(high_ms - low_ms) / 2 if len(found) > 1 else None,
        "camera_lag_ms": float(np.median([lag.camera_ms for lag in found])),
        "load_cell_lag_ms": float(np.median([lag.load_cell_ms for lag in found])),
    }


def _warnings(overall: Summary) -> list[str]:
    warnings = []
    if overall["camera_hz"] < 0.95 * overall["camera_hz_asked"]:
        warnings.append(
            f"the camera gave {overall['camera_hz']:.1f} frames/s where {overall['camera_hz_asked']:g} were "
            "asked for; see to exposure, cable and camera.rate_hz"
        )
    if overall["frames_lost"]:
        warnings.append(f"{overall['frames_lost']} of {overall['frames']} frames were lost")
    if overall["load_cell_hz"] < _SLOW_HZ:
        warnings.append(
            f"the load cell gave {overall['load_cell_hz']:.0f} valid samples/s; below {_SLOW_HZ:g} a lag is "
            "not to be trusted, and frames between two samples get an interpolated force"
        )
    half_frame_ms = 500 / overall["camera_hz"]
    lag_ms = overall["lag_ms"]
    if lag_ms is None:
        warnings.append("no touch was clear enough to tell the lag between camera and load cell")
    elif abs(lag_ms) > half_frame_ms:
        warnings.append(
            f"the camera's timestamps are {abs(lag_ms):.0f} ms {'late' if lag_ms > 0 else 'early'} against "
            f"the load cell's, more than half a frame ({half_frame_ms:.0f} ms): forces go to the wrong frames"
        )
    return warnings


def _histogram(forces_n: npt.NDArray[np.float32]) -> dict[int, int]:
    """Frames by force: n newtons to n + 1."""
    whole, counts = np.unique(np.floor(forces_n).astype(int), return_counts=True)
    return {int(n): int(count) for n, count in zip(whole, counts, strict=True)}


def _added(histograms: Iterator[dict[int, int]]) -> dict[int, int]:
    total: dict[int, int] = defaultdict(int)
    for histogram in histograms:
        for n, count in histogram.items():
            total[n] += count
    return dict(sorted(total.items()))


def _rate_hz(t_ns: npt.NDArray[np.int64]) -> float:
    return (len(t_ns) - 1) * NS_PER_S / float(t_ns[-1] - t_ns[0]) if len(t_ns) > 1 else 0.0


def _lost(t_ns: npt.NDArray[np.int64], seq: npt.NDArray[np.int64]) -> int:
    """By the camera's numbers, or, as not every driver tells them, by holes in time."""
    gaps_ns = np.diff(t_ns)
    period_ns = gaps_ns[gaps_ns < _HOLE * np.median(gaps_ns)].mean()
    return int(max((np.diff(seq) - 1).sum(), (np.rint(gaps_ns / period_ns) - 1).clip(0).sum()))
