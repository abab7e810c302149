"""Trains the networks of the requested models with each seed, and estimates the test sets with each."""

import functools
import json
from collections.abc import Iterable, Sequence
from concurrent.futures import as_completed
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
import torch
from scipy import stats

from gripper_force.config import load_config
from gripper_force.errors import DataError
from gripper_force.interfaces import Progress
from gripper_force.jobs.dataset import CONTACT_N, Clip, load_clips
from gripper_force.jobs.evaluate import estimates
from gripper_force.jobs.paper_protocol import RATE_HZ, plan_protocol
from gripper_force.jobs.processes import process_pool
from gripper_force.jobs.simulate import simulate
from gripper_force.jobs.training.train import train
from gripper_force.qualification.paper.models import MODELS, Scale
from gripper_force.vision.checkpoint import load_checkpoint

Floats = npt.NDArray[np.float64]

_ANY_NET: Final = "plain"
"""All networks of a scale share their preprocessing; this one stands for them."""

_MIN_SETS: Final = 6
"""Fewest test sets with which a signed-rank test can reach p < 0.05."""


@dataclass(frozen=True, eq=False)
class Test:
    """Labelled frames of the test sets, and the estimates of each network.

    Attributes:
        clips: Test sets.
        measured_n: Load-cell forces, (N,).
        set: Number of each frame's set, (N,).
        object: Each frame's object, (N,).
        estimates_n: Estimates by network and seed, (N,) each.
        seeds: Number of seeds of each network.
    """

    clips: Sequence[Clip]
    measured_n: Floats
    set: npt.NDArray[np.int64]
    object: npt.NDArray[np.str_]
    estimates_n: dict[tuple[str, int], Floats]
    seeds: int

    def estimate_n(self, model: str, seed: int) -> Floats:
        """Estimates of a model in N, (N,): the mean over its networks, with consecutive seeds."""
        nets = MODELS[model]
        members_n = [self.estimates_n[net, (seed + i) % self.seeds] for i, net in enumerate(nets)]
        mean_n: Floats = np.mean(members_n, axis=0)
        return mean_n

    def absolute_n(self, model: str) -> Floats:
        """Absolute errors in N, (seeds, N)."""
        return np.abs([self.estimate_n(model, seed) - self.measured_n for seed in range(self.seeds)])

    def mae_n(self, model: str) -> Floats:
        """MAE over all frames with each seed, (seeds,)."""
        mean: Floats = self.absolute_n(model).mean(1)
        return mean

    def rmse_n(self, model: str) -> Floats:
        """RMSE over all frames with each seed, (seeds,)."""
        root: Floats = np.sqrt(np.square(self.absolute_n(model)).mean(1))
        return root

    def mae_by_set_n(self, model: str) -> Floats:
        """MAE of each test set, over its frames and all seeds, (sets,)."""
        frame_n = self.absolute_n(model).mean(0)
        return np.array([frame_n[self.set == i].mean() for i in range(len(self.clips))])

    def p_value(self, model: str, other: str) -> float:
        """Two-sided p-value of Wilcoxon's signed-rank test of the two models' MAE, paired by test set.

        It is NaN with fewer than 6 sets.
        """
        a, b = self.mae_by_set_n(model), self.mae_by_set_n(other)
        if len(a) < _MIN_SETS or (a == b).all():
            return float("nan")
        return float(stats.wilcoxon(a, b).pvalue)

    @property
    def contact(self) -> npt.NDArray[np.bool_]:
        """True for frames in contact, (N,)."""
        return self.measured_n > CONTACT_N


def missing_logs(scale: Scale, data: Path) -> int:
    """Number of logs of the protocol that do not exist yet."""
    names = (name for plan in plan_protocol(scale.protocol) for name in plan.names)
    return sum(not (data / name).exists() for name in names)


def simulate_missing(scale: Scale, data: Path, jobs: int, progress: Progress) -> None:
    """Simulates the logs of the protocol that do not exist yet. Raises as `simulate.simulate` does."""
    config = load_config(None, [f"camera.rate_hz={RATE_HZ}"])
    with closing(simulate(plan_protocol(scale.protocol), data, config, jobs)) as paths:
        for path in paths:
            progress(path.name)


