"""Training and test clips from logs."""

import hashlib
import json
import math
from array import array
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise, starmap
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

import numpy as np
import numpy.typing as npt

from gripper_force.config import Config, config_from_text
from gripper_force.control.transmission import Transmission
from gripper_force.errors import DataError
from gripper_force.jobs.processes import process_pool
from gripper_force.jobs.renewals import RenewalFinder
from gripper_force.progress import Progress, no_progress
from gripper_force.runtime.log_reader import LogReader
from gripper_force.schema import Tree, as_path
from gripper_force.types import NS_PER_MS, Event, Frame, Gray, LoadCellSample, Record, Request, ServoState

if TYPE_CHECKING:  # labels need no OpenCV
    from gripper_force.vision.header import Header
    from gripper_force.vision.preprocess import Preprocess, Region

CONTACT_N: Final = 0.25
"""Measured force above which a frame counts as in contact."""

CLIP_RECORDS: Final = (Frame, LoadCellSample, ServoState, Request, Event)
"""Types of the records that make a clip."""

_VIEW_KEYS: Final = (
    "camera_offset_m",
    "camera_target_offset_m",
    "camera_fovy_deg",
    "camera_from_grip_m",
    "camera_aim_m",
    "camera_roll_deg",
    "camera_blur_px",
    "pad_half_m",
    "finger_half_m",
    "pad_rgb",
    "finger_rgb",
    "background",
)
"""Keys of a simulated scene that tell one rig from another."""

NEAR_NS: Final = 50 * NS_PER_MS
"""Largest time from a frame to a valid load-cell sample; other frames have no label."""


@dataclass(frozen=True, eq=False)
class Clip:
    """One recording.

    Attributes:
        frames: Cropped and downscaled frames, (T, S, S) uint8.
        forces_n: Load-cell force at each frame, (T,) float32; 0 if not valid.
        valid: Mask of the frames with a label, (T,) bool.
        name: File name of the log without its suffix.
        object: The object.
        set: Name of the set. A split keeps a set on one side, such as all light levels of one simulation.
        stiffness: Stiffness of a simulated object over the nominal one of its kind; NaN if unknown.
        indentation_m: Travel of the jaws since first contact at each frame, (T,) float32; NaN if unknown.
        rig: Settings of camera and gripper, see `gripper_force.config.Config.rig_settings`; empty if unknown.
        view: Camera and jaws of a simulated scene, as text; empty for a real one.
        renewals: Numbers of the frames before which the run took a new reference, rising; see `parts`.
    """

    frames: Gray
    forces_n: npt.NDArray[np.float32]
    valid: npt.NDArray[np.bool_]
    name: str
    object: str
    set: str
    stiffness: float = float("nan")
    indentation_m: npt.NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    rig: Tree = field(default_factory=dict)
    view: str = ""
    renewals: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        """Makes the indentation unknown where none is given."""
        if not len(self.indentation_m):
            object.__setattr__(self, "indentation_m", np.full(len(self.frames), np.nan, np.float32))

    def labelled(self, lead_in: int) -> npt.NDArray[np.bool_]:
        """Returns the mask of the frames with a label after the first ``lead_in``, which no run estimates; (T,)."""
        return self.valid & (np.arange(len(self.frames)) >= lead_in)

    def parts(self, preprocess: "Preprocess") -> "list[Clip]":
        """Returns the parts that the run compared with a reference each, which begin with the frames of theirs."""
        if not self.renewals:
            return [self]
        lead = _reference_count(preprocess)
        parts = []
        for begin, end in pairwise((0, *self.renewals, len(self.frames))):
            at = slice(max(begin - lead, 0), end)
            parts.append(
                replace(
                    self,
                    frames=self.frames[at],
                    forces_n=self.forces_n[at],
                    valid=self.valid[at],
                    indentation_m=self.indentation_m[at],
                    renewals=(),
                )
            )
        return parts

    @property
    def nominal_n(self) -> npt.NDArray[np.float32]:
        """Forces with the nominal stiffness of the object's kind, (T,); as measured if stiffness is unknown."""
        return self.forces_n if math.isnan(self.stiffness) else self.forces_n / np.float32(self.stiffness)


def known_rig(logged: Config) -> Tree:
    """Returns the settings of a log's camera and gripper; empty for an imported recording, whose are not known."""
    return {} if logged.gripper.nm_per_a is None else logged.rig_settings()


