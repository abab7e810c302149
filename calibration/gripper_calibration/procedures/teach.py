"""Teaching of an object: the estimator that is best on touches left out, calibrated, in one bundle.

The candidates are, from the simplest: the configured network as it is, networks trained further on the touches, and a
Gaussian process fitted to them. Each is calibrated as `calibrate_object` does it. The logs of the touches are divided
into folds; a fold is estimated by what was trained and calibrated on the others. Among the candidates that are not
worse than the best by more than one standard error, the simplest is taken (L. Breiman et al., Classification and
Regression Trees, 1984, section 3.4.3), trained on all touches, and calibrated. Its interval and its expected error are
those of the folds.
"""

import json
import math
import shutil
from collections.abc import Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import torch
from safetensors.numpy import load, save

from gripper_calibration.fits.interval_fit import conformal_interval
from gripper_calibration.fits.object_fit import COVERAGE, LearningCurvePoint, ObjectFit, fit_correction
from gripper_calibration.fits.ood_fit import fit_ood_limit
from gripper_calibration.fits.touches import Floats
from gripper_calibration.plots.object_plot import draw
from gripper_calibration.procedures.calibrate_object import (
    default_folder,
    find_logs,
    make_profile,
    record_touches,
)
from gripper_calibration.touch_logs import TouchRecording, join, read_log
from gripper_force import __version__
from gripper_force.config import Config
from gripper_force.errors import ConfigError, DataError
from gripper_force.interfaces import Progress, Prompt, no_progress
from gripper_force.jobs.dataset import CONTACT_N, Clip, load_clips
from gripper_force.jobs.processes import process_pool
from gripper_force.jobs.profile_files import check_place, write_object
from gripper_force.jobs.training.recipe import recipe
from gripper_force.jobs.training.stated_errors import residuals
from gripper_force.jobs.training.train import train
from gripper_force.profiles.correction import pack
from gripper_force.profiles.object_profile import BUNDLED, ObjectProfile, user_folder
from gripper_force.runtime.resolve import ResolvedConfig, resolve_vision
from gripper_force.schema import write_all
from gripper_force.vision.checkpoint import Checkpoint, load_checkpoint
from gripper_force.vision.checkpoint_writer import replace_header
from gripper_force.vision.header import SHIPPED, Model, ProcessConfig
from gripper_force.vision.model_files import read_model
from gripper_force.vision.preprocess import Preprocess

TOUCHES: Final = 16
"""Default number of touches."""

MIN_LOGS: Final = 4
"""Fewer logs of touches can't be divided into halves that are calibrated."""

FOLDS: Final = 3
"""Parts of the logs, each left out once. More would take longer than a user waits."""

STEPS: Final = 4 * (FOLDS + 1) + 3
"""Steps of progress that `teach` reports after the touches."""

_HELPS: Final = 0.85
"""More touches help if the error after the touches of the folds is less than this share of that after half of all."""

_NETWORK: Final = "network.safetensors"


@dataclass(frozen=True, slots=True)
class Taught:
    """Result of `teach`.

    Attributes:
        bundle: Folder with network, profile and figure. A grasp of the object uses it.
        profile: The profile in it.
        learned: Name of the selected candidate, one of the keys of `candidates_mae_n`.
        candidates_mae_n: MAE of each candidate on touches left out.
        before_n: MAE of the configured network without calibration.
        mae_n: Expected MAE: that of the selected candidate on touches left out.
        contact_mae_n: The same, of the frames in contact.
        half_mae_n: MAE of the selected candidate on the touches left out after it has learned from `half_logs` logs.
        half_logs: Half of the logs.
        more_touches_help: True if the error still falls clearly with the number of touches.
        without_contact: Logs that were not used because they show no contact.
    """

    bundle: Path
    profile: ObjectProfile
    learned: str
    candidates_mae_n: dict[str, float]
    before_n: float
    mae_n: float
    contact_mae_n: float
    half_mae_n: float
    half_logs: int
    more_touches_help: bool
    without_contact: tuple[Path, ...]


