"""Teaching of an object: the estimator that is best on touches left out, calibrated, in one bundle.

The candidates are, from the simplest: the configured network as it is, a network trained further on the touches, and a
Gaussian process fitted to them. The trained one is the configured one, or the small one instead of the default, which
costs five times as much a step and is no better (decision 32). Each candidate is calibrated as `calibrate_object` does
it. The logs of the touches are divided into folds; a fold is estimated by what was trained and calibrated on the
others. The simplest candidate that is about as good as the best is taken, as in `cross_validation`, trained on all
touches, and calibrated.

The expected error and the interval are nested, as in `cross_validation`: each fold is estimated by the candidate that
the other folds alone select, by trainings without that fold.
"""

import json
import shutil
from collections.abc import Mapping, Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass, replace
from hashlib import sha256
from itertools import combinations, islice
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from safetensors.numpy import load, save

from gripper_calibration.fits.cross_validation import (
    Coverage,
    Measured,
    coverages,
    estimate_left_out,
    select_simplest,
    touch_errors_n,
)
from gripper_calibration.fits.interval_fit import touch_interval
from gripper_calibration.fits.object_fit import COVERAGE, fit_correction
from gripper_calibration.fits.object_ood_fit import left_out_shares, object_limits, object_subspace
from gripper_calibration.fits.touches import Floats
from gripper_calibration.plots.taught_plot import draw
from gripper_calibration.procedures.calibrate_object import (
    default_folder,
    make_profile,
    record_touches,
)
from gripper_calibration.touch_logs import TouchRecording, join, read_log, started_ns
from gripper_force import __version__
from gripper_force.config import Config, config_from_text
from gripper_force.errors import ConfigError, DataError
from gripper_force.jobs.dataset import CONTACT_N, Clip, StreamedClip, find_logs, load_clips, starts_in_contact
from gripper_force.jobs.processes import process_pool
from gripper_force.jobs.profile_files import check_place, pack, write_all, write_object
from gripper_force.jobs.recording.record import check_name
from gripper_force.jobs.training.ood_fit import model_of_scores
from gripper_force.jobs.training.recipe import recipe
from gripper_force.jobs.training.stated_errors import errors, residuals
from gripper_force.jobs.training.train import train
from gripper_force.profiles.correction import KnownFrames, ProfileArrays
from gripper_force.profiles.object_profile import BUNDLED, ObjectProfile, read_object, user_folder
from gripper_force.progress import Progress, Prompt, no_progress
from gripper_force.runtime.log_reader import LogReader
from gripper_force.runtime.resolve import ResolvedConfig, resolve_vision
from gripper_force.types import Frame, LoadCellSample
from gripper_force.vision.checkpoint import Checkpoint, load_checkpoint
from gripper_force.vision.checkpoint_writer import replace_header
from gripper_force.vision.estimator import claimed_std_n
from gripper_force.vision.header import SHIPPED, GaussianProcessConfig, Header, Model
from gripper_force.vision.model_files import read_model
from gripper_force.vision.ood import residual_share
from gripper_force.vision.preprocess import Preprocess

TOUCHES: Final = 16
"""Default number of touches."""

MIN_LOGS: Final = 4
"""Fewer logs of touches can't be divided into halves that are calibrated."""

FOLDS: Final = 3
"""Parts of the logs, each left out once, and each two of them. More would take longer than a user waits."""

STEPS: Final = 3 * 2 * FOLDS + 3
"""Steps of progress that `teach` reports after the touches: three candidates, without one fold and without two."""

_HELPS: Final = 0.85
"""More touches help if the error after two of three folds is less than this share of that after one."""

_FRAMES_AFTER: Final = 10
"""Frames after the reference frames until whose time the load cell's samples of these are in a log."""

_NETWORK: Final = "network.safetensors"
_FIGURE: Final = "teach.png"


