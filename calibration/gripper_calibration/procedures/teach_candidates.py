"""Candidates for the estimator of an object, compared on touches left out.

The candidates are, from the simplest: the configured network as it is, a network trained further on the touches, and a
Gaussian process fitted to them. The trained one is the configured one, or the small one instead of the default, which
costs five times as much a step and is no better (decision 32). Each candidate is calibrated as `calibrate_object` does
it. The logs of the touches are divided into folds; a fold is estimated by what was trained and calibrated on the
others. The simplest candidate that is about as good as the best is taken, as in `cross_validation`.

The expected error and the interval are nested, as in `cross_validation`: each fold is estimated by the candidate that
the other folds alone select, by trainings without that fold.
"""

import json
from collections.abc import Mapping, Sequence
from concurrent.futures import as_completed
from dataclasses import replace
from functools import partial
from hashlib import sha256
from itertools import combinations
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from safetensors.numpy import load, save

from gripper_calibration.fits.cross_validation import (
    Measured,
    estimate_left_out,
    select_simplest,
    touch_errors_n,
)
from gripper_calibration.fits.object_fit import COVERAGE, fit_correction
from gripper_calibration.fits.object_ood_fit import object_subspace
from gripper_calibration.fits.touches import Floats
from gripper_calibration.touch_logs import TouchRecording, join, read_log
from gripper_force.config import Config
from gripper_force.errors import DataError
from gripper_force.jobs.dataset import Clip, load_clips
from gripper_force.jobs.processes import process_pool
from gripper_force.jobs.profile_files import write_all
from gripper_force.jobs.training.recipe import recipe
from gripper_force.jobs.training.train import train
from gripper_force.progress import Progress
from gripper_force.vision.batch_inference import features
from gripper_force.vision.checkpoint import Checkpoint, load_checkpoint
from gripper_force.vision.header import SHIPPED, GaussianProcessConfig, Model
from gripper_force.vision.model_files import read_model
from gripper_force.vision.ood import residual_share
from gripper_force.vision.preprocess import Preprocess

MIN_LOGS: Final = 4
"""Fewer logs of touches can't be divided into halves that are calibrated."""

FOLDS: Final = 3
"""Parts of the logs, each left out once, and each two of them. More would take longer than a user waits."""


class LeftOut(NamedTuple):
    """Results on a log by what was made without it."""

    raw_n: Floats  # (N,), not corrected
    estimate_n: Floats  # (N,)
    force_n: Floats  # (N,), of the load cell
    share: Floats  # (N,), of the residual of the features, see `residual_share`
    touch: npt.NDArray[np.int64]  # (N,), number of the touch

    def last(self, frames: int) -> "LeftOut":
        """Returns the results on the last frames."""
        return LeftOut(*(values[-frames:] for values in self))  # type: ignore[arg-type]  # of two types


Results = Sequence[Mapping[frozenset[int], Mapping[int, LeftOut]]]
"""Results of each candidate, by the folds left out and the log."""


class Candidate(NamedTuple):
    """Network and recipe that an estimator is made of."""

    name: str
    base: str  # the network to begin with
    recipe: str  # name of the recipe of a training; empty for none


class _Task(NamedTuple):
    """A candidate, and the splits in which it is evaluated."""

    candidate: Candidate
    logs: tuple[Path, ...]
    splits: tuple[tuple[int, ...], ...]  # of each split the logs to learn from; all others are the test
    replay: tuple[Path, ...]
    file: Path  # of the result; the state of a training lies beside it

    @property
    def tests(self) -> list[list[int]]:
        return [[i for i in range(len(self.logs)) if i not in split] for split in self.splits]


