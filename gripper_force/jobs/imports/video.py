"""Import of a video and its table of forces to a log, for replay, training and evaluation.

A recording is a video and a CSV table with the columns ``frame`` (from 0), ``t_s`` and ``force_n``; more
columns are allowed. It is either a folder with one video and one table, or a pair ``X.avi`` and ``X.csv``. The
object is read from a name of the form ``<date>_<object>_<trial>``.
"""

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from gripper_force.config import Config
from gripper_force.errors import DataError
from gripper_force.jobs.imports.force_table import Floats, ForceTable, estimate_tare, read_forces
from gripper_force.jobs.imports.imported_log import load_cell_samples, write_recording
from gripper_force.jobs.recording.lag import force_lag_s
from gripper_force.progress import Progress, no_progress
from gripper_force.spikes import find_spikes
from gripper_force.types import NS_PER_S, Frame, Gray
from gripper_force.vision.preprocess import Region, downscale

VIDEO_SUFFIXES: Final = frozenset({".avi", ".mp4", ".mkv", ".mov"})


@dataclass(frozen=True, slots=True)
class ImportSummary:
    """Result of importing one recording.

    Attributes:
        log: The log written.
        object: The object.
        frames: Frames in the log.
        samples: Load-cell samples in the log, including rejected ones.
        spikes_rejected: Samples marked as not valid.
        tare_n: Offset subtracted from every sample; 0 without a reliable tare.
        tare_note: Reason why no tare was subtracted; empty if it was.
        force_lag_s: Lag of the forces behind the images, which was removed; 0 if no lag is certain, see
            `recording.lag.force_lag_s`.
        frames_without_force: Frames without a row in the table.
        forces_without_frame: Rows without a frame in the video.
        starts_in_contact: True if the first frames show contact, so that they are no reference.
    """

    log: Path
    object: str
    frames: int
    samples: int
    spikes_rejected: int
    tare_n: float
    tare_note: str
    force_lag_s: float
    frames_without_force: int
    forces_without_frame: int
    starts_in_contact: bool


def import_folder(
    folder: Path,
    out: Path,
    *,
    region: Region | None = None,
    align: bool = True,
    progress: Progress = no_progress,
) -> list[ImportSummary]:
    """Imports every recording of a folder that has no log yet into ``out/<recording>.mcap``.

    Args:
        folder: Folder with recordings, see above.
        out: Folder for the logs.
        region: As for `import_video`.
        align: As for `import_video`.
        progress: Called after each recording.

    Returns:
        Summaries of the new logs.

    Raises:
        DataError: There is no recording, or one lacks its table or is not usable.
        LogError: A log can't be written.
    """
    summaries = []
    for name, video, forces in find_recordings(folder):
        log = out / f"{name}.mcap"
        if not log.exists():
            summaries.append(import_video(video, forces, log, name=name, region=region, align=align))
        progress(name)
    return summaries


def import_video(
    video: Path,
    forces: Path,
    out: Path,
    *,
    name: str | None = None,
    object_name: str | None = None,
    region: Region | None = None,
    size: int = 128,
    align: bool = True,
) -> ImportSummary:
    """Writes one recording as a log of gray frames and load-cell samples.

    Spikes and impossible values stay in the log, marked as not valid. The log also holds the readings before
    tare, and the table as an attachment. A certain lag between forces and images is removed and noted in the
    log's metadata.

    Args:
        video: The video.
        forces: The table, see `read_forces`.
        out: The log to write.
        name: Name of the recording, ``<date>_<object>_<trial>``; by default that of the video.
        object_name: The object; by default from the name.
        region: Region of the frame to keep in pixels: left, top, width, height; None for the whole frame.
        size: Side of the logged frames in pixels.
        align: Remove a certain lag between forces and images.

    Raises:
        DataError: The video or the table is missing or not usable.
        ConfigError: The region is not within the frame.
        LogError: The log exists already or can't be written.
    """
    name = name or video.stem
    object_name = object_name or object_of(name)
    table = read_forces(forces)
    tare_n, tare_note = estimate_tare(table.t_s, table.force_n)
    gray, rate_hz = _read_video(video, region, size)
    frames_s = _frame_times_s(table, len(gray), rate_hz)
    lag_s = 0.0
    if align:
        good = ~find_spikes(table.force_n - tare_n)
        lag_s = force_lag_s(frames_s, np.stack(gray), table.t_s[good], table.force_n[good])
    frames_s, forces_s = frames_s + max(lag_s, 0.0), table.t_s + max(-lag_s, 0.0)
    # A table may begin after the video does; a log has no time before 0.
    start_s = min(0.0, frames_s[0], forces_s[0])
    frames_ns = [_ns(t_s) for t_s in frames_s - start_s]
    frames = [Frame(t, t, i, image) for i, (t, image) in enumerate(zip(frames_ns, gray, strict=True))]
    forces_ns = [_ns(t_s) for t_s in forces_s - start_s]
    samples = load_cell_samples(forces_ns, table.force_n, tare_n)
    metadata = {
        "object": object_name,
        "set": re.sub(r"_\d+$", "", name),
        "source": name,
        "tare_n": f"{tare_n:.5f}",
        "tare_note": tare_note,
        "force_lag_s": f"{lag_s:.4f}",
    }
    spikes, in_contact = write_recording(out, Config(object=object_name), metadata, frames, samples, forces)
    with_row = int(np.isin(np.arange(len(frames)), table.frame).sum())
    return ImportSummary(
        log=out,
        object=object_name,
        frames=len(frames),
        samples=len(samples),
        spikes_rejected=spikes,
        tare_n=tare_n,
        tare_note=tare_note,
        force_lag_s=lag_s,
        frames_without_force=len(frames) - with_row,
        forces_without_frame=len(samples) - with_row,
        starts_in_contact=in_contact,
    )


