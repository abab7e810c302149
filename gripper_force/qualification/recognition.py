"""Measures what a network recognises as unfamiliar: unknown objects, views and light, and disturbed frames.

Each row is a set of simulated presses of seeds that no training uses. Views, light and disturbances change the
frames after recording: views and light all frames of a press, disturbances those from a random frame in contact
on. Only frames in contact count, and in disturbed presses only disturbed ones.
"""

import hashlib
import json
from collections.abc import Callable, Sequence
from concurrent.futures import as_completed
from pathlib import Path
from typing import Final, NamedTuple, TypedDict

import cv2
import numpy as np
import numpy.typing as npt

from gripper_force import __version__
from gripper_force.config import Config, LogConfig, VisionConfig, config_from, dump_config
from gripper_force.errors import DataError
from gripper_force.files import unfinished
from gripper_force.jobs.dataset import CONTACT_N, label_frames
from gripper_force.jobs.grasp import PAPER_OBJECTS
from gripper_force.jobs.processes import process_pool
from gripper_force.jobs.simulate import make_log, plan
from gripper_force.progress import Progress, no_progress
from gripper_force.runtime.log_reader import LogReader
from gripper_force.schema import Tree
from gripper_force.types import NS_PER_MS, Frame, Gray, LoadCellSample
from gripper_force.vision.batch_inference import features
from gripper_force.vision.checkpoint import Checkpoint, load_checkpoint
from gripper_force.vision.estimator import claimed_std_n
from gripper_force.vision.frame_checks import FrameChecks
from gripper_force.vision.known_views import view_score
from gripper_force.vision.ood import OodScore
from gripper_force.vision.preprocess import downscale, mean_image
from gripper_hw.sim.kinds import held_out_kinds

FIRST_SEED: Final = 7_800_000
"""Seed of the first press. No training and no fit uses the seeds from here to 7,899,999."""


COVERAGE_Z: Final = 1.645
"""Half-width of a 90 % interval in standard deviations."""

Floats = npt.NDArray[np.float64]

Change = Callable[[Gray, np.random.Generator], Gray]
"""Changes frames, (T, H, W) uint8; the draws are the same for all frames."""


def blob(frames: Gray, rng: np.random.Generator) -> Gray:
    """Covers a quarter of the image with a gray disc."""
    side = frames.shape[-1]
    radius = side * np.sqrt(0.25 / np.pi)
    centre = rng.uniform(radius, side - radius, 2)
    cover = cv2.GaussianBlur((_distance(side, centre) < radius).astype(np.float32), (0, 0), side / 85)
    return _bytes(frames * (1 - cover) + rng.uniform(60, 160) * cover)


def drop(frames: Gray, rng: np.random.Generator) -> Gray:
    """Puts a water drop on the lens: a disc of 3 to 8 % of the image is magnified, blurred and a bit brighter."""
    side = frames.shape[-1]
    radius = rng.uniform(0.1, 0.16) * side
    centre = rng.uniform(0.25, 0.75, 2) * side
    distance = _distance(side, centre) / radius
    y, x = np.mgrid[:side, :side].astype(np.float32)
    magnified = np.where(distance < 1, 0.5 + 0.5 * distance**2, 1).astype(np.float32)
    cover = np.clip((1.05 - distance) / 0.1, 0, 1)
    return _bytes(
        [
            frame * (1 - cover)
            + 1.08
            * cover
            * cv2.remap(
                cv2.GaussianBlur(frame, (0, 0), side / 64),
                (centre[0] + (x - centre[0]) * magnified).astype(np.float32),
                (centre[1] + (y - centre[1]) * magnified).astype(np.float32),
                cv2.INTER_LINEAR,
            )
            for frame in frames
        ]
    )


def shift(frames: Gray, rng: np.random.Generator) -> Gray:
    """Shifts the image by 1/64 of its side (2 of 128 pixels) in a random direction."""
    angle = rng.uniform(0, 2 * np.pi)
    by = frames.shape[-1] / 64 * np.array([np.cos(angle), np.sin(angle)])
    return _warped(frames, np.column_stack([np.eye(2), by]))


def bump(frames: Gray, rng: np.random.Generator) -> Gray:
    """Shifts the image by 1/12 of its side in a random direction."""
    angle = rng.uniform(0, 2 * np.pi)
    by = frames.shape[-1] / 12 * np.array([np.cos(angle), np.sin(angle)])
    return _warped(frames, np.column_stack([np.eye(2), by]))


