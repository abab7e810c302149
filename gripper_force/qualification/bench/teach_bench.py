"""Errors of the shipped network, calibrated, taught, and of one trained from scratch, on foreign rigs and objects.

A *cell* is one rig, one object, one number of touches and one method. Its figures are the error of vision on fresh
touches up to `TOUCH_PEAK_N`, the median error of grasps, and the minutes that the method took after the touches. A
finished cell is one line of a file, and is not repeated with the same version, settings and number of grasps.
"""

import hashlib
import json
import shutil
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from gripper_calibration.fits.object_fit import fit_correction
from gripper_calibration.fits.touches import Touches
from gripper_calibration.procedures.calibrate_object import calibrate_object, record_touches
from gripper_calibration.procedures.teach import teach
from gripper_force import __version__
from gripper_force.config import Config, dump_config, load_config
from gripper_force.errors import DataError
from gripper_force.jobs.dataset import Clip, digest, load_clips, without_contact_starts
from gripper_force.jobs.evaluate import evaluate
from gripper_force.jobs.imports.video import find_recordings, import_video
from gripper_force.jobs.training import few
from gripper_force.jobs.training.recipe import recipe
from gripper_force.jobs.training.train import train
from gripper_force.jobs.trials import TrialsSummary, summarise_trials, trials, with_same_object
from gripper_force.progress import Progress, no_progress
from gripper_force.qualification.result_lines import whole_lines
from gripper_force.vision.batch_inference import features
from gripper_force.vision.gaussian_process import GaussianProcess
from gripper_force.vision.model_files import read_model

FIRST_SEED: Final = 98_000_000
"""Seed of the first rig. No training uses the seeds from here on."""

TOUCH_PEAK_N: Final = 8.0
"""Largest force of all touches."""

TESTS: Final = 6
"""Number of the touches that vision is tested on."""

COUNTS: Final = (4, 8, 16, 32)
METHODS: Final = ("shipped", "calibrated", "taught", "from scratch")

_SCRATCH: Final = (
    "attentions=[ssam]",
    "width=0.5",
    "hidden=64",
    "head=256",
    "preprocess.size=64",
    "steps=400",
)
"""Recipe of a network that is trained from scratch: of the size of the small network, which learns faster."""

_OTHER_SEEDS: Final = 500
"""Distance of the seeds of the test from those of the touches."""

Floats = npt.NDArray[np.floating]


class Rig(NamedTuple):
    """A rig to test on.

    Attributes:
        name: Its name.
        config: Its configuration.
    """

    name: str
    config: Config


@dataclass(frozen=True, slots=True)
class Cell:
    """Figures of one cell; None for what could not be measured.

    Attributes:
        rig: Name of the rig.
        object: Name of the object.
        touches: Number of touches that the method used; 0 for the shipped network.
        method: One of `METHODS`.
        network: Digest of the network to begin with.
        mae_n: MAE of vision on fresh touches.
        fused_percent: Median error of grasps with vision and motor current, as a share of the target.
        vision_percent: The same by vision alone.
        fell_back: Grasps by vision that fell back to motor current.
        minutes: Time of the method after the touches.
        learned: What `teach` took.
        problem: Reason why the method gave nothing; empty if it did.
        grasps: Grasps with each feedback.
        settings: Digest of version and configuration of the rig. Cells of other versions are measured again.
    """

    rig: str
    object: str
    touches: int
    method: str
    network: str
    mae_n: float | None = None
    fused_percent: float | None = None
    vision_percent: float | None = None
    fell_back: int = 0
    minutes: float = 0.0
    learned: str = ""
    problem: str = ""
    grasps: int = 0
    settings: str = ""


