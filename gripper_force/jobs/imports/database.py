"""Import of the published database of Shin et al. 2019 to logs.

Its layout, from https://github.com/hyeon-jo/Interaction-force-estimation-based-on-deep-learning: a folder
``<object>_<degrees>_<illumination>`` for each of the 48 environments, with images ``N.jpg`` and a table
``test.txt`` of lines such as ``4,-0.00318538,0.00328883``: number of the image, force in newtons, unused.

*Sets.* The folders do not mark where one of the paper's sets ends. A set is four touches (table 1), so a
folder is cut in the rest after each fourth touch, and where numbers are missing for longer than the network
looks back. For splits each log is a separate set: the paper collected sets "for each environment", so no set
was recorded under two lights. As in the simulated protocol, sets 13 to 15 of each folder are for test.

*Forces* stay as published, so that errors can be compared with the paper's; only spikes are marked as not
valid.

*Damaged data* does not stop the import if the rest is usable. Missing, repeated, unordered and malformed
entries are counted, and the summary names the first of each kind.
"""

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from gripper_force.config import CameraConfig, Config
from gripper_force.errors import DataError
from gripper_force.jobs.dataset import CONTACT_N
from gripper_force.jobs.imports.imported_log import load_cell_samples, write_recording
from gripper_force.jobs.paper_protocol import RATE_HZ, TOUCHES, split_of
from gripper_force.runtime.log_reader import LogReader
from gripper_force.types import NS_PER_S, Frame, Gray
from gripper_force.vision.preprocess import Region, downscale

LUX: Final = {"50": 350, "70": 550, "75": 550, "100": 750}
"""Light levels in lux by the third part of a folder's name. For 550 lux the database's page says 70, and the
authors' code (https://github.com/cxz1418/SSAM_ForcePrediction) 75."""

_MIN_TOUCH_FRAMES: Final = 5
"""Shortest touch, in frames; shorter contact is noise."""

_MIN_REST_FRAMES: Final = 15
"""Frames without contact between two touches, at least; less is a bounce."""

_MAX_MISSING: Final = 20
"""Missing numbers within one log, at most: the network looks back over 20 frames."""

_MAX_FORCE_N: Final = 1000.0
"""Larger values are malformed lines."""

_LINE: Final = re.compile(r"\s*([0-9]{1,9})\s*,\s*([-+.0-9eE]+)\s*,[^,]*")
_FOLDER: Final = re.compile(r"(.+)_([0-9]+)_([0-9]+)")
_IMAGE: Final = re.compile(r"0|[1-9][0-9]{0,8}")

Numbers = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class EnvironmentSummary:
    """Result of importing one environment.

    Attributes:
        folder: Name of the folder.
        object: The object touched.
        degrees: Angle of the press.
        lux: Light level in lux.
        logs: Number of logs.
        kept: Number of these that existed before and were not changed.
        touches: Touches in all sets.
        frames: Frames in the new logs.
        spikes_rejected: Samples marked as not valid in the new logs.
        problems: Problems of the folder, one sentence each.
    """

    folder: str
    object: str
    degrees: int
    lux: int
    logs: int
    kept: int
    touches: int
    frames: int
    spikes_rejected: int
    problems: tuple[str, ...]


def find_environments(folder: Path) -> tuple[list[Path], list[str]]:
    """Finds and checks the environments of a database, before any is imported.

    Returns:
        The folders of the environments, and the names of other entries.

    Raises:
        DataError: There is no environment, one has no table, or an illumination is unknown.
    """
    if not folder.is_dir():
        raise DataError(f"{folder} is not a folder; check the path")
    entries = sorted(folder.iterdir())
    folders = [entry for entry in entries if entry.is_dir() and _FOLDER.fullmatch(entry.name)]
    if not folders:
        raise DataError(
            f"{folder} holds no folder named <object>_<degrees>_<illumination>, such as sponge_0_50; "
            "name the folder that holds these"
        )
    if bare := [entry.name for entry in folders if not (entry / "test.txt").is_file()]:
        raise DataError(
            f"{len(bare)} of {len(folders)} folders in {folder} have no test.txt: {', '.join(bare[:5])}; "
            "download them again, or move them away"
        )
    for entry in folders:
        _environment(entry)
    return folders, [entry.name for entry in entries if entry not in folders]


