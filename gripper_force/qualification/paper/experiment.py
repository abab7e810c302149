"""Trains the networks of the requested models with each seed, and estimates the test sets with each."""

import functools
import hashlib
import math
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import TimeoutError as FutureTimeout
from concurrent.futures import as_completed
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
import torch
from scipy import stats

from gripper_force.config import load_config
from gripper_force.errors import DataError
from gripper_force.files import unfinished
from gripper_force.jobs.dataset import CONTACT_N, Clip, load_clips
from gripper_force.jobs.estimates import estimate_clips
from gripper_force.jobs.paper_protocol import RATE_HZ, SetPlan, plan_protocol
from gripper_force.jobs.processes import process_pool
from gripper_force.jobs.simulate import simulate
from gripper_force.jobs.training.train import train
from gripper_force.progress import Progress
from gripper_force.qualification.paper.models import MODELS, Scale
from gripper_force.vision.checkpoint import load_checkpoint
from gripper_force.vision.preprocess import Preprocess

Floats = npt.NDArray[np.float64]

_ANY_NET: Final = "plain"
"""All networks of a scale share their preprocessing; this one stands for them."""

_GPU_BYTES: Final = 6 * 2**30
"""Memory of a GPU for one network besides its training sets, with room: about 2.5 GiB were seen at full scale."""

_MIN_SETS: Final = 6
"""Fewest test sets with which a signed-rank test can reach p < 0.05."""


@dataclass(frozen=True, eq=False)
class Test:
    """Labelled frames of the test sets, and the estimates of each trained network.

    Attributes:
        scale: Size of the reproduction.
        clips: Logs of the test sets.
        measured_n: Load-cell forces, (N,).
        clip: Index of each frame's log in ``clips``, (N,).
        object: Each frame's object, (N,).
        estimates_n: Estimates by network and seed, (N,) each; without the networks that are not trained yet.
    """

    scale: Scale
    clips: Sequence[Clip]
    measured_n: Floats
    clip: npt.NDArray[np.int64]
    object: npt.NDArray[np.str_]
    estimates_n: dict[tuple[str, int], Floats]

    def seeds_of(self, *models: str) -> list[int]:
        """Seeds with which all networks of these models are trained; those of one ensemble must be different."""

        def is_trained(model: str, seed: int) -> bool:
            members = self._members(model, seed)
            return len(set(members)) == len(members) and self.estimates_n.keys() >= set(members)

        return [seed for seed in range(self.scale.seeds) if all(is_trained(model, seed) for model in models)]

    def _members(self, model: str, seed: int) -> list[tuple[str, int]]:
        return [(net, (seed + i) % self.scale.seeds) for i, net in enumerate(MODELS[model])]

    def estimate_n(self, model: str, seed: int) -> Floats:
        """Estimates of a model in N, (N,): the mean over its networks, with consecutive seeds."""
        mean_n: Floats = np.mean([self.estimates_n[pair] for pair in self._members(model, seed)], axis=0)
        return mean_n

    def absolute_n(self, model: str, *others: str) -> Floats:
        """Absolute errors in N with each seed that the model and the others have, (seeds, N)."""
        seeds = self.seeds_of(model, *others)
        return np.abs([self.estimate_n(model, seed) - self.measured_n for seed in seeds])

    def mae_n(self, model: str, *others: str) -> Floats:
        """MAE over all frames with each seed that the model and the others have, (seeds,)."""
        mean: Floats = self.absolute_n(model, *others).mean(1)
        return mean

    def rmse_n(self, model: str) -> Floats:
        """RMSE over all frames with each seed, (seeds,)."""
        root: Floats = np.sqrt(np.square(self.absolute_n(model)).mean(1))
        return root

    def mae_by_set_n(self, model: str, *others: str) -> Floats:
        """MAE of each test set, over its frames and all seeds that the model and the others have, (sets,)."""
        frame_n = self.absolute_n(model, *others).mean(0)
        sets = self.set_of_clip[self.clip]
        return np.array([frame_n[sets == i].mean() for i in np.unique(sets)])

    def p_value(self, model: str, other: str) -> float:
        """Two-sided p-value of Wilcoxon's signed-rank test of the two models' MAE, paired by test set.

        It is NaN with fewer than 6 sets.
        """
        a, b = self.mae_by_set_n(model, other), self.mae_by_set_n(other, model)
        if len(a) < _MIN_SETS or (a == b).all():
            return float("nan")
        return float(stats.wilcoxon(a, b).pvalue)

    @property
    def set_of_clip(self) -> npt.NDArray[np.int64]:
        """Number of each log's set, from 0, (clips,).

        All light levels of a simulation are one set: they show the same touches, so they are not independent.
        """
        names = [f"{clip.object} {clip.set}" for clip in self.clips]
        return np.unique(names, return_inverse=True)[1].astype(np.int64)

    @property
    def contact(self) -> npt.NDArray[np.bool_]:
        """True for frames in contact, (N,)."""
        return self.measured_n > CONTACT_N