def foreign_rigs(config: Config, count: int) -> list[Rig]:
    """Returns rigs that no network has seen: other mountings and lenses, other jaws, other light."""
    rigs = []
    for i in range(count):
        own = config.with_values(
            seed=FIRST_SEED + 1000 * i,
            sim={
                "rig_seed": FIRST_SEED + i,
                "object_seed": FIRST_SEED + i,
                "view_spread": (3.0, 6.0, 10.0)[i % 3],
                "jaw_spread": (0.3, 0.6, 1.0)[i // 2 % 3],
                "lux": (None, 350.0, 750.0)[(i + i // 3) % 3],
            },
        )
        sim = own.sim
        rigs.append(Rig(f"view {sim.view_spread:g}, jaws {sim.jaw_spread:g}, {sim.lux or 'any'} lux", own))
    return rigs


def read_rigs(paths: Sequence[Path], overrides: list[str] | None) -> list[Rig]:
    """Returns the rigs of configuration files. Raises `ConfigError` if one can't be read."""
    return [Rig(path.stem, load_config(path, overrides)) for path in paths]


def list_cells(
    rigs: Sequence[Rig], objects: Sequence[str], counts: Sequence[int], methods: Sequence[str]
) -> list[tuple[Rig, Cell]]:
    """Returns the cells to measure, each with its rig.

    Args:
        rigs: The rigs.
        objects: Names of the objects.
        counts: Numbers of touches.
        methods: Some of `METHODS`.
    """
    cells = []
    for rig in rigs:
        network = read_model(rig.config.vision.checkpoint).digest
        settings = _digest(f"{__version__} {dump_config(rig.config)}")
        for name in objects:
            for method in methods:
                for count in (0,) if method == "shipped" else counts:
                    cells.append((rig, Cell(rig.name, name, count, method, network, settings=settings)))
    return cells


def bench(
    cells: Sequence[tuple[Rig, Cell]],
    *,
    grasps: int,
    folder: Path,
    workers: int = 1,
    progress: Progress = no_progress,
) -> Iterator[Cell]:
    """Measures the cells that are not yet in ``folder/cells.jsonl``, and yields all.

    Args:
        cells: Cells of `list_cells`.
        grasps: Grasps of each cell and feedback; 0 for none.
        folder: Folder of logs, bundles and results.
        workers: Processes of `teach`.
        progress: Called before each part of a cell.

    Raises:
        GripperError: A touch failed, or a file can't be read or written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "cells.jsonl"
    known = {_key(cell): cell for cell in (Cell(**row) for row in _rows(file))}
    for rig, cell in cells:
        cell = replace(cell, grasps=grasps)
        key = _key(cell)
        if key not in known:
            progress(f"{cell.object}, {cell.rig}: {cell.method}, {cell.touches} touches")
            known[key] = _measured(cell, rig.config, grasps, folder, workers, progress)
            with file.open("a") as out:
                out.write(json.dumps(asdict(known[key])) + "\n")
        yield known[key]


def _key(cell: Cell) -> tuple[object, ...]:
    return cell.rig, cell.object, cell.touches, cell.method, cell.network, cell.grasps, cell.settings


def _measured(
    cell: Cell, config: Config, grasps: int, folder: Path, workers: int, progress: Progress
) -> Cell:
    """Touches, learns, tests vision on fresh touches, and grasps. A cell with too few data states its problem."""
    place = folder / f"{cell.rig} {cell.object} {cell.settings[:8]}".replace(",", "").replace(" ", "-")
    config = config.with_values(
        object=cell.object,
        log={"directory": place / "grasps", "report": False},
        calibration={"object": "none"},
    )
    touched = list(
        record_touches(config, cell.touches, TOUCH_PEAK_N, place / "touches", progress=progress)
        if cell.touches
        else ()
    )
    other = with_same_object(config).with_values(seed=config.seed + _OTHER_SEEDS)
    test = list(record_touches(other, TESTS, TOUCH_PEAK_N, place / "test", progress=progress))
    begin_s = time.monotonic()
    try:
        config, learned = _learned(cell, config, touched, place, workers)
    except DataError as error:  # too little to learn from: the method has no figure here
        return replace(cell, minutes=(time.monotonic() - begin_s) / 60, problem=str(error))
    minutes = (time.monotonic() - begin_s) / 60
    progress(f"{cell.object}: testing {cell.method}")
    found = evaluate(test, config.vision.checkpoint, config=config)
    below = [b for b in found.per_bin if b.from_n < TOUCH_PEAK_N]
    mae_n = float(np.average([b.mae_n for b in below], weights=[b.frames for b in below]))
    result = replace(cell, mae_n=mae_n, minutes=minutes, learned=learned)
    if not grasps:
        return result
    grasping = other.with_values(
        seed=other.seed + _OTHER_SEEDS, vision=config.vision, calibration=config.calibration
    )
    fused, vision = (_grasped(grasping, feedback, grasps, progress) for feedback in ("fused", "vision"))
    return replace(
        result,
        fused_percent=fused["median_error_percent"],
        vision_percent=vision["median_error_percent"],
        fell_back=vision["fell_back"],
    )


def _learned(
    cell: Cell, config: Config, touched: Sequence[Path], place: Path, workers: int
) -> tuple[Config, str]:
    """Learns from the touches by the cell's method. Returns the configuration with it, and what `teach` learned."""
    out = place / f"{cell.method}-{cell.touches}-{cell.network[:8]}".replace(" ", "-")
    if cell.method == "calibrated":
        return _calibrated(config, cell.object, touched, out), ""
    if cell.method == "from scratch":
        return _scratch(config, cell.object, touched, out), ""
    if cell.method != "taught":
        return config, ""
    bundle = place / f"bundle-{cell.touches}"
    # `teach` continues what is there, and the measured time would be that of the rest.
    shutil.rmtree(out, ignore_errors=True)
    taught = teach(config, cell.object, logs=touched, folder=out, out=bundle, workers=workers)
    config = config.with_values(
        calibration={"object": str((taught.bundle / "profile.yaml").absolute())},
        vision={"checkpoint": str(taught.bundle / "network.safetensors")},
    )
    return config, taught.learned


def _grasped(config: Config, feedback: str, grasps: int, progress: Progress) -> TrialsSummary:
    config = config.with_values(control={"feedback": feedback})
    done = list(trials(config, grasps, 1, objects=(config.object,), progress=progress))
    return summarise_trials(done, config.control.force_limit_n)


def _calibrated(config: Config, name: str, touched: Sequence[Path], out: Path) -> Config:
    profile = calibrate_object(config, name, logs=touched, out=out.with_suffix(".yaml"))
    return config.with_values(calibration={"object": str(profile.profile_path)})


def _scratch(config: Config, name: str, touched: Sequence[Path], out: Path) -> Config:
    settings = recipe("short_clips", list(_SCRATCH))
    clips = [replace(clip, set=clip.name) for clip in load_clips(list(touched), settings.preprocess)]
    network = out.with_suffix(".network.safetensors")
    train(settings, clips, network, validation_clips=clips)
    return _calibrated(config.with_values(vision={"checkpoint": str(network)}), name, touched, out)


def _rows(file: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in whole_lines(file)]


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def markdown(cells: Sequence[Cell]) -> str:
    """Returns the table for a page: medians over rigs and objects, and the worst of them."""
    lines = [
        "| method | touches | measured | MAE N, median | worst | grasps, fused % | by vision % | minutes |",
        "|---|---|---|---|---|---|---|---|",
    ]
    groups = dict.fromkeys((cell.method, cell.touches) for cell in cells)
    for method, touches in sorted(groups, key=lambda group: (METHODS.index(group[0]), group[1])):
        own = [cell for cell in cells if (cell.method, cell.touches) == (method, touches)]
        errors_n = [cell.mae_n for cell in own if cell.mae_n is not None]
        figures = [
            f"{len(errors_n)} of {len(own)}",
            _median(errors_n, "{:.3f}"),
            f"{max(errors_n):.3f}" if errors_n else "-",
            _median([c.fused_percent for c in own if c.fused_percent is not None], "{:.1f}"),
            _median([c.vision_percent for c in own if c.vision_percent is not None], "{:.1f}"),
            _median([c.minutes for c in own], "{:.1f}"),
        ]
        lines.append(f"| {method} | {touches or '-'} | {' | '.join(figures)} |")
    return "\n".join(lines) + "\n"


def _median(values: Sequence[float], text: str) -> str:
    return text.format(float(np.median(values))) if values else "-"


class RecordingRow(NamedTuple):
    """Errors on real recordings of one object, which was left out of the training.

    Attributes:
        object: Name of the object.
        trials: Number of its first recordings that were learned from.
        tested: Number of its other recordings, which are the test.
        untaught_n: MAE of the process that was fitted to the other objects.
        calibrated_n: The same, calibrated on the trials.
        taught_n: MAE of a process fitted to the other objects and the trials.
        recordings: Digest of version and recordings. Rows of other versions are not used again.
    """

    object: str
    trials: int
    tested: int
    untaught_n: float
    calibrated_n: float
    taught_n: float
    recordings: str = ""


def bench_recordings(
    recordings: Path, folder: Path, progress: Progress = no_progress
) -> Iterator[RecordingRow]:
    """Leaves out each object of a folder of real recordings, and teaches its first one and its first two.

    Recordings that start in contact are left out, as in `train`. The settings of the process are chosen among the other
    objects alone.

    Args:
        recordings: Folder as for `import video`.
        folder: Folder of logs and results; finished rows of the same recordings are not repeated.
        progress: Called before each object.

    Yields:
        Two rows for each object that has more than two recordings, one if it has two.

    Raises:
        DataError: The recordings can't be used.
    """
    preprocess = recipe("few").preprocess
    clips = without_contact_starts(
        load_clips(import_missing(recordings, folder, progress), preprocess), preprocess
    )
    key = digest_of_recordings(clips)
    file = folder / "recordings.jsonl"
    rows = [RecordingRow(**row) for row in _rows(file)]
    for name in sorted({clip.object for clip in clips}):
        own = [clip for clip in clips if clip.object == name]
        counts = [count for count in (1, 2) if count < len(own)]
        found = [row for row in rows if (row.object, row.recordings) == (name, key)]
        if len(found) < len(counts):
            progress(f"{name}: fitting the others")
            others = [clip for clip in clips if clip.object != name]
            fit = few.fit(others, preprocess)
            found = [
                _recording_row(name, own, count, others, fit)._replace(recordings=key) for count in counts
            ]
            with file.open("a") as out:
                out.writelines(json.dumps(row._asdict()) + "\n" for row in found)
        yield from found


def import_missing(recordings: Path, folder: Path, progress: Progress = no_progress) -> list[Path]:
    """Imports the recordings that have no log yet, and returns the logs of all.

    Args:
        recordings: Folder as for `import video`.
        folder: Folder of the logs, in which each folder of recordings has its own: two may have the same names. So has
            each version, which may import otherwise.
        progress: Called before each import.
    """
    logs = folder / f"recordings-{_digest(f'{__version__} {recordings.resolve()}')[:8]}"
    paths = []
    for name, video, forces in find_recordings(recordings):
        paths.append(logs / f"{name}.mcap")
        if not paths[-1].exists():
            progress(f"importing {name}")
            import_video(video, forces, paths[-1], name=name)
    return paths


def digest_of_recordings(clips: Sequence[Clip]) -> str:
    """Returns the digest of this version and all frames, forces and objects."""
    return _digest(f"{__version__} {digest(clips)} {[clip.object for clip in clips]}")


def _recording_row(
    name: str, own: Sequence[Clip], count: int, others: Sequence[Clip], fit: few.Fit
) -> RecordingRow:
    learned, test = own[:count], own[count:]
    preprocess = recipe("few").preprocess
    taught = few.fitted([*others, *learned], preprocess, fit.setting)
    before = [_touches(fit.model, clip, i) for i, clip in enumerate(learned)]
    try:
        corrected = fit_correction(
            Touches(*(np.concatenate([getattr(t, key) for t in before]) for key in Touches.__annotations__))
        ).predict
    except DataError:  # the estimates do not follow the load cell: they stay as they are
        corrected = lambda touches: touches.estimate_n  # noqa: E731
    raw = [_touches(fit.model, clip, 0) for clip in test]

    def mae_n(estimates: Sequence[Floats], touches: Sequence[Touches]) -> float:
        error = np.concatenate([a - b.force_n for a, b in zip(estimates, touches, strict=True)])
        return float(np.abs(error).mean())

    after = [_touches(taught, clip, 0) for clip in test]
    return RecordingRow(
        name,
        count,
        len(test),
        mae_n([t.estimate_n for t in raw], raw),
        mae_n([corrected(t) for t in raw], raw),
        mae_n([t.estimate_n for t in after], after),
    )


def _touches(process: GaussianProcess, clip: Clip, number: int) -> Touches:
    preprocess = recipe("few").preprocess
    forces_n, read_out = features([process], preprocess, clip.frames)
    used = clip.labelled(preprocess.lead_in)
    return Touches(
        read_out[used],
        forces_n[0][used].astype(np.float64),
        clip.forces_n[used].astype(np.float64),
        np.full(int(used.sum()), number),
    )


def recordings_markdown(rows: Sequence[RecordingRow]) -> str:
    """Returns the table of real recordings for a page, with the mean over the objects."""
    lines = [
        "| object left out | trials learned | recordings tested | before N | calibrated N | taught N |",
        "|---|---|---|---|---|---|",
    ]
    for count in sorted({row.trials for row in rows}):
        own = [row for row in rows if row.trials == count]
        mean = np.mean([[row.untaught_n, row.calibrated_n, row.taught_n] for row in own], axis=0)
        for row in own:
            figures = (row.untaught_n, row.calibrated_n, row.taught_n)
            lines.append(
                f"| {row.object} | {count} | {row.tested} | {' | '.join(f'{n:.2f}' for n in figures)} |"
            )
        lines.append(f"| **mean** | {count} | | {' | '.join(f'**{n:.2f}**' for n in mean)} |")
    return "\n".join(lines) + "\n"