@dataclass(frozen=True, slots=True)
class Taught:
    """Result of `teach`.

    Attributes:
        bundle: Folder with network, profile and figure. A grasp of the object uses it.
        profile: The profile in it.
        learned: Name of the selected candidate, one of the keys of `candidates_mae_n`.
        candidates_mae_n: MAE of each candidate on touches left out, after it has learned from the other two thirds.
        before_n: MAE of the configured network without calibration.
        mae_n: Expected MAE, on touches that took no part in the selection of the candidate either.
        contact_mae_n: The same, of the frames in contact.
        fewer_mae_n: MAE of the selected candidate after it has learned from one third of the touches.
        more_touches_help: True if the error still falls clearly with the number of touches.
        coverages: Share of the frames of each touch within an interval that the other folds gave: in contact, and by
            force level.
        without_contact: Logs that were not used because they show no contact.
        contact_starts: Logs that were not used because they start in contact.
    """

    bundle: Path
    profile: ObjectProfile
    learned: str
    candidates_mae_n: dict[str, float]
    before_n: float
    mae_n: float
    contact_mae_n: float
    fewer_mae_n: float
    more_touches_help: bool
    coverages: tuple[Coverage, ...]
    without_contact: tuple[Path, ...]
    contact_starts: tuple[Path, ...]

    @property
    def figure(self) -> Path:
        """The figure, PNG."""
        return self.bundle / _FIGURE


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
    out = (user_folder() / name if out is None else Path(out)).absolute()
    place = default_folder(name) if folder is None else Path(folder)
    config, model = check_before_touches(config, name, out)
    if logs is None:
        named = config.with_values(object=name)
        paths = []
        for path in record_touches(named, touches, peak_n, place, prompt=prompt, progress=progress):
            paths.append(path)
            progress(f"touch {len(paths)} of {touches}")
    else:
        paths = find_logs(logs)
    used, without_contact, contact_starts = _sorted_by_contact(paths, model)
    # The same touch in two folds would be both learned and left out.
    logs_by_digest = {_digest_of(path): path for path in used}
    # A touch that is replayed would be learned where it is left out.
    replayed = {} if not replay else {_digest_of(path): path for path in find_logs(replay)}
    others = {digest: path for digest, path in replayed.items() if digest not in logs_by_digest}
    in_contact = [path for path in others.values() if _starts_in_contact(path, model.header.preprocess)]
    others = {digest: path for digest, path in others.items() if path not in in_contact}
    work = _Work(logs_by_digest, others, place / "teach", workers)
    taught = work.run(config, model, name, out, progress)
    return replace(taught, without_contact=without_contact, contact_starts=(*contact_starts, *in_contact))


def check_before_touches(config: Config, name: str, out: Path) -> tuple[Config, Model]:
    """Checks what `teach` needs before the first touch.

    Args:
        config: The configuration.
        name: Name of the object.
        out: Folder of the bundle.

    Returns:
        The configuration with the choice of the network made, and the network to begin with.

    Raises:
        ConfigError: There is no network, the name can't be part of a file name, the bundle can't be written, or it is
            that of another object.
        CheckpointError: The network can't be read.
    """
    check_name(name)
    out = out.absolute()  # `.` has a name then
    if out.exists() and not (out / BUNDLED).is_file():
        raise ConfigError(f"{out} exists and is not a bundle; name another folder")
    file = _object_file(config)
    if file is not None and out.exists() and (other := _file_of(out)) not in (None, file):
        raise ConfigError(
            f"the bundle {out} is that of the object in {other}, not of {file}; rename one of the files, or name "
            "another folder with --out"
        )
    check_place(out.with_name(f"{out.name}.yaml"))
    config, model, _ = resolve_vision(config)
    if model is None:
        raise ConfigError("teach needs a network to begin with; set vision.checkpoint, such as to default")
    return config, model


def _file_of(bundle: Path) -> str | None:
    """Returns the path of the simulated object's file that a bundle is of; None for an object known by name."""
    try:
        return read_object(bundle / BUNDLED).file
    except ConfigError as error:
        raise ConfigError(
            f"the bundle {bundle} can't be read, so it may be that of another object; move it away, or name another "
            f"folder with --out ({error})"
        ) from error


def _object_file(config: Config) -> str | None:
    """Returns the path of a simulated object's file; None for an object known by name."""
    return None if config.sim.object is None else str(config.sim.object.resolve())


class _Left(NamedTuple):
    """Results on a log by what was made without it."""

    raw_n: Floats  # (N,), not corrected
    estimate_n: Floats  # (N,)
    force_n: Floats  # (N,), of the load cell
    share: Floats  # (N,), of the residual of the features, see `residual_share`
    touch: npt.NDArray[np.int64]  # (N,), number of the touch

    def last(self, frames: int) -> "_Left":
        """Returns the results on the last frames."""
        return _Left(*(values[-frames:] for values in self))  # type: ignore[arg-type]  # of two types


_Results = Sequence[Mapping[frozenset[int], Mapping[int, _Left]]]
"""Results of each candidate, by the folds left out and the log."""


class _Candidate(NamedTuple):
    """Network and recipe that an estimator is made of."""

    name: str
    base: str  # the network to begin with
    recipe: str  # name of the recipe of a training; empty for none