def missing_logs(scale: Scale, data: Path) -> int:
    """Number of logs of the protocol that do not exist yet."""
    names = (name for plan in _plans(scale) for name in plan.names)
    return sum(not (data / name).exists() for name in names)


def simulate_missing(scale: Scale, data: Path, workers: int, end_s: float, progress: Progress) -> None:
    """Simulates the logs of the protocol that do not exist yet. Raises as `simulate.simulate` does.

    Args:
        scale: Size of the reproduction.
        data: Folder for the logs.
        workers: Processes.
        end_s: Time of `time.monotonic` after which no log is awaited.
        progress: Called after each log.
    """
    config = load_config(None, [f"camera.rate_hz={RATE_HZ}"])
    with closing(simulate(_plans(scale), data, config, workers)) as paths:
        for path in paths:
            progress(path.name)
            if time.monotonic() > end_s:
                return


def _plans(scale: Scale) -> list[SetPlan]:
    return plan_protocol(scale.protocol, scale.instances)


def run(
    scales: Sequence[Scale],
    models: Iterable[str],
    data: Path,
    out: Path,
    workers: int,
    end_s: float,
    progress: Progress,
) -> list[Test]:
    """Trains the missing networks of the models, and estimates the test sets with each network.

    Args:
        scales: Sizes of the reproduction, which differ only in their steps.
        models: Names in `MODELS`.
        data: Folder with the protocol's logs, in ``train`` and ``test``.
        out: Folder for the networks. Those of the same recipe and data are not trained again, and interrupted
            trainings continue.
        workers: Processes; each trains one network, with one thread. On a GPU no more than its memory holds.
        end_s: Time of `time.monotonic` at which training is interrupted.
        progress: Called after each network, with its steps.

    Returns:
        The tests, one for each scale, with the estimates of all networks trained so far.

    Raises:
        DataError: There are no logs of the protocol.
    """
    files = _Files(out, data, _digest(data))
    # Ordered by length and seed, so that an interrupted run has all networks with the first seeds.
    tasks = [
        (scale, net, seed) for scale in scales for seed in range(scale.seeds) for net in networks(models)
    ]
    missing = [task for task in tasks if not files.estimates(*task).exists()]
    for task in tasks:
        if task not in missing:
            progress(_text(task), task[0].steps)
    preprocess = scales[0].recipe(_ANY_NET, 0).preprocess
    clips = _clips(files, "test", preprocess, workers)
    if missing:
        if torch.cuda.is_available():
            workers = min(workers, _networks_in_gpu(clips, len(_logs(data, "train"))))
        _train_all(missing, files, workers, end_s, progress)
    keep = [clip.labelled(preprocess.lead_in) for clip in clips]
    measured_n = np.concatenate([clip.forces_n[k] for clip, k in zip(clips, keep, strict=True)])
    counts = [int(k.sum()) for k in keep]
    estimates_n: dict[Scale, dict[tuple[str, int], Floats]] = {scale: {} for scale in scales}
    for scale, net, seed in tasks:
        if (path := files.estimates(scale, net, seed)).exists():
            estimates_n[scale][net, seed] = _load_estimates(path, len(measured_n))
    return [
        Test(
            scale=scale,
            clips=clips,
            measured_n=measured_n.astype(np.float64),
            clip=np.repeat(np.arange(len(clips)), counts),
            object=np.repeat([clip.object for clip in clips], counts),
            estimates_n=estimates_n[scale],
        )
        for scale in scales
    ]


def networks(models: Iterable[str]) -> list[str]:
    """Names of the networks of models, each once."""
    return list(dict.fromkeys(net for model in models for net in MODELS[model]))


def checkpoint_path(out: Path, data: Path, scale: Scale, net: str, seed: int) -> Path:
    """Path of the checkpoint of a network that was trained on these data."""
    return _Files(out, data, _digest(data)).checkpoint(scale, net, seed)