def object_of(name: str) -> str:
    """Returns the object in a recording's name: ``2023-12-16_foam_brick_2`` is a ``foam_brick``."""
    match = re.fullmatch(r"(?:\d{4}-?\d{2}-?\d{2}_)?(.+?)(?:_\d+)?", name)
    return match[1] if match else name


def find_recordings(folder: Path) -> list[tuple[str, Path, Path]]:
    """Returns name, video and table of each recording of a folder, by name.

    Raises:
        DataError: There is no recording, or one lacks its table.
    """
    recordings = list(_recordings(folder))
    if not recordings:
        raise DataError(
            f"{folder} holds no recordings; it needs X.avi with X.csv, or folders with one of each"
        )
    return recordings


def _recordings(folder: Path) -> Iterator[tuple[str, Path, Path]]:
    if not folder.is_dir():
        raise DataError(f"{folder} is not a folder; check the path")
    for entry in sorted(folder.iterdir()):
        if entry.is_dir():
            videos = [path for path in sorted(entry.iterdir()) if path.suffix.lower() in VIDEO_SUFFIXES]
            tables = sorted(entry.glob("*.csv"))
            if len(videos) == 1 and len(tables) == 1:
                yield entry.name, videos[0], tables[0]
            elif videos or tables:
                raise DataError(
                    f"{entry} holds {len(videos)} videos and {len(tables)} .csv tables; it needs one of each"
                )
        elif entry.suffix.lower() in VIDEO_SUFFIXES:
            table = entry.with_suffix(".csv")
            if not table.is_file():
                raise DataError(f"{entry} has no table of forces; put {table.name} next to it")
            yield entry.stem, entry, table


def _read_video(video: Path, region: Region | None, size: int) -> tuple[list[Gray], float]:
    """Reads all frames, (size, size) uint8 each, and the frame rate."""
    if not video.is_file():
        raise DataError(f"no video {video}; check the path")
    frames: list[Gray] = []
    capture = cv2.VideoCapture(str(video))
    try:
        rate_hz = float(capture.get(cv2.CAP_PROP_FPS))
        while (read := capture.read())[0]:
            gray = np.asarray(cv2.cvtColor(read[1], cv2.COLOR_BGR2GRAY), np.uint8)  # (H, W)
            frames.append(downscale(gray, region, size))
    finally:
        capture.release()
    if not frames or not 0 < rate_hz < math.inf:
        raise DataError(
            f"{video} has no frame that can be decoded, or no frame rate; check that it is a video"
        )
    return frames, rate_hz


def _frame_times_s(table: ForceTable, frames: int, rate_hz: float) -> Floats:
    """Returns the times of all frames: from the table, interpolated between its rows, else by the frame rate."""
    index = np.arange(frames)
    t_s = np.interp(index, table.frame, table.t_s)
    t_s += np.minimum(index - table.frame[0], 0) / rate_hz + np.maximum(index - table.frame[-1], 0) / rate_hz
    return np.asarray(t_s, np.float64)


def _ns(t_s: float) -> int:
    return round(t_s * NS_PER_S)