def zoom(frames: Gray, rng: np.random.Generator) -> Gray:
    """Zooms in or out by 4 %."""
    return _turned(frames, 0.0, 1.04 if rng.random() < 0.5 else 1 / 1.04)


def refocus(frames: Gray, _rng: np.random.Generator) -> Gray:
    """Blurs the image with a standard deviation of 1.2 % of its side."""
    return _bytes([cv2.GaussianBlur(frame, (0, 0), frames.shape[-1] / 85) for frame in frames])


def lamp(frames: Gray, rng: np.random.Generator) -> Gray:
    """Lights the image from one side: 25 % brighter at one edge, 25 % darker at the other."""
    angle = rng.uniform(0, 2 * np.pi)
    y, x = np.mgrid[-1 : 1 : frames.shape[-1] * 1j, -1 : 1 : frames.shape[-1] * 1j]
    return _bytes(frames * (1 + 0.25 * (x * np.cos(angle) + y * np.sin(angle))))


def dimmed(frames: Gray, _rng: np.random.Generator) -> Gray:
    """Halves the light."""
    return _bytes(0.5 * frames)


def gamma(frames: Gray, _rng: np.random.Generator) -> Gray:
    """Lifts the shadows: a camera with another gamma curve, 0.6."""
    return _bytes(255 * (frames / 255) ** 0.6)


def mirrored(frames: Gray, _rng: np.random.Generator) -> Gray:
    """Mirrors the image, as if the camera was on the other side."""
    return np.ascontiguousarray(frames[:, :, ::-1])


def turned(frames: Gray, rng: np.random.Generator) -> Gray:
    """Turns the camera by 20 degrees about its axis, and zooms in by 30 %."""
    return _turned(frames, 20.0 if rng.random() < 0.5 else -20.0, 1.3)


class Row(NamedTuple):
    """One row of the table.

    Attributes:
        group: Group of the rows.
        name: Name of the row.
        objects: Objects, in turn.
        settings: Changes of the configuration.
        change: Change of the frames; None for none.
        throughout: True to change all frames of a press, False to change them from a frame in contact on.
    """

    group: str
    name: str
    objects: tuple[str, ...] = PAPER_OBJECTS
    settings: tuple[tuple[str, object], ...] = ()
    change: Change | None = None
    throughout: bool = False


ROWS: Final = (
    Row("known kinds", "still"),
    Row("known kinds", "moving background", settings=(("moving_background", True),)),
    Row("known kinds", "changing light", settings=(("changing_light", True),)),
    *(Row("held-out kinds", name, (name,)) for name in ("ball", *held_out_kinds())),
    *(Row("views", change.__name__, change=change, throughout=True) for change in (mirrored, turned)),
    *(Row("light", change.__name__, change=change, throughout=True) for change in (dimmed, gamma, lamp)),
    *(
        Row("disturbances", change.__name__, change=change)
        for change in (blob, drop, shift, bump, zoom, refocus, lamp)
    ),
)


class Figures(TypedDict):
    """One row's figures, over frames in contact.

    MAE, bias, z and coverage are those of the accepted frames, and None if there are none; ``mae_all_n`` includes the
    rejected ones. A frame is bad if its error is more than twice the claimed deviation, also if it was rejected; good
    otherwise.
    """

    group: str
    name: str
    frames: int
    mae_n: float | None
    bias_n: float | None
    z: float | None
    coverage: float | None
    rejected: float
    good_rejected: float | None
    bad_accepted: float | None
    bad_among_accepted: float | None
    mae_all_n: float


def measure(
    config: Config, folder: Path, presses: int, workers: int, progress: Progress = no_progress
) -> list[Figures]:
    """Simulates the presses that do not exist yet, estimates all rows, and returns their figures.

    Args:
        config: Configuration; ``vision.checkpoint`` is the network.
        folder: Folder for logs and estimates; existing ones of this version are used again.
        presses: Presses of each row.
        workers: Number of processes.
        progress: Called once for each press of each row.

    Raises:
        DataError: Estimates in the folder can't be read.
        CheckpointError: The network can't be read.
    """
    tasks = [(row, index) for row in range(len(ROWS)) for index in range(presses)]
    tree = config.model_dump(mode="json")
    parts: dict[tuple[int, int], Tree] = {}
    # Rows with the same scene share a log. The first task of each makes it; two at a time would both make it.
    first = {(ROWS[row].settings, ROWS[row].objects, index): (row, index) for row, index in reversed(tasks)}
    making = sorted(first.values())
    with process_pool(workers) as pool:
        for wave in (making, [task for task in tasks if task not in making]):
            futures = {pool.submit(_press, *task, folder, tree): task for task in wave}
            for future in as_completed(futures):
                row, index = futures[future]
                parts[row, index] = future.result()
                progress(f"{ROWS[row].name} {index + 1}")
    return [_figures(ROWS[row], [parts[row, index] for index in range(presses)]) for row in range(len(ROWS))]