def import_environment(
    folder: Path, out: Path, *, rate_hz: float = RATE_HZ, region: Region | None = None, size: int = 128
) -> EnvironmentSummary:
    """Imports one environment into logs ``<folder>-<set>.mcap``.

    Existing logs with the same settings are kept, so an interrupted import can be continued.

    Args:
        folder: One of `find_environments`.
        out: Folder of the logs, in ``train`` and ``test`` like those of `paper_protocol.plan_protocol`.
        rate_hz: Frame rate, from which times are computed from the images' numbers.
        region: Region of the images to keep in pixels: left, top, width, height; None for the whole image.
        size: Side of the logged frames in pixels.

    Raises:
        DataError: No line of its table is usable, none of the images in its table exists, or an existing log was made
            with another frame rate, region or size.
        ConfigError: The region is not within an image.
        LogError: A log can't be written.
    """
    object_name, degrees, illumination = _environment(folder)
    forces_n, problems = read_table(folder / "test.txt")
    images = {int(path.stem): path for path in folder.glob("*.jpg") if _IMAGE.fullmatch(path.stem)}
    problems += _unmatched(folder, images, forces_n)
    sets = find_sets(np.array(list(forces_n)), np.array(list(forces_n.values())))
    settings = {"rate_hz": f"{rate_hz:g}", "region": f"{region and list(region)}", "size_px": f"{size}"}
    metadata = {
        "object": object_name,
        "source": folder.name,
        "degrees": str(degrees),
        "illumination": illumination,
        "lux": str(LUX[illumination]),
        **settings,
    }
    config = Config(object=object_name, camera=CameraConfig(rate_hz=rate_hz))
    numbers = np.array(sorted(images.keys() | forces_n.keys()))
    parts = np.split(numbers, np.searchsorted(numbers, [first for first, _ in sets[1:]]))
    damaged: list[str] = []
    empty: list[str] = []
    loaded: list[str] = []
    kept = frame_count = spikes = 0
    for i, (part, (_, touches)) in enumerate(zip(parts, sets, strict=True), start=1):
        log = out / split_of(i) / f"{folder.name}-{i:02d}.mcap"
        if log.exists():
            _check_same(log, settings)
            kept += 1
            continue
        t_ns = {int(n): round(int(n - part[0]) * NS_PER_S / rate_hz) for n in part}
        frames, not_decoded = _read_frames(images, t_ns, region, size)
        damaged += not_decoded
        if not forces_n.keys() & {frame.seq for frame in frames}:
            empty.append(log.stem)
            continue
        labelled = [n for n in t_ns if n in forces_n]
        samples = load_cell_samples([t_ns[n] for n in labelled], np.array([forces_n[n] for n in labelled]))
        own = {"set": log.stem, "split": split_of(i), "touches": str(touches)}
        rejected, in_contact = write_recording(log, config, {**metadata, **own}, frames, samples)
        spikes += rejected
        if in_contact:
            loaded.append(log.stem)
        frame_count += len(frames)
    return EnvironmentSummary(
        folder=folder.name,
        object=object_name,
        degrees=degrees,
        lux=LUX[illumination],
        logs=len(sets) - len(empty),
        kept=kept,
        touches=sum(touches for _, touches in sets),
        frames=frame_count,
        spikes_rejected=spikes,
        problems=(
            *problems,
            *_problem("{} images can't be decoded and were left out", damaged),
            *_problem("{} sets have no image with a force and gave no log", empty),
            *_problem("{} sets start in contact, and train and evaluate leave them out", loaded),
        ),
    )


def _check_same(log: Path, settings: Mapping[str, str]) -> None:
    """Raises `DataError` if an existing log was imported with other settings; version 0.1 wrote only the rate."""
    made = LogReader(log).metadata
    for key, value in settings.items():
        if (old := made.get(key, value)) != value:
            raise DataError(
                f"{log} exists already and was imported with {key} {old}, not {value}; use another folder, or move "
                "that log away"
            )


def _unmatched(folder: Path, images: dict[int, Path], forces_n: dict[int, float]) -> list[str]:
    """Returns a sentence for each kind of image, force or file without a counterpart; raises if all are."""
    if not images.keys() & forces_n.keys():
        raise DataError(
            f"{folder} holds no image that its test.txt names, such as {min(forces_n)}.jpg; download it again"
        )
    others = [p.name for p in folder.iterdir() if p.name != "test.txt" and p not in images.values()]
    return [
        *_problem("{} forces have no image", sorted(forces_n.keys() - images.keys())),
        *_problem("{} files are neither N.jpg nor test.txt and were left out", sorted(others)),
        *_problem("{} images have no force", sorted(images.keys() - forces_n.keys())),
    ]


def _read_frames(
    images: dict[int, Path], t_ns: dict[int, int], region: Region | None, size: int
) -> tuple[list[Frame], list[str]]:
    """Returns the frames of the numbers in ``t_ns``, and the names of images that can't be decoded."""
    frames: list[Frame] = []
    damaged: list[str] = []
    for number in sorted(t_ns.keys() & images.keys()):
        if (gray := _read_image(images[number])) is None:
            damaged.append(images[number].name)
        else:
            frames.append(Frame(t_ns[number], t_ns[number], number, downscale(gray, region, size)))
    return frames, damaged