def run(scale: Scale, models: Iterable[str], data: Path, out: Path, jobs: int, progress: Progress) -> Test:
    """Trains the missing networks of the models, and estimates the test sets with each network.

    Args:
        scale: Size of the reproduction.
        models: Names in `MODELS`.
        data: Folder with the protocol's logs, in ``train`` and ``test``.
        out: Folder for the checkpoints. Existing networks are not trained again, and interrupted trainings
            continue.
        jobs: Processes; on the CPU each trains with one thread.
        progress: Called after each network.

    Raises:
        DataError: There are no logs of the protocol, or ``out`` holds networks of another scale or data.
        CheckpointError: The folder holds networks trained on other data.
    """
    _check_folder(scale, data, out)
    # Ordered by seed, so that an interrupted run has all networks with the first seeds.
    nets = [(net, seed) for seed in range(scale.seeds) for net in networks(models)]
    missing = [pair for pair in nets if not _estimates_path(out, *pair).exists()]
    for net, seed in set(nets) - set(missing):
        progress(f"{net}, seed {seed}")
    if missing:
        count = min(jobs, len(missing))
        reading = max(1, jobs // count)
        with process_pool(count) as pool:
            futures = {pool.submit(_train, scale, *pair, data, out, reading): pair for pair in missing}
            for future in as_completed(futures):
                future.result()
                progress("{}, seed {}".format(*futures[future]))
    clips = _clips(data, "test", scale, jobs)
    keep = [_labelled(scale, clip) for clip in clips]
    measured_n = np.concatenate([clip.forces_n[k] for clip, k in zip(clips, keep, strict=True)])
    counts = [int(k.sum()) for k in keep]
    return Test(
        clips=clips,
        measured_n=measured_n.astype(np.float64),
        set=np.repeat(np.arange(len(clips)), counts),
        object=np.repeat([clip.object for clip in clips], counts),
        estimates_n={pair: _load_estimates(_estimates_path(out, *pair), len(measured_n)) for pair in nets},
        seeds=scale.seeds,
    )


def networks(models: Iterable[str]) -> list[str]:
    """Names of the networks of models, each once."""
    return list(dict.fromkeys(net for model in models for net in MODELS[model]))


def checkpoint_path(out: Path, net: str, seed: int) -> Path:
    """Path of the checkpoint of a network."""
    return out / f"{net}-{seed}.safetensors"


def _estimates_path(out: Path, net: str, seed: int) -> Path:
    return out / f"{net}-{seed}.npy"


def _check_folder(scale: Scale, data: Path, out: Path) -> None:
    """Raises `DataError` if a folder has networks of another scale or data; marks an empty one."""
    out.mkdir(parents=True, exist_ok=True)
    mark = out / "made_of.json"
    text = json.dumps([scale.model_dump(exclude={"seeds"}), str(data.resolve())])
    begun = any(out.glob("*.safetensors")) or any(out.glob("*.state"))
    if begun and not (mark.exists() and mark.read_text(encoding="utf-8") == text):
        raise DataError(
            f"{out} holds networks of another scale or other data; give another folder with --out"
        )
    mark.write_text(text, encoding="utf-8")


def _labelled(scale: Scale, clip: Clip) -> npt.NDArray[np.bool_]:
    """True for frames with a label for which a run gives an estimate, (T,)."""
    lead_in = scale.recipe(_ANY_NET, 0).preprocess.lead_in
    labelled: npt.NDArray[np.bool_] = clip.valid & (np.arange(len(clip.frames)) >= lead_in)
    return labelled


def _load_estimates(path: Path, frames: int) -> Floats:
    estimates_n: Floats = np.load(path, allow_pickle=False)
    if estimates_n.shape != (frames,):
        raise DataError(
            f"{path} has estimates of {len(estimates_n)} frames, but the test sets have {frames}; delete it"
        )
    return estimates_n


def _clips(data: Path, side: str, scale: Scale, workers: int) -> list[Clip]:
    folder = data / side
    if not any(folder.glob("*.mcap")):
        raise DataError(f"no logs in {folder}; simulate the paper's protocol or import its database first")
    return load_clips(folder, scale.recipe(_ANY_NET, 0).preprocess, workers=workers)


@functools.cache
def _cached_clips(data: Path, side: str, scale: Scale, workers: int) -> list[Clip]:
    """Clips cached in a worker process, as decoding the logs takes longer than a short training."""
    return _clips(data, side, scale, workers)


def _train(scale: Scale, net: str, seed: int, data: Path, out: Path, workers: int) -> None:
    if not torch.cuda.is_available():
        torch.set_num_threads(1)
    path = checkpoint_path(out, net, seed)
    training, testing = (_cached_clips(data, side, scale, workers) for side in ("train", "test"))
    checkpoint = load_checkpoint(str(path)) if path.exists() else None
    checkpoint = checkpoint or train(scale.recipe(net, seed), training, path, resume=True)
    forces_n = estimates(checkpoint, testing)
    labelled = [force_n[0, _labelled(scale, clip)] for force_n, clip in zip(forces_n, testing, strict=True)]
    unfinished = path.with_suffix(".part.npy")
    np.save(unfinished, np.concatenate(labelled).astype(np.float64), allow_pickle=False)
    unfinished.rename(_estimates_path(out, net, seed))