def teach(
    config: Config,
    name: str,
    *,
    logs: Sequence[str | Path] | None = None,
    touches: int = TOUCHES,
    peak_n: float | None = None,
    folder: str | Path | None = None,
    out: str | Path | None = None,
    replay: Sequence[str | Path] = (),
    workers: int = 1,
    prompt: Prompt | None = None,
    progress: Progress = no_progress,
) -> Taught:
    """Teaches an object: touches it, takes the best estimator for it, and writes a bundle that grasps of it use.

    Each part of the work is kept in ``folder``. After an interruption, the same arguments continue it. With more
    ``touches`` the old ones are used too.

    Args:
        config: The configuration: the devices, and the network to begin with. Its ``object`` is replaced by ``name``.
        name: Name of the object. In simulation it must be one of the simulated objects.
        logs: Logs of touches, or folders to search for ``*.mcap``. The devices are then not used.
        touches: Number of touches, including those already in ``folder``. Not used with ``logs``.
        peak_n: Largest force of a touch in N; None for what the force limit permits, up to 12 N.
        folder: Folder of the touches' logs and of the parts of the work; None for ``data/touches/NAME``.
        out: Folder of the bundle; None for ``NAME`` in the user's folder of profiles.
        replay: Logs of an earlier training, or folders of them. They are mixed in, so that their objects are not
            forgotten.
        workers: Processes; 1: everything runs in this one.
        prompt: Called before each touch, so that a person can place the object again; None for no pause.
        progress: Called once for each touch, and then with `STEPS` steps.

    Returns:
        The bundle, the selected candidate, and the expected error.

    Raises:
        ConfigError: There is no camera, load cell or network, the peak is not within the force limit, or the bundle
            can't be written.
        DataError: The load cell reads a force at rest, a touch failed, or there are fewer than `MIN_LOGS` logs with
            contact.
        LogError: A log can't be read.
        CheckpointError: The network can't be read.
        DeviceError: A device failed. The servo was stopped as configured, and completed touches are kept.

    Example:
        ::

            config = gripper_force.load_config("my.yaml")
            result = gripper_force.teach(config, "mug", touches=16)
            print(result.bundle, result.mae_n, result.more_touches_help)
    """
    out = user_folder() / name if out is None else Path(out)
    place = default_folder(name) if folder is None else Path(folder)
    check_bundle(out)
    if logs is None:
        named = config.model_copy(update={"object": name})
        paths = []
        for path in record_touches(named, touches, peak_n, place, prompt=prompt, progress=progress):
            paths.append(path)
            progress(f"touch {len(paths)} of {touches}")
    else:
        paths = find_logs([Path(path) for path in logs])
    config, model, _ = resolve_vision(config)
    if model is None:
        raise ConfigError("teach needs a network to begin with; set vision.checkpoint, such as to default")
    used = [path for path in paths if _has_contact(path, model)]
    work = _Work(used, find_logs([Path(path) for path in replay]), place / "teach", workers)
    return work.run(config, model, name, out, tuple(path for path in paths if path not in used), progress)


def check_bundle(out: Path) -> None:
    """Raises `ConfigError` if a bundle can't be written, or the folder is something else."""
    check_place(out.with_suffix(".yaml"))
    if out.exists() and not (out / BUNDLED).is_file():
        raise ConfigError(f"{out} exists and is not a bundle; name another folder")


class _Left(NamedTuple):
    """Estimates of a log by what was made without it."""

    raw_n: Floats  # (N,), not corrected
    estimate_n: Floats  # (N,)
    force_n: Floats  # (N,), of the load cell
    ood_score: Floats  # (N,)

    @property
    def mae_n(self) -> float:
        return float(np.abs(self.estimate_n - self.force_n).mean())


class _Candidate(NamedTuple):
    """Network and recipe that an estimator is made of."""

    name: str
    base: str  # the network to begin with
    recipe: str  # name of the recipe of a training; empty for none