def read_table(path: Path) -> tuple[dict[int, float], list[str]]:
    """Reads a table ``test.txt``.

    Returns:
        Force in N by number of the image, sorted by number, and a sentence for each kind of problem.

    Raises:
        DataError: The table can't be read, or no line is usable.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"can't read the table of forces {path}: {error}; download it again") from error
    rows: dict[int, set[float]] = {}
    bad: list[str] = []
    unordered: list[str] = []
    repeated: Counter[int] = Counter()
    last = -1
    for i, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        if (row := _row(line)) is None:
            bad.append(f"line {i}, {line[:40]!r}")
            continue
        number, force_n = row
        if number in rows:
            repeated[number] += 1
        elif number < last:
            unordered.append(f"line {i}, number {number} after {last}")
        rows.setdefault(number, set()).add(force_n)
        last = number
    forces_n = {number: min(rows[number]) for number in sorted(rows) if len(rows[number]) == 1}
    if not forces_n:
        raise DataError(f"{path} has no usable line; it needs lines like 4,-0.0032,0.0033")
    conflicting = [number for number in rows if number not in forces_n]
    return forces_n, [
        *_problem("{} lines are not number,force,unused and were left out", bad),
        *_problem("{} lines were out of order and were sorted", unordered),
        *_problem(
            "{} numbers occur twice with the same force and were used once",
            sorted(repeated.keys() & forces_n),
        ),
        *_problem("{} numbers occur with several forces and were left without one", sorted(conflicting)),
    ]


def _row(line: str) -> tuple[int, float] | None:
    match = _LINE.fullmatch(line)
    try:
        force_n = float(match[2]) if match else math.nan
    except ValueError:
        return None
    return (int(match[1]), force_n) if match and abs(force_n) <= _MAX_FORCE_N else None


def find_sets(number: Numbers, force_n: Floats) -> list[tuple[int, int]]:
    """Cuts a folder into sets of four touches.

    Args:
        number: Numbers of the images, (N,), rising.
        force_n: Forces in N, (N,).

    Returns:
        First number of each set, and its number of touches.
    """
    sets: list[tuple[int, int]] = []
    gaps = np.flatnonzero(np.diff(number) > _MAX_MISSING) + 1
    for part in np.split(np.arange(len(number)), gaps):
        starts, ends = _touches(force_n[part])
        count = max(math.ceil(len(starts) / TOUCHES), 1)
        for i in range(count):
            k = i * TOUCHES
            first = (ends[k - 1] + starts[k]) // 2 if i else 0
            sets.append((int(number[part[first]]), min(TOUCHES, len(starts) - k)))
    return sets


def _touches(force_n: Floats) -> tuple[Numbers, Numbers]:
    """Returns the first index of each touch, and the index after its last."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], force_n > CONTACT_N, [False]]).astype(np.int8)))
    long_enough = edges[1::2] - edges[::2] >= _MIN_TOUCH_FRAMES
    starts, ends = edges[::2][long_enough], edges[1::2][long_enough]
    rested = starts[1:] - ends[:-1] >= _MIN_REST_FRAMES
    return starts[np.append(True, rested)[: len(starts)]], ends[np.append(rested, True)[: len(ends)]]


def _environment(folder: Path) -> tuple[str, int, str]:
    """Returns object, degrees and illumination from a folder's name."""
    match = _FOLDER.fullmatch(folder.name)
    if not match or match[3] not in LUX:
        levels = ", ".join(f"{name} ({lux} lux)" for name, lux in LUX.items())
        raise DataError(f"the illumination in the name of {folder} is unknown; use one of {levels}")
    name = re.sub(r"[ _]+", "_", match[1].lower())
    return {"papercup": "paper_cup"}.get(name, name), int(match[2]), match[3]


def _read_image(path: Path) -> Gray | None:
    """Reads an image, (H, W) uint8. Returns None for a truncated JPEG, which a decoder would fill with gray."""
    data = path.read_bytes()
    if not data.rstrip(b"\0").endswith(b"\xff\xd9"):
        return None
    try:
        return np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE), np.uint8)
    except (cv2.error, TypeError):
        return None


def _problem(sentence: str, cases: Sequence[object]) -> list[str]:
    """Returns the sentence with the number of cases and the first one; empty without any."""
    return [f"{sentence.format(len(cases))}, the first is {cases[0]}"] if cases else []