class _Task(NamedTuple):
    """A candidate, and the splits in which it is judged."""

    candidate: _Candidate
    logs: tuple[Path, ...]
    splits: tuple[tuple[int, ...], ...]  # of each split the logs to learn from; all others are the test
    replay: tuple[Path, ...]
    file: Path  # of the result; the state of a training lies beside it

    @property
    def tests(self) -> list[list[int]]:
        return [[i for i in range(len(self.logs)) if i not in split] for split in self.splits]


class _Work:
    """The work after the touches. Each part of it leaves a file, and is not repeated."""

    def __init__(
        self, logs: Mapping[str, Path], replay: Mapping[str, Path], folder: Path, workers: int
    ) -> None:
        if len(logs) < MIN_LOGS:
            raise DataError(
                f"there are {len(logs)} different logs of touches with contact, but teach leaves some out to compare, "
                f"and needs {MIN_LOGS}; touch the object more often, or use `gripper-force calibrate object`"
            )
        self._logs, self._digests, self._replay = tuple(logs.values()), tuple(logs), replay
        self._folder, self._workers = folder, workers

    def run(
        self,
        config: Config,
        model: Model,
        name: str,
        out: Path,
        progress: Progress,
    ) -> Taught:
        candidates = _candidates(config, model, len(self._logs))
        results = self._judged(candidates, progress)
        found = _compare(results, len(self._logs))
        progress("compared the candidates", STEPS - 3 - 2 * FOLDS * len(candidates))
        chosen = candidates[found.best]
        checkpoint = self._learned(chosen)
        progress(f"trained on all touches: {chosen.name}")
        learned = load_checkpoint(checkpoint)
        recorded = join({path: read_log(path, learned) for path in sorted(self._logs, key=started_ns)})
        # The folds' networks have not seen the touches they score, but each network has its own scale of scores.
        shares, estimates_n = left_out_shares(recorded.touches)
        limits = object_limits(
            [one.share for one in found.left] + shares,
            [one.raw_n for one in found.left] + estimates_n,
            touches=len(shares),
        )
        known = KnownFrames(*object_subspace(recorded.touches), limits)
        fit = fit_correction(recorded.touches, COVERAGE)
        error_n, contact = (
            np.abs(found.estimate_n - found.measured.force_n),
            found.measured.force_n > CONTACT_N,
        )
        mae_n, contact_mae_n = float(error_n.mean()), float(error_n[contact].mean())
        fit = replace(
            fit,
            arrays=replace(fit.arrays, known=known),
            interval=touch_interval(found.estimate_n, *found.measured, COVERAGE),
            before_n=float(np.abs(found.before_n - found.measured.force_n).mean()),
            after_n=mae_n,
        )
        config = config.with_values(vision={"checkpoint": str(checkpoint)})
        resolved = ResolvedConfig(config, read_model(checkpoint))
        profile, _ = make_profile(name, recorded, fit, resolved)
        profile = profile.model_copy(
            update={
                "network": _NETWORK,
                "logs": self._digests,
                "version": __version__,
                "file": _object_file(config),
            }
        )
        progress("calibrated")
        taught = Taught(
            bundle=out,
            profile=profile,
            learned=chosen.name,
            candidates_mae_n={c.name: float(e) for c, e in zip(candidates, found.error_n, strict=True)},
            before_n=fit.before_n,
            mae_n=mae_n,
            contact_mae_n=contact_mae_n,
            fewer_mae_n=float(found.fewer_n[found.best]),
            more_touches_help=bool(found.error_n[found.best] < _HELPS * found.fewer_n[found.best]),
            coverages=coverages(found.measured, found.within),
            without_contact=(),
            contact_starts=(),
        )
        header = _stated(learned.header, chosen, known, found.left)
        _write_bundle(taught, checkpoint, header, fit.arrays, found)
        progress("wrote the bundle")
        return taught

    def _judged(self, candidates: Sequence[_Candidate], progress: Progress) -> _Results:
        """Returns the results of the candidates on the logs left out."""
        outs = [frozenset(out) for n in (1, 2) for out in combinations(range(FOLDS), n)]
        splits = [tuple(i for i in range(len(self._logs)) if i % FOLDS not in out) for out in outs]
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
        parts = [
            [part for task in tasks if task.candidate == candidate for part in _read(task)]
            for candidate in candidates
        ]
        return [dict(zip(outs, one, strict=True)) for one in parts]

    def _task(self, candidate: _Candidate, splits: tuple[tuple[int, ...], ...]) -> _Task:
        digest = read_model(candidate.base).digest
        settings = recipe(candidate.recipe).model_dump_json() if candidate.recipe else ""
        parts = [candidate, digest, settings, splits, self._digests, tuple(self._replay), _Left._fields]
        key = sha256(json.dumps(parts).encode()).hexdigest()
        return _Task(
            candidate, self._logs, splits, tuple(self._replay.values()), self._folder / f"{key[:16]}.left"
        )

    def _learned(self, candidate: _Candidate) -> Path:
        """Returns the checkpoint of a candidate that has learned from all logs."""
        if not candidate.recipe:
            return read_model(candidate.base).path
        task = self._task(candidate, (tuple(range(len(self._logs))),))
        checkpoint = task.file.with_suffix(".safetensors")
        if not checkpoint.exists():
            part = checkpoint.with_name(f"all-{checkpoint.name}")
            _make(task, task.splits[0], part)
            part.rename(checkpoint)
        return checkpoint