class _Task(NamedTuple):
    """A candidate, and the splits in which it is judged."""

    candidate: _Candidate
    logs: tuple[Path, ...]
    splits: tuple[tuple[int, ...], ...]  # of each split the logs to learn from; the others are the test
    replay: tuple[Path, ...]
    file: Path  # of the result; the state of a training lies beside it

    @property
    def tests(self) -> list[list[int]]:
        return [[i for i in range(len(self.logs)) if i not in split] for split in self.splits]


class _Work:
    """The work after the touches. Each part of it leaves a file, and is not repeated."""

    def __init__(self, logs: Sequence[Path], replay: Sequence[Path], folder: Path, workers: int) -> None:
        if len(logs) < MIN_LOGS:
            raise DataError(
                f"there are {len(logs)} logs of touches with contact, but teach leaves some out to compare, and needs "
                f"{MIN_LOGS}; touch the object more often, or use `gripper-force calibrate object`"
            )
        self._logs, self._replay = tuple(logs), tuple(replay)
        self._folder, self._workers = folder, workers
        self._digests = tuple(_digest_of(path) for path in logs)

    def run(
        self,
        config: Config,
        model: Model,
        name: str,
        out: Path,
        without_contact: tuple[Path, ...],
        progress: Progress,
    ) -> Taught:
        count = len(self._logs)
        folds = [tuple(i for i in range(count) if i % FOLDS != fold) for fold in range(FOLDS)]
        half = tuple(range(0, count, 2))
        candidates = _candidates(config, model)
        results = self._judged(candidates, [*folds, half], progress)
        progress("", STEPS - 3 - len(candidates) * (FOLDS + 1))
        left_out = [[parts[log % FOLDS][log] for log in range(count)] for parts in results]
        error_n = np.array([[left.mae_n for left in one] for one in left_out]).T  # (logs, candidates)
        best = select_simplest(error_n)
        chosen, left = candidates[best], left_out[best]
        checkpoint = self._learned(chosen, left)
        progress(f"trained on all touches: {chosen.name}")
        recorded = join({path: read_log(path, load_checkpoint(checkpoint)) for path in self._logs})
        fit = _with_left_out(fit_correction(recorded.touches, COVERAGE), recorded, left)
        vision = config.vision.model_copy(update={"checkpoint": str(checkpoint)})
        run = ResolvedConfig(config.model_copy(update={"vision": vision}), read_model(checkpoint))
        profile, _ = make_profile(name, recorded, fit, run)
        progress("calibrated")
        before_n = float(np.mean([np.abs(one.raw_n - one.force_n).mean() for one in left_out[0]]))
        profile = profile.model_copy(
            update={
                "network": _NETWORK,
                "logs": self._digests,
                "version": __version__,
                "before_n": before_n,
            }
        )
        half_n = float(np.mean([one.mae_n for one in results[best][FOLDS].values()]))
        curve = [LearningCurvePoint(len(half), half_n, math.nan)]
        _write_bundle(out, checkpoint, profile, fit, recorded, curve)
        progress("wrote the bundle")
        mae_n = float(error_n.mean(0)[best])
        error, force_n = (
            np.concatenate(parts)
            for parts in zip(*((one.estimate_n - one.force_n, one.force_n) for one in left), strict=True)
        )
        return Taught(
            bundle=out,
            profile=profile,
            learned=chosen.name,
            candidates_mae_n={c.name: float(e) for c, e in zip(candidates, error_n.mean(0), strict=True)},
            before_n=before_n,
            mae_n=mae_n,
            contact_mae_n=float(np.abs(error[force_n > CONTACT_N]).mean()),
            half_mae_n=half_n,
            half_logs=len(half),
            more_touches_help=mae_n < _HELPS * half_n,
            without_contact=without_contact,
        )

    def _judged(
        self, candidates: Sequence[_Candidate], splits: Sequence[tuple[int, ...]], progress: Progress
    ) -> list[list[dict[int, _Left]]]:
        """Returns for each candidate and split the estimates of the logs left out, by the log's index."""
        tasks = []
        for candidate in candidates:
            # A network is trained for each split alone; all else is quick.
            groups = [(split,) for split in splits] if candidate.recipe == "touches" else [tuple(splits)]
            tasks += [self._task(candidate, group) for group in groups]
        missing = [task for task in tasks if not task.file.exists()]
        for task in tasks:
            if task not in missing:
                progress(f"{task.candidate.name}: known", len(task.splits))
        if self._workers == 1:
            for task in missing:
                _judge(task)
                progress(task.candidate.name, len(task.splits))
        else:
            with process_pool(self._workers) as pool:
                futures = {pool.submit(_judge_in_process, task): task for task in missing}
                for future in as_completed(futures):
                    future.result()
                    progress(futures[future].candidate.name, len(futures[future].splits))
        return [
            [part for task in tasks if task.candidate == candidate for part in _read(task)]
            for candidate in candidates
        ]

    def _task(self, candidate: _Candidate, splits: tuple[tuple[int, ...], ...]) -> _Task:
        digest = read_model(candidate.base).digest
        settings = recipe(candidate.recipe).model_dump_json() if candidate.recipe else ""
        parts = [candidate, digest, settings, splits, self._digests, [str(path) for path in self._replay]]
        key = sha256(json.dumps(parts).encode()).hexdigest()
        return _Task(candidate, self._logs, splits, self._replay, self._folder / f"{key[:16]}.left")

    def _learned(self, candidate: _Candidate, left: Sequence[_Left]) -> Path:
        """Returns the checkpoint of a candidate that has learned from all logs. Its error is that on logs left out."""
        task = self._task(candidate, (tuple(range(len(self._logs))),))
        checkpoint = task.file.with_suffix(".safetensors")
        if not checkpoint.exists():
            checkpoint.parent.mkdir(parents=True, exist_ok=True)
            part = checkpoint.with_name(f"all-{checkpoint.name}")
            made = _make(task, task.splits[0], part)
            raw_n, force_n = (
                np.concatenate([getattr(one, key) for one in left]) for key in ("raw_n", "force_n")
            )
            stated = {
                "residuals": residuals(raw_n, force_n),
                "metrics": {"mae_n": float(np.abs(raw_n - force_n).mean())},
                "ood": None,  # fitted to the recordings of the training; the profile has a limit
            }
            if candidate.recipe:
                replace_header(part, made.header.model_copy(update=stated), checkpoint)
                part.unlink()
            else:
                replace_header(candidate.base, made.header, checkpoint)
        return checkpoint