def other_rig(header: "Header", logged: Config, *, is_profiled: bool) -> list[str]:
    """Returns the settings of camera and gripper in which a log differs from the one rig that a network learned from.

    Args:
        header: Header of the network.
        logged: Configuration of the log, with the region that is used now.
        is_profiled: True if an object profile is used, whose rig is checked instead.
    """
    return [] if is_profiled else header.mismatches(known_rig(logged))


def find_logs(source: str | Path | Sequence[str | Path]) -> list[Path]:
    """Returns the given logs in their order, each once, with each folder replaced by its logs, sorted by path.

    Args:
        source: Logs, and folders that are searched for ``*.mcap``; one or several.

    Raises:
        DataError: There are no logs, or none in a folder.
        ConfigError: One is no path.
    """
    sources = source if isinstance(source, Iterable) and not isinstance(source, str) else [source]
    logs_by_path: dict[Path, Path] = {}
    for path in (as_path(one, "a log", "name a file or a folder") for one in sources):
        logs = sorted(p for p in path.rglob("*.mcap") if not p.is_dir()) if path.is_dir() else [path]
        if not logs:
            raise DataError(f"no logs (*.mcap) in {path}; record, simulate or import some")
        for log in logs:
            logs_by_path.setdefault(log.resolve(), log)
    if not logs_by_path:
        raise DataError("no logs are given; name some, or a folder of them")
    return list(logs_by_path.values())


def load_clips(
    source: str | Path | Sequence[str | Path],
    preprocess: "Preprocess",
    region: "Region | None" = None,
    workers: int = 1,
    progress: Progress = no_progress,
) -> list[Clip]:
    """Reads logs in parallel processes.

    Args:
        source: See `find_logs`.
        preprocess: Determines the size that frames are downscaled to.
        region: Region of interest in pixels; None for the one in each log's configuration.
        workers: Number of processes; 1 reads in this process.
        progress: Called after each log.

    Returns:
        One clip for each reference that a run took, in the order of `find_logs`: mostly one per log.

    Raises:
        DataError: There are no logs, or a log has no frames or no labels.
        LogError: A log can't be read.
    """
    paths = find_logs(source)
    read = partial(load_clip, preprocess=preprocess, region=region)
    clips = []
    # Starting a process takes seconds.
    with nullcontext() if workers == 1 else process_pool(workers) as pool:
        for clip in map(read, paths) if pool is None else pool.map(read, paths):
            clips += [part for part in clip.parts(preprocess) if part.valid.any()]
            progress(f"read {clip.name}")
    return clips


def starts_in_contact(forces_n: npt.NDArray[np.floating], preprocess: "Preprocess") -> bool:
    """Returns True if one of a recording's reference frames shows contact, so that they are no reference.

    Args:
        forces_n: Load-cell force at each frame, (T,); 0 without a label.
        preprocess: Preparation of frames; it may use no reference.
    """
    return preprocess.reference and bool((forces_n[: preprocess.reference_frames] > CONTACT_N).any())


def without_contact_starts(clips: Sequence[Clip], preprocess: "Preprocess") -> list[Clip]:
    """Returns the clips that do not start in contact; all clips if no reference is subtracted.

    Raises:
        DataError: No clip is left.
    """
    usable = [clip for clip in clips if not starts_in_contact(clip.forces_n, preprocess)]
    if clips and not usable:
        raise DataError(
            f"all {len(clips)} recordings start in contact (more than {CONTACT_N} N), so their first frames are no "
            "reference; record them again from open jaws, or add --include-contact-starts"
        )
    return usable