class CandidateWork:
    """Makes candidates of logs of touches. Each part of the work leaves a file, and is not repeated."""

    def __init__(
        self, logs: Mapping[str, Path], replay: Mapping[str, Path], folder: Path, workers: int
    ) -> None:
        """Prepares the work.

        Args:
            logs: Logs of touches by their digest.
            replay: Logs of an earlier training by their digest, which are mixed in.
            folder: Folder of the parts of the work.
            workers: Processes; 1: everything runs in this one.

        Raises:
            DataError: There are fewer than `MIN_LOGS` logs.
        """
        if len(logs) < MIN_LOGS:
            raise DataError(
                f"there are {len(logs)} different logs of touches with contact, but teach leaves some out to compare, "
                f"and needs {MIN_LOGS}; touch the object more often, or use `gripper-force calibrate object`"
            )
        self.logs, self.digests, self._replay = tuple(logs.values()), tuple(logs), replay
        self._folder, self._workers = folder, workers

    def left_out(self, candidates: Sequence[Candidate], progress: Progress) -> Results:
        """Returns the results of the candidates on the logs left out."""
        outs = [frozenset(out) for n in (1, 2) for out in combinations(range(FOLDS), n)]
        splits = [tuple(i for i in range(len(self.logs)) if i % FOLDS not in out) for out in outs]
        tasks = []
        for candidate in candidates:
            # A network is trained for each split alone; all else is quick.
            groups = [(split,) for split in splits] if candidate.recipe == "touches" else [tuple(splits)]
            tasks += [self._task(candidate, group) for group in groups]
        open_tasks = [task for task in tasks if not task.file.exists()]
        for task in tasks:
            if task not in open_tasks:
                progress(f"{task.candidate.name}: known", len(task.splits))
        if self._workers == 1:
            for task in open_tasks:
                _evaluate(task)
                progress(task.candidate.name, len(task.splits))
        else:
            with process_pool(self._workers) as pool:
                futures = {pool.submit(_evaluate_in_process, task): task for task in open_tasks}
                for future in as_completed(futures):
                    future.result()
                    progress(futures[future].candidate.name, len(futures[future].splits))
        parts = [
            [part for task in tasks if task.candidate == candidate for part in _read(task)]
            for candidate in candidates
        ]
        return [dict(zip(outs, one, strict=True)) for one in parts]

    def _task(self, candidate: Candidate, splits: tuple[tuple[int, ...], ...]) -> _Task:
        digest = read_model(candidate.base).digest
        settings = recipe(candidate.recipe).model_dump_json() if candidate.recipe else ""
        parts = [candidate, digest, settings, splits, self.digests, tuple(self._replay), LeftOut._fields]
        key = sha256(json.dumps(parts).encode()).hexdigest()
        return _Task(
            candidate, self.logs, splits, tuple(self._replay.values()), self._folder / f"{key[:16]}.left"
        )

    def learned(self, candidate: Candidate) -> Path:
        """Returns the checkpoint of a candidate that has learned from all logs."""
        if not candidate.recipe:
            return read_model(candidate.base).path
        task = self._task(candidate, (tuple(range(len(self.logs))),))
        checkpoint = task.file.with_suffix(".safetensors")
        if not checkpoint.exists():
            part = checkpoint.with_name(f"all-{checkpoint.name}")
            _make(task, task.splits[0], part)
            part.rename(checkpoint)
        return checkpoint


class Comparison(NamedTuple):
    """Comparison of the candidates. The frames of all logs are in the order of the folds."""

    best: int  # the candidate to take
    error_n: Floats  # (candidates,), MAE without one fold
    fewer_n: Floats  # (candidates,), MAE without two folds
    left: list[LeftOut]  # results of the best candidate without one fold
    measured: Measured
    before_n: Floats  # (N,), by the configured network, not corrected
    estimate_n: Floats  # (N,), nested
    within: npt.NDArray[np.bool_]  # (N,), nested

    @property
    def absolute_error_n(self) -> Floats:
        """Size of the nested estimates' errors, (N,)."""
        return np.abs(self.estimate_n - self.measured.force_n)