class _Compared(NamedTuple):
    """Comparison of the candidates. The frames of all logs are in the order of the folds."""

    best: int  # the candidate to take
    error_n: Floats  # (candidates,), MAE without one fold
    fewer_n: Floats  # (candidates,), MAE without two folds
    left: list[_Left]  # results of the best candidate without one fold
    measured: Measured
    before_n: Floats  # (N,), by the configured network, not corrected
    estimate_n: Floats  # (N,), nested
    within: npt.NDArray[np.bool_]  # (N,), nested


def _compare(results: _Results, count: int) -> _Compared:
    folds = [[log for log in range(count) if log % FOLDS == fold] for fold in range(FOLDS)]
    # Networks with other reference frames have other first estimates; the last frames are the same.
    frames = [
        min(len(part[log].force_n) for one in results for part in one.values() if log in part)
        for log in range(count)
    ]

    def left(candidate: int, fold: int, other: int) -> list[_Left]:
        part = results[candidate][frozenset((fold, other))]
        return [part[log].last(frames[log]) for log in folds[fold]]

    def joined(key: str, candidate: int, fold: int, other: int) -> Floats:
        return np.concatenate([getattr(one, key) for one in left(candidate, fold, other)])

    each = range(FOLDS)
    parts = [Measured(joined("force_n", 0, i, i), joined("touch", 0, i, i).astype(np.int64)) for i in each]
    estimates_n = {
        (i, j): np.stack([joined("estimate_n", one, i, j) for one in range(len(results))])
        for i in each
        for j in each
    }
    error_n, fewer_n = (
        np.concatenate(
            [touch_errors_n(estimates_n[i, j], parts[i]) for i in each for j in each if (i == j) == same]
        )
        for same in (True, False)
    )
    nested_n, within = estimate_left_out(estimates_n, parts, COVERAGE)
    best = select_simplest(error_n)
    return _Compared(
        best,
        error_n.mean(0),
        fewer_n.mean(0),
        [one for i in each for one in left(best, i, i)],
        Measured(*(np.concatenate(values) for values in zip(*parts, strict=True))),
        np.concatenate([joined("raw_n", 0, i, i) for i in each]),
        np.concatenate(nested_n),
        np.concatenate(within),
    )


def _candidates(config: Config, model: Model, logs: int) -> list[_Candidate]:
    base = config.vision.checkpoint
    named = base if base in SHIPPED else Path(base).name
    found = [_Candidate(f"{named} as it is", base, "")]
    if not any(isinstance(member, GaussianProcessConfig) for member in model.header.members):
        trained = "small" if base == "default" else base
        found.append(_Candidate(f"{Path(trained).name}, trained", trained, "touches"))
    if logs >= 2 * FOLDS:  # a process chooses its settings on logs left out, and so needs two in a fold
        found.append(_Candidate("Gaussian process", base, "few"))
    return found


def _judge_in_process(task: _Task) -> None:
    torch.set_num_threads(1)  # of this process of the pool; the processes share the cores
    _judge(task)