HEADINGS: Final = {
    "frames": "frames",
    "mae_all_n": "MAE N, all",
    "mae_n": "MAE N",
    "bias_n": "bias N",
    "z": "z",
    "coverage": "within 90 %",
    "rejected": "rejected",
    "good_rejected": "good rejected",
    "bad_accepted": "bad accepted",
    "bad_among_accepted": "bad among accepted",
}
"""Headings of the table by key of `Figures`."""


def texts(row: Figures) -> list[str]:
    """Returns a row's figures as text, in the order of `HEADINGS`."""
    digits = {"frames": "{}", "mae_all_n": "{:.2f}", "mae_n": "{:.2f}", "bias_n": "{:+.2f}", "z": "{:.2f}"}
    values = {key: value for key, value in row.items() if key in HEADINGS}
    return ["-" if values[key] is None else digits.get(key, "{:.1%}").format(values[key]) for key in HEADINGS]


def markdown(rows: Sequence[Figures]) -> str:
    """Returns the table for a page."""
    lines = [
        " | ".join(["", "group", "row", *HEADINGS.values(), ""]).strip(),
        "|---" * (len(HEADINGS) + 2) + "|",
    ]
    lines += [f"| {' | '.join([row['group'], row['name'], *texts(row)])} |" for row in rows]
    return "\n".join(lines) + "\n"