def compare(results: Results, count: int) -> Comparison:
    """Compares candidates by their results on ``count`` logs left out."""
    folds = [[log for log in range(count) if log % FOLDS == fold] for fold in range(FOLDS)]
    # Networks with other reference frames have other first estimates; the last frames are the same.
    frames = [
        min(len(part[log].force_n) for one in results for part in one.values() if log in part)
        for log in range(count)
    ]

    def left(candidate: int, fold: int, other: int) -> list[LeftOut]:
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
    return Comparison(
        best,
        error_n.mean(0),
        fewer_n.mean(0),
        [one for i in each for one in left(best, i, i)],
        Measured(*(np.concatenate(values) for values in zip(*parts, strict=True))),
        np.concatenate([joined("raw_n", 0, i, i) for i in each]),
        np.concatenate(nested_n),
        np.concatenate(within),
    )


def make_candidates(config: Config, model: Model, logs: int) -> list[Candidate]:
    """Returns the candidates for a number of logs, beginning with the configured network ``model`` as it is."""
    base = config.vision.checkpoint
    network_name = base if base in SHIPPED else Path(base).name
    candidates = [Candidate(f"{network_name} as it is", base, "")]
    if not any(isinstance(member, GaussianProcessConfig) for member in model.header.members):
        trained = "small" if base == "default" else base
        candidates.append(Candidate(f"{Path(trained).name}, trained", trained, "touches"))
    if logs >= 2 * FOLDS:  # a process chooses its settings on logs left out, and so needs two in a fold
        candidates.append(Candidate("Gaussian process", base, "few"))
    return candidates


def _evaluate_in_process(task: _Task) -> None:
    torch.set_num_threads(1)  # of this process of the pool; the processes share the cores
    _evaluate(task)


def _evaluate(task: _Task) -> None:
    """Makes the candidate for each split, calibrates it, and writes its estimates of the logs left out."""
    arrays: dict[str, npt.NDArray[Any]] = {}
    recordings: list[TouchRecording] = []
    task.file.parent.mkdir(parents=True, exist_ok=True)
    for number, (split, test) in enumerate(zip(task.splits, task.tests, strict=True)):
        file = task.file.with_suffix(f".{number}.safetensors")
        if task.candidate.recipe or not recordings:  # a network as it is sees the same in every split
            checkpoint = _make(task, split, file)
            run = partial(features, checkpoint.networks, checkpoint.header.preprocess)
            recordings = [read_log(path, checkpoint.header.preprocess, run) for path in task.logs]
        learned_touches = join({task.logs[i]: recordings[i] for i in split}).touches
        subspace = object_subspace(learned_touches)
        try:
            fit = fit_correction(learned_touches, COVERAGE)
        except DataError:  # the estimates do not follow the load cell: they stay as they are
            fit = None
        begins = np.cumsum([0, *(len(one.touches.numbers) for one in recordings)])
        for i in test:
            touches = recordings[i].touches
            result = LeftOut(
                touches.estimate_n,
                touches.estimate_n if fit is None else fit.predict(touches),
                touches.force_n,
                residual_share(touches.features, *subspace),
                touches.touch + begins[i],
            )
            arrays |= {f"{number} {i} {key}": value for key, value in result._asdict().items()}
        file.unlink(missing_ok=True)
    write_all({task.file: save(arrays)})


def _read(task: _Task) -> list[dict[int, LeftOut]]:
    arrays = load(task.file.read_bytes())
    return [
        {i: LeftOut(*(arrays[f"{number} {i} {key}"] for key in LeftOut._fields)) for i in test}
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


def _clips(logs: Sequence[Path], size: int, indices: Sequence[int]) -> list[Clip]:
    """Returns clips of the chosen logs, each a set of its own."""
    clips = load_clips([logs[i] for i in indices], Preprocess(size=size))
    return [replace(clip, set=f"{i} {clip.name}") for i, clip in enumerate(clips)]