def split_by(
    clips: Sequence[Clip], key: Literal["object", "set"], fraction: float, seed: int = 0
) -> tuple[list[Clip], list[Clip]]:
    """Splits clips at random by whole objects or sets, so that training and held-out clips share none.

    Args:
        clips: Clips to split.
        key: Unit that is kept together. Sets are drawn per object, so that both sides hold every object with
            at least two sets.
        fraction: Share of objects or sets to hold out: at least one, and never all.
        seed: Seed of the draw.

    Returns:
        The training clips and the held-out clips.

    Raises:
        DataError: There are fewer than two objects or sets.
    """
    rng = np.random.default_rng(seed)
    pools = (
        [clips] if key == "object" else [[c for c in clips if c.object == o] for o in _names(clips, "object")]
    )
    held: set[tuple[str, str]] = set()  # object, and object or set: sets of two objects may have one name
    for pool in pools:
        names = _names(pool, key)
        count = min(max(1, round(fraction * len(names))), len(names) - 1)
        drawn = set(rng.choice(names, count, replace=False)) if names else set()
        held.update((clip.object, getattr(clip, key)) for clip in pool if getattr(clip, key) in drawn)
    if not held:
        raise DataError(f"a split by {key} needs at least two, got {_names(clips, key)}; add logs")
    is_held = [(clip.object, getattr(clip, key)) in held for clip in clips]
    return [c for c, h in zip(clips, is_held, strict=True) if not h], [
        c for c, h in zip(clips, is_held, strict=True) if h
    ]


def label_mask(clips: Sequence[Clip], lead_in: int) -> npt.NDArray[np.bool_]:
    """Returns the mask of the frames with a label after each clip's first ``lead_in``, over all clips, (N,).

    Raises:
        DataError: There is no such frame.
    """
    if not any(clip.valid.any() for clip in clips):
        raise DataError("no frame has a label; use recordings with a load cell")
    valid = np.concatenate([clip.labelled(lead_in) for clip in clips])
    if not valid.any():
        raise DataError(
            f"no frame after a recording's first {lead_in} has a load-cell force; use longer recordings"
        )
    return valid


def check_size(clips: Iterable[Clip], preprocess: "Preprocess") -> None:
    """Raises `DataError` if a clip's frames do not have the size of the networks' input."""
    for clip in clips:
        if clip.frames.shape[1] != preprocess.size:
            raise DataError(
                f"{clip.name} has frames of {clip.frames.shape[1]} px, the network needs {preprocess.size}; "
                "load the clips with this network's preprocess"
            )


def digest(clips: Iterable[Clip]) -> str:
    """Returns the SHA-256 of all frames and labels."""
    sha = hashlib.sha256()
    for clip in clips:
        for part in (clip.frames, clip.forces_n, clip.valid):
            sha.update(np.ascontiguousarray(part).data)
    return sha.hexdigest()