_Task = tuple[Scale, str, int]
"""Scale, network and seed of a training."""


def _text(task: _Task) -> str:
    scale, net, seed = task
    return f"{net}, seed {seed}, {scale.steps:,} steps"


@dataclass(frozen=True)
class _Files:
    """Files of the networks. Their names have a key of the recipe and the data, so that none is used for others."""

    out: Path
    data: Path
    digest: str

    def checkpoint(self, scale: Scale, net: str, seed: int) -> Path:
        recipe = scale.recipe(net, seed).model_dump_json(exclude={"device", "compile"})
        key = hashlib.sha256(f"{recipe} {self.digest}".encode()).hexdigest()
        return self.out / f"{net}-{seed}-{key[:16]}.safetensors"

    def estimates(self, scale: Scale, net: str, seed: int) -> Path:
        return self.checkpoint(scale, net, seed).with_suffix(".npy")


def _digest(data: Path) -> str:
    """Returns the SHA-256 of all logs of train and test, with their names."""
    sha = hashlib.sha256()
    for side in ("train", "test"):
        for path in _logs(data, side):
            sha.update(f"{side}/{path.name}".encode())
            with path.open("rb") as file:
                sha.update(hashlib.file_digest(file, "sha256").digest())
    return sha.hexdigest()


def _logs(data: Path, side: str) -> list[Path]:
    if paths := sorted((data / side).glob("*.mcap")):
        return paths
    raise DataError(f"no logs in {data / side}; simulate the paper's protocol or import its database first")


def _networks_in_gpu(clips: Sequence[Clip], logs: int) -> int:
    """Number of networks whose training the GPU's free memory holds, at least 1.

    Args:
        clips: Test sets, whose mean size stands for that of a training log.
        logs: Number of training logs. Each process has a copy of them.
    """
    log_bytes = float(np.mean([clip.frames.nbytes for clip in clips]))
    return max(1, int(torch.cuda.mem_get_info()[0] / (_GPU_BYTES + logs * log_bytes)))


def _train_all(tasks: Sequence[_Task], files: _Files, workers: int, end_s: float, progress: Progress) -> None:
    """Trains networks until all are done or time is up; one that is interrupted has saved its state."""
    count = min(workers, len(tasks))
    reading = max(1, workers // count)
    begin_s, left, done = time.monotonic(), sum(scale.steps for scale, *_ in tasks), 0
    with suppress(FutureTimeout), process_pool(count) as pool:
        futures = {pool.submit(_train, task, files, reading): task for task in tasks}
        timeout_s = None if end_s == math.inf else max(0.0, end_s - begin_s)
        for future in as_completed(futures, timeout_s):
            future.result()
            steps = futures[future][0].steps
            done, left = done + steps, left - steps
            hours = (time.monotonic() - begin_s) / done * left / 3600
            progress(f"{_text(futures[future])}; {hours:.1f} h left", steps)


def _load_estimates(path: Path, frames: int) -> Floats:
    estimates_n: Floats = np.load(path, allow_pickle=False)
    if estimates_n.shape != (frames,):
        raise DataError(
            f"{path} has estimates of {len(estimates_n)} frames, but the test sets have {frames}; delete it"
        )
    return estimates_n


@functools.cache
def _clips(files: _Files, side: str, preprocess: Preprocess, workers: int) -> list[Clip]:
    """Clips, cached as decoding the logs takes longer than a short training."""
    return load_clips(_logs(files.data, side), preprocess, workers=workers)


def _train(task: _Task, files: _Files, workers: int) -> None:
    torch.set_num_threads(1)
    scale, net, seed = task
    recipe = scale.recipe(net, seed)
    path = files.checkpoint(scale, net, seed)
    training, testing = (_clips(files, side, recipe.preprocess, workers) for side in ("train", "test"))
    checkpoint = load_checkpoint(str(path)) if path.exists() else None
    checkpoint = checkpoint or train(recipe, training, path, resume=True, figure=False)
    forces_n = estimate_clips(checkpoint, testing)
    labelled = [
        force_n[0, clip.labelled(recipe.preprocess.lead_in)]
        for force_n, clip in zip(forces_n, testing, strict=True)
    ]
    with unfinished(files.estimates(scale, net, seed)) as part, part.open("wb") as file:
        np.save(file, np.concatenate(labelled).astype(np.float64), allow_pickle=False)