def _press(row: int, index: int, folder: Path, tree: Tree) -> Tree:
    """Makes one press if it does not exist, and returns its estimates, which are kept beside it."""
    spec = ROWS[row]
    config = config_from(tree, "recognition")
    scene = "-".join(name for name, _ in spec.settings) or "still"
    log = plan("press", index + 1, FIRST_SEED, spec.objects)[index]
    pressed = config.with_values(sim=dict(spec.settings))
    # The key of a press holds this version, because another one may simulate or judge it otherwise, but no network and
    # no folder.
    made = dump_config(pressed.with_values(vision=VisionConfig(region=config.vision.region), log=LogConfig()))
    key = hashlib.sha256(f"{__version__} {made}".encode()).hexdigest()[:12]
    logs = folder / "logs" / f"{scene}-{key}"
    logs.mkdir(parents=True, exist_ok=True)
    path = logs / log.name
    if not path.exists():
        make_log(log, logs, pressed.model_dump(mode="json"))
    checkpoint = load_checkpoint(config.vision.checkpoint)
    # All that `judge` takes, besides the region, which is part of the key.
    judging = f"{checkpoint.header.model_dump_json()} {config.vision.max_covered}"
    version = hashlib.sha256(judging.encode()).hexdigest()
    name = "-".join([spec.group, spec.name, scene, log.name, key, version[:12]]).replace(" ", "_")
    kept = folder / "judged" / f"{name}.json"
    if kept.exists():
        try:
            loaded: Tree = json.loads(kept.read_text(encoding="utf-8"))
        except ValueError as error:
            raise DataError(f"can't read {kept}: {error}; delete it") from error
        return loaded
    frames, force_n, used = _read(path)
    rng = np.random.default_rng([FIRST_SEED, row, index])
    if spec.change is not None:
        begin = 0 if spec.throughout else int(rng.choice(np.flatnonzero(used)[: used.sum() // 2]))
        frames = np.concatenate([frames[:begin], spec.change(frames[begin:], rng)])
        used &= np.arange(len(frames)) >= begin
    estimate_n, std_n, rejected = judge(frames, config, checkpoint)
    result = {
        "force_n": force_n[used].tolist(),
        "estimate_n": estimate_n[used].tolist(),
        "std_n": std_n[used].tolist(),
        "rejected": rejected[used].tolist(),
    }
    kept.parent.mkdir(parents=True, exist_ok=True)
    with unfinished(kept) as part:
        part.write_text(json.dumps(result), encoding="utf-8")
    return result


def judge(
    frames: Gray, config: Config, checkpoint: Checkpoint
) -> tuple[Floats, Floats, npt.NDArray[np.bool_]]:
    """Returns what a run would make of each frame, and also the estimates of the frames that it would reject.

    Args:
        frames: A recording, (T, H, W) uint8.
        config: Configuration; of it ``vision.region`` and ``vision.max_covered``.
        checkpoint: The network.

    Returns:
        Forces and claimed standard deviations in N, (T,), and the mask of the rejected frames, (T,).
    """
    header = checkpoint.header
    small = np.stack([downscale(frame, config.vision.region, header.preprocess.size) for frame in frames])
    forces_n, read_out = features(checkpoint.networks, header.preprocess, small)
    refused = np.zeros(len(frames), bool)
    checks = FrameChecks(config.vision.max_covered)
    for i, frame in enumerate(small):
        try:
            checks.check(frame)
        except DataError:
            refused[i] = True
    if refused.any() and not refused.all():
        # In a run the network does not see these frames, and they do not change its later estimates.
        forces_n[:, ~refused], read_out[~refused] = features(
            checkpoint.networks, header.preprocess, small[~refused]
        )
    if header.views is not None:
        reference = mean_image(small[: header.preprocess.reference_frames])
        refused |= view_score(header.views, reference) > 1
    estimate_n = forces_n.mean(0).astype(np.float64)
    std_n = claimed_std_n(header, forces_n)
    if header.ood is None:
        return estimate_n, std_n, refused
    ood = OodScore(header.ood)
    score = ood.score(read_out, estimate_n)
    return estimate_n, std_n * ood.std_factor(score), refused | (score > 1)


def _read(path: Path) -> tuple[Gray, Floats, npt.NDArray[np.bool_]]:
    """Returns a log's frames (T, H, W), their forces in N (T,), and the mask of labelled frames in contact (T,)."""
    reader = LogReader(path)
    frames, samples = [], []
    for record in reader.records(Frame, LoadCellSample):
        if isinstance(record, Frame):
            frames.append(record)
        elif isinstance(record, LoadCellSample):
            samples.append(record)
    exposure_ns = round(float(reader.metadata["exposure_ms"]) * NS_PER_MS)
    t_ns = np.array([frame.t_ns for frame in frames], np.int64)
    force_n, valid = label_frames(t_ns, samples, exposure_ns)
    return (
        np.stack([frame.gray for frame in frames]),
        force_n.astype(np.float64),
        valid & (force_n > CONTACT_N),
    )


def _figures(row: Row, parts: Sequence[Tree]) -> Figures:
    force_n, estimate_n, std_n, rejected = (
        np.concatenate([np.asarray(part[key]) for part in parts])
        for key in ("force_n", "estimate_n", "std_n", "rejected")
    )
    error_n, rejected = estimate_n - force_n, rejected.astype(bool)
    bad, kept = np.abs(error_n) > 2 * std_n, ~rejected

    def mean(values: npt.NDArray[np.generic]) -> float | None:
        return float(values.astype(np.float64).mean()) if len(values) else None

    z2 = mean(np.square(error_n / std_n)[kept])
    return {
        "group": row.group,
        "name": row.name,
        "frames": len(force_n),
        "mae_n": mean(np.abs(error_n[kept])),
        "bias_n": mean(error_n[kept]),
        "z": None if z2 is None else z2**0.5,
        "coverage": mean((np.abs(error_n) < COVERAGE_Z * std_n)[kept]),
        "rejected": float(rejected.mean()),
        "good_rejected": mean(rejected[~bad]),
        "bad_accepted": mean(kept[bad]),
        "bad_among_accepted": mean(bad[kept]),
        "mae_all_n": float(np.abs(error_n).mean()),
    }


def _distance(side: int, centre: Floats) -> Floats:
    y, x = np.mgrid[:side, :side]
    distance: Floats = np.hypot(x - centre[0], y - centre[1])
    return distance


def _warped(frames: Gray, matrix: Floats) -> Gray:
    size = frames.shape[:0:-1]
    return _bytes([cv2.warpAffine(f, matrix, size, borderMode=cv2.BORDER_REPLICATE) for f in frames])


def _turned(frames: Gray, degrees: float, scale: float) -> Gray:
    middle = (frames.shape[-1] - 1) / 2
    return _warped(frames, cv2.getRotationMatrix2D((middle, middle), degrees, scale))


def _bytes(frames: npt.ArrayLike) -> Gray:
    return np.clip(np.round(np.asarray(frames)), 0, 255).astype(np.uint8)