def label_frames(
    frame_t_ns: npt.NDArray[np.int64],
    samples: Sequence[LoadCellSample],
    exposure_ns: int,
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    """Returns the load-cell force at each frame.

    It is the mean of the valid samples within the exposure if there are two or more, else the linear
    interpolation at its middle. A shift by one frame would add an error of 0.06 N.

    Args:
        frame_t_ns: Middle of each exposure, (T,).
        samples: Load-cell samples by rising time.
        exposure_ns: Exposure time; 0 if unknown.

    Returns:
        Forces in N, (T,) float32, 0 without a label, and the mask of frames with a label, (T,) bool.
    """
    series = CellSeries()
    for sample in samples:
        series.add(sample)
    return label_at(frame_t_ns, *series.sorted(), exposure_ns)


def label_at(
    frame_t_ns: npt.NDArray[np.int64],
    t_ns: npt.NDArray[np.int64],
    force_n: npt.NDArray[np.float64],
    exposure_ns: int,
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    """Returns what `label_frames` does, for valid samples by rising time: ``t_ns`` and ``force_n``, (N,)."""
    if not len(t_ns):
        return np.zeros(len(frame_t_ns), np.float32), np.zeros(len(frame_t_ns), np.bool_)
    labels = np.interp(frame_t_ns, t_ns, force_n)
    cumulative = np.concatenate([[0.0], np.cumsum(force_n)])
    first = np.searchsorted(t_ns, frame_t_ns - exposure_ns // 2, "left")
    last = np.searchsorted(t_ns, frame_t_ns + exposure_ns // 2, "right")
    several = last - first >= 2
    labels[several] = (cumulative[last] - cumulative[first])[several] / (last - first)[several]
    after = np.searchsorted(t_ns, frame_t_ns).clip(0, len(t_ns) - 1)
    distance = np.minimum(np.abs(t_ns[after] - frame_t_ns), np.abs(t_ns[(after - 1).clip(0)] - frame_t_ns))
    valid = distance <= NEAR_NS
    return np.where(valid, labels, 0.0).astype(np.float32), valid


def indentations(
    frame_t_ns: npt.NDArray[np.int64],
    forces_n: npt.NDArray[np.float32],
    servo_t_ns: npt.NDArray[np.int64],
    position_rad: Sequence[float],
    width_m: Callable[[float], float],
) -> npt.NDArray[np.float32]:
    """Returns the travel of the jaws at each frame since the first frame in contact; 0 while they are wider.

    Args:
        frame_t_ns: Middle of each exposure, (T,).
        forces_n: Load-cell force at each frame, (T,); 0 without a label.
        servo_t_ns: Times of the servo states, rising, (N,).
        position_rad: Positions of the servo in them, (N,).
        width_m: Maps the servo's angle to the distance between the jaws.

    Returns:
        Travel in m, (T,) float32; NaN without servo states around a frame, or if there is no contact.
    """
    contacts = np.flatnonzero(forces_n > CONTACT_N)
    if not len(servo_t_ns) or not len(contacts):
        return np.full(len(frame_t_ns), np.nan, np.float32)
    each_m = [width_m(position) for position in position_rad]
    widths_m = np.interp(frame_t_ns, servo_t_ns, each_m, left=np.nan, right=np.nan)
    travel_m: npt.NDArray[np.float64] = np.maximum(0.0, widths_m[contacts[0]] - widths_m)
    return travel_m.astype(np.float32)


def load_clip(path: Path, preprocess: "Preprocess", region: "Region | None") -> Clip:
    """Reads one log as one clip; see `load_clips`."""
    reader = LogReader(path)
    config = config_from_text(reader.config, str(path))
    return read_clip(reader, config, reader.records(*CLIP_RECORDS), preprocess, region)


def read_clip(
    reader: LogReader,
    config: Config,
    records: Iterable[Record],
    preprocess: "Preprocess",
    region: "Region | None" = None,
) -> Clip:
    """Makes a clip from a log's records, for callers that also use records of other types.

    Args:
        reader: The log.
        config: Its configuration.
        records: Its records. Those of other types than `CLIP_RECORDS` are ignored.
        preprocess: Determines the size that frames are downscaled to.
        region: Region of interest in pixels; None for the one in the configuration.

    Raises:
        DataError: There are no frames or no labels.
        LogError: The log can't be read.
    """
    streamed = StreamedClip(reader, config, records, preprocess, region)
    small = list(streamed.frames())
    return streamed.clip(np.stack(small) if small else streamed.no_images)


class StreamedClip:
    """A clip that is read frame by frame, so that no frame need be kept. Arguments are those of `read_clip`."""

    def __init__(
        self,
        reader: LogReader,
        config: Config,
        records: Iterable[Record],
        preprocess: "Preprocess",
        region: "Region | None" = None,
    ) -> None:
        self._reader, self._config, self._records = reader, config, records
        self._region, self._preprocess = region or config.vision.region, preprocess
        self._t_ns = array("q")
        self._samples = CellSeries()
        self._servo_ns, self._position_rad = array("q"), array("d")
        self._renewals: list[int] = []

    def parts(self) -> Iterator[tuple[int, Iterator[Gray]]]:
        """Yields the frames of each of `Clip.parts`, and how many of them are also in the part before.

        Each part must be used up before the next one. Raises as `frames`.
        """
        frames = self.frames()
        last: deque[Gray] = deque(maxlen=_reference_count(self._preprocess))
        following = next(frames, None)

        def part(count: int) -> Iterator[Gray]:
            nonlocal following
            yield from tuple(last)
            while following is not None and len(self._renewals) == count:
                last.append(following)
                yield following
                following = next(frames, None)

        while following is not None:
            yield len(last), part(len(self._renewals))

    def frames(self) -> Iterator[Gray]:
        """Yields the frames, cropped and downscaled, (S, S) uint8, once.

        Raises:
            LogError: The log can't be read.
        """
        from gripper_force.vision.preprocess import downscale

        finder = RenewalFinder()
        for record in self._records:
            is_renewed = finder.is_renewed(record)
            if isinstance(record, Frame):
                # An earlier request changes nothing: the reference is still being collected.
                if is_renewed and len(self._t_ns) >= max(_reference_count(self._preprocess), 1):
                    self._renewals.append(len(self._t_ns))
                self._t_ns.append(record.t_ns)
                yield downscale(record.gray, self._region, self._preprocess.size)
            elif isinstance(record, LoadCellSample):
                self._samples.add(record)
            elif isinstance(record, ServoState):
                self._servo_ns.append(record.t_ns)
                self._position_rad.append(record.position_rad)

    @property
    def no_images(self) -> Gray:
        """Frames without pixels, (T, 0, 0), for a clip whose images are not needed any more."""
        return np.empty((len(self._t_ns), 0, 0), np.uint8)

    def clip(self, frames: Gray) -> Clip:
        """Returns the clip, after the last of its frames.

        Raises:
            DataError: There are no frames or no labels.
        """
        path, metadata, config = self._reader.path, self._reader.metadata, self._config
        if not self._t_ns:
            raise DataError(f"{path} holds no camera frames; remove it from the logs")
        exposure_ns = round(_positive(metadata, "exposure_ms", float, 0.0) * NS_PER_MS)
        frame_t_ns = np.array(self._t_ns)
        forces_n, valid = label_at(frame_t_ns, *self._samples.sorted(), exposure_ns)
        if not valid.any():
            raise DataError(f"{path} holds no valid load-cell sample near any frame; remove it from the logs")
        width_m = Transmission.from_config(config.gripper, servo_nm_per_a=1.0).width_m
        servo_ns = np.array(self._servo_ns)
        parts = starmap(slice, pairwise((0, *self._renewals, len(frame_t_ns))))
        return Clip(
            frames,
            forces_n,
            valid,
            path.stem,
            config.object,
            metadata.get("set", path.stem),
            stiffness_of(metadata),
            np.concatenate(
                [
                    indentations(frame_t_ns[at], forces_n[at], servo_ns, self._position_rad, width_m)
                    for at in parts
                ]
            ),
            known_rig(config),
            _view_of(metadata),
            tuple(self._renewals),
        )


class CellSeries:
    """Times and forces of the load cell's valid samples: 16 bytes each."""

    def __init__(self) -> None:
        self._t_ns, self._force_n = array("q"), array("d")

    def add(self, sample: LoadCellSample) -> None:
        """Takes the next sample; one that is not valid is left out."""
        if sample.valid and math.isfinite(sample.force_n):
            self._t_ns.append(sample.t_ns)
            self._force_n.append(sample.force_n)

    def sorted(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
        """Returns times and forces by rising time, (N,)."""
        t_ns = np.array(self._t_ns)
        order = np.argsort(t_ns, kind="stable")
        return t_ns[order], np.array(self._force_n)[order]


def stiffness_of(metadata: Mapping[str, str]) -> float:
    """Returns a simulated object's stiffness over its kind's nominal one; NaN for real objects.

    Args:
        metadata: Metadata of the log.

    Raises:
        DataError: The metadata hold a scene without a stiffness above 0.
    """
    return _positive(metadata, "scene", lambda scene: float(json.loads(scene)["stiffness"]), float("nan"))


def _view_of(metadata: Mapping[str, str]) -> str:
    """Returns the camera and the jaws of a simulated scene; empty for a real one."""
    scene: Tree = json.loads(metadata["scene"]) if "scene" in metadata else {}
    return json.dumps({key: scene[key] for key in _VIEW_KEYS if key in scene}) if scene else ""


def _positive(metadata: Mapping[str, str], key: str, read: Callable[[str], float], default: float) -> float:
    if key not in metadata:
        return default
    try:
        value = read(metadata[key])
    except (ValueError, LookupError, TypeError, RecursionError):
        value = math.nan
    if not 0 < value < math.inf:
        raise DataError(
            f"metadata {key!r} of a log hold no number above 0: {metadata[key][:80]!r}; record or simulate it again"
        )
    return value


def stiffness_floor_n(forces_n: npt.NDArray[np.floating], stiffness: float) -> npt.NDArray[np.floating]:
    """Returns the error floor: images show travel, but only the nominal stiffness of the object's kind is known.

    Args:
        forces_n: True forces, (N,).
        stiffness: The object's stiffness over the nominal one of its kind.

    Returns:
        Absolute errors in N, (N,).
    """
    floor_n: npt.NDArray[np.floating] = np.abs(forces_n) * abs(1 - 1 / stiffness)
    return floor_n


def _reference_count(preprocess: "Preprocess") -> int:
    return preprocess.reference_frames if preprocess.reference else 0


def _names(clips: Iterable[Clip], key: str) -> list[str]:
    return sorted({getattr(clip, key) for clip in clips})