def _judge(task: _Task) -> None:
    """Makes the candidate for each split, calibrates it, and writes its estimates of the logs left out."""
    arrays: dict[str, npt.NDArray[Any]] = {}
    recorded: list[TouchRecording] = []
    task.file.parent.mkdir(parents=True, exist_ok=True)
    for number, (split, test) in enumerate(zip(task.splits, task.tests, strict=True)):
        file = task.file.with_suffix(f".{number}.safetensors")
        if task.candidate.recipe or not recorded:  # a network as it is sees the same in every split
            made = _make(task, split, file)
            recorded = [read_log(path, made) for path in task.logs]
        known = join({task.logs[i]: recorded[i] for i in split}).touches
        subspace = object_subspace(known)
        try:
            fit = fit_correction(known, COVERAGE)
        except DataError:  # the estimates do not follow the load cell: they stay as they are
            fit = None
        begins = np.cumsum([0, *(len(one.touches.numbers) for one in recorded)])
        for i in test:
            touches = recorded[i].touches
            left = _Left(
                touches.estimate_n,
                touches.estimate_n if fit is None else fit.predict(touches),
                touches.force_n,
                residual_share(touches.features, *subspace),
                touches.touch + begins[i],
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
    return train(
        recipe("touches"),
        clips,
        file,
        validation_clips=clips[:1],  # the errors of the folds replace what the checkpoint states
        init=base,
        replay_clips=replayed,
        resume=True,
        figure=False,
    )


def _clips(logs: Sequence[Path], size: int, chosen: Sequence[int]) -> list[Clip]:
    """Returns clips of the chosen logs, each a set of its own."""
    clips = load_clips([logs[i] for i in chosen], Preprocess(size=size))
    return [replace(clip, set=f"{i} {clip.name}") for i, clip in enumerate(clips)]


def _sorted_by_contact(
    paths: Sequence[Path], model: Model
) -> tuple[list[Path], tuple[Path, ...], tuple[Path, ...]]:
    """Returns the logs that can be used, those without contact, and those that start in contact."""
    used, without_contact, contact_starts = [], [], []
    for path in paths:
        (clip,) = load_clips([path], model.header.preprocess)
        if starts_in_contact(clip.forces_n, model.header.preprocess):
            contact_starts.append(path)
        elif (clip.forces_n > CONTACT_N).any():
            used.append(path)
        else:
            without_contact.append(path)
    return used, tuple(without_contact), tuple(contact_starts)


def _starts_in_contact(path: Path, preprocess: Preprocess) -> bool:
    """Returns `starts_in_contact` of a log, of which only the first frames are read: a training reads all of it."""
    reader = LogReader(path)
    config = config_from_text(reader.config, str(path))
    streamed = StreamedClip(reader, config, reader.records(Frame, LoadCellSample), preprocess)
    for _ in islice(streamed.frames(), preprocess.reference_frames + _FRAMES_AFTER):
        pass
    try:
        clip = streamed.clip(streamed.no_images)
        is_whole = bool(clip.valid[: preprocess.reference_frames].all())
    except DataError:
        is_whole = False
    if not is_whole:  # the labels may come later in the log, or never
        (clip,) = load_clips([path], preprocess)
    return starts_in_contact(clip.forces_n, preprocess)


def _digest_of(path: Path) -> str:
    return sha256(path.read_bytes()).hexdigest()


def _stated(header: Header, candidate: _Candidate, known: KnownFrames, left: Sequence[_Left]) -> Header:
    """Returns a header with the errors, and the out-of-distribution score, that logs left out show."""
    raw_n, force_n = (np.concatenate([getattr(one, key) for one in left]) for key in ("raw_n", "force_n"))
    if candidate.recipe:
        stated = {"residuals": residuals(raw_n, force_n), "metrics": errors(raw_n, force_n), "ood": None}
        header = header.model_copy(update=stated)
    if header.ood is None:
        z = (raw_n - force_n) / claimed_std_n(header, raw_n[None])
        scored = [one.share for one in left], [one.raw_n for one in left]
        ood = model_of_scores(known, *scored, z, force_n > CONTACT_N)
        header = header.model_copy(update={"ood": ood})
    return header


def _write_bundle(
    taught: Taught, checkpoint: Path, header: Header, arrays: ProfileArrays, found: _Compared
) -> None:
    """Writes the folder of a bundle. An earlier one is replaced once the new one is complete."""
    out = taught.bundle
    part, old = out.with_name(f".{out.name}.part"), out.with_name(f".{out.name}.old")
    try:
        if old.exists() and not out.exists():  # an earlier replacement was interrupted
            old.rename(out)
        for folder in (part, old):
            shutil.rmtree(folder, ignore_errors=True)
        part.mkdir(parents=True)
        replace_header(checkpoint, header, part / _NETWORK)
        write_object(part / BUNDLED, taught.profile, pack(arrays))
        draw(
            taught.profile,
            found.measured.force_n,
            found.before_n,
            found.estimate_n,
            taught.coverages,
            {
                name: ends
                for name, *ends in zip(taught.candidates_mae_n, found.fewer_n, found.error_n, strict=True)
            },
            taught.learned,
            part / _FIGURE,
        )
        try:
            if out.exists():
                out.rename(old)
            part.rename(out)
        except BaseException:
            if old.exists() and not out.exists():
                old.rename(out)
            raise
        shutil.rmtree(old, ignore_errors=True)
    except OSError as error:
        raise ConfigError(f"can't write the bundle {out}: {error.strerror}; name another folder") from error