def select_simplest(error_n: Floats) -> int:
    """Returns the first candidate that is not worse than the best by more than one standard error.

    Args:
        error_n: MAE of each candidate on each log left out, (logs, candidates), from the simplest.
    """
    excess_n = error_n - error_n[:, [int(error_n.mean(0).argmin())]]
    return int(np.argmax(excess_n.mean(0) <= excess_n.std(0, ddof=1) / np.sqrt(len(error_n))))


def _candidates(config: Config, model: Model) -> list[_Candidate]:
    base = config.vision.checkpoint
    named = base if base in SHIPPED else Path(base).name
    found = [_Candidate(f"{named} as it is", base, "")]
    if not any(isinstance(member, ProcessConfig) for member in model.header.members):
        smaller = ["small"] if base == "default" else []
        found += [_Candidate(f"{Path(one).name}, trained", one, "touches") for one in (*smaller, base)]
    return [*found, _Candidate("Gaussian process", base, "few")]


def _judge_in_process(task: _Task) -> None:
    torch.set_num_threads(1)  # of this process of the pool; the processes share the cores
    _judge(task)


def _judge(task: _Task) -> None:
    """Makes the candidate for each split, calibrates it, and writes its estimates of the logs left out."""
    arrays: dict[str, Floats] = {}
    recorded: list[TouchRecording] = []
    task.file.parent.mkdir(parents=True, exist_ok=True)
    for number, (split, test) in enumerate(zip(task.splits, task.tests, strict=True)):
        file = task.file.with_suffix(f".{number}.safetensors")
        if task.candidate.recipe or not recorded:  # a network as it is sees the same in every split
            made = _make(task, split, file)
            recorded = [read_log(path, made) for path in task.logs]
        try:
            fit = fit_correction(join({task.logs[i]: recorded[i] for i in split}).touches, COVERAGE)
        except DataError:  # the estimates do not follow the load cell: they stay as they are
            fit = None
        for i in test:
            touches = recorded[i].touches
            left = _Left(
                touches.estimate_n,
                touches.estimate_n if fit is None else fit.predict(touches),
                touches.force_n,
                np.zeros(len(touches.force_n)) if fit is None else fit.arrays.ood_score(touches.features),
            )
            arrays |= {f"{number} {i} {key}": value for key, value in left._asdict().items()}
        file.unlink(missing_ok=True)
    write_all({task.file: save(arrays)})


def _read(task: _Task) -> list[dict[int, _Left]]:
    arrays = load(task.file.read_bytes())
    return [
        {i: _Left(*(arrays[f"{number} {i} {key}"] for key in _Left._fields)) for i in test}
        for number, test in enumerate(task.tests)
    ]


def _make(task: _Task, split: Sequence[int], file: Path) -> Checkpoint:
    """Returns the candidate that has learned from the logs of a split. A training continues if it was interrupted."""
    base = load_checkpoint(task.candidate.base)
    if not task.candidate.recipe:
        return base
    preprocess = base.header.preprocess
    clips = _clips(task.logs, preprocess.size, split)
    replayed = load_clips(list(task.replay), preprocess) if task.replay else []
    if task.candidate.recipe == "few":
        settings = recipe("few", [f"preprocess.size={preprocess.size}"])
        return train(settings, [*clips, *replayed], file)
    left_out = [i for i in range(len(task.logs)) if i not in split]
    unseen = _clips(task.logs, preprocess.size, left_out or split)
    return train(
        recipe("touches"),
        clips,
        file,
        validation_clips=unseen,
        init=base,
        replay_clips=replayed,
        resume=True,
    )


def _clips(logs: Sequence[Path], size: int, chosen: Sequence[int]) -> list[Clip]:
    """Returns clips of the chosen logs, each a set of its own."""
    clips = load_clips([logs[i] for i in chosen], Preprocess(size=size))
    return [replace(clip, set=f"{i} {clip.name}") for i, clip in enumerate(clips)]


def _has_contact(path: Path, model: Model) -> bool:
    (clip,) = load_clips([path], model.header.preprocess)
    return bool((clip.forces_n > CONTACT_N).any())


def _digest_of(path: Path) -> str:
    return sha256(path.read_bytes()).hexdigest()


def _with_left_out(fit: ObjectFit, recorded: TouchRecording, left: Sequence[_Left]) -> ObjectFit:
    """Replaces what a fit states about its own touches, which the network has seen, by what left-out logs show."""
    estimate_n = np.concatenate([one.estimate_n for one in left])
    touches = recorded.touches
    return replace(
        fit,
        cross_validated_n=estimate_n,
        after_n=float(np.abs(estimate_n - touches.force_n).mean()),
        interval=conformal_interval(estimate_n, touches.force_n, touches.touch, COVERAGE),
        ood_limit=fit_ood_limit([one.ood_score for one in left if one.ood_score.any()]),
    )


def _write_bundle(
    out: Path,
    checkpoint: Path,
    profile: ObjectProfile,
    fit: ObjectFit,
    recorded: TouchRecording,
    curve: Sequence[LearningCurvePoint],
) -> None:
    """Writes the folder of a bundle. An earlier one is replaced once the new one is complete."""
    part, old = out.with_name(f".{out.name}.part"), out.with_name(f".{out.name}.old")
    try:
        for folder in (part, old):
            shutil.rmtree(folder, ignore_errors=True)
        part.mkdir(parents=True)
        shutil.copyfile(checkpoint, part / _NETWORK)
        write_object(part / BUNDLED, profile, pack(fit.arrays))
        draw(profile, fit, recorded.touches, curve, part / "profile.png")
        if out.exists():
            out.rename(old)
        part.rename(out)
        shutil.rmtree(old, ignore_errors=True)
    except OSError as error:
        raise ConfigError(f"can't write the bundle {out}: {error.strerror}; name another folder") from error
