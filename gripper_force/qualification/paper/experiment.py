"""Training every network that is asked for with every seed, and what each then estimates on the test sets."""

import contextlib
import functools
import io
import json
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
import torch
from scipy import stats

from gripper_force.config import load_config
from gripper_force.errors import DataError
from gripper_force.jobs.dataset import CONTACT_N, Clip, load_clips
from gripper_force.jobs.evaluate import estimates
from gripper_force.jobs.paper_protocol import RATE_HZ, plan_protocol
from gripper_force.jobs.processes import process_pool
from gripper_force.jobs.simulate import simulate
from gripper_force.jobs.training.train import train
from gripper_force.qualification.paper.models import MODELS, Scale
from gripper_force.vision.checkpoint import load_checkpoint

Floats = npt.NDArray[np.float64]
Advance = Callable[[str], None]

_ANY_NET: Final = "plain"

_MANY: Final = 6
"""Test sets from which on a signed-rank test can reach any of the usual levels."""


@dataclass(frozen=True, eq=False)
class Test:
    """The frames of the test sets that have a label, and what each network estimates there.

    Attributes:
        clips: Test sets.
        measured_n: Load-cell forces, (N,).
        set: Number of each frame's set, (N,).
        object: Each frame's object, (N,).
        estimates_n: Estimates by network and seed, (N,) each.
        seeds: How often each network was trained.
    """

    clips: Sequence[Clip]
    measured_n: Floats
    set: npt.NDArray[np.int64]
    object: npt.NDArray[np.str_]
    estimates_n: dict[tuple[str, int], Floats]
    seeds: int

    def estimate_n(self, model: str, seed: int) -> Floats:
        """Estimates of a model, (N,): the mean over its networks, each with the next seed."""
        nets = MODELS[model]
        members_n = [self.estimates_n[net, (seed + i) % self.seeds] for i, net in enumerate(nets)]
        mean_n: Floats = np.mean(members_n, axis=0)
        return mean_n

    def absolute_n(self, model: str) -> Floats:
        """Absolute errors, (seeds, N)."""
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
        """Wilcoxon's signed-rank test of the two models' MAE, paired by test set.

        Returns:
            The two-sided probability of such a difference between models that are equally good; NaN with less
            than 6 sets.
        """
        a, b = self.mae_by_set_n(model), self.mae_by_set_n(other)
        if len(a) < _MANY or (a == b).all():
            return float("nan")
        return float(stats.wilcoxon(a, b).pvalue)

    @property
    def contact(self) -> npt.NDArray[np.bool_]:
        """Which frames are in contact, (N,)."""
        return self.measured_n > CONTACT_N


def missing_logs(scale: Scale, data: Path) -> int:
    """How many logs of the protocol are not there yet."""
    names = (name for plan in plan_protocol(scale.protocol) for name in plan.names)
    return sum(not (data / name).exists() for name in names)


def simulate_missing(scale: Scale, data: Path, jobs: int, advance: Advance) -> None:
    """Makes the logs of the protocol that are not there yet. Raises as `simulate.simulate` does."""
    config = load_config(None, [f"camera.rate_hz={RATE_HZ}"])
    for path in simulate(plan_protocol(scale.protocol), data, config, jobs):
        advance(path.name)


def run(scale: Scale, models: Iterable[str], data: Path, out: Path, jobs: int, advance: Advance) -> Test:
    """Trains what is missing of the models' networks, and estimates the test sets with each.

    Args:
        scale: How much of everything.
        models: Names of `MODELS`.
        data: Folder with the protocol's logs, in ``train`` and ``test``.
        out: Folder for the checkpoints; one that is there already is not trained again, and a training that
            was broken off goes on.
        jobs: Processes; on the CPU each trains with one thread.
        advance: Told of each network that is done.

    Raises:
        DataError: There are no logs of the protocol, or ``out`` holds networks of another scale or data.
        CheckpointError: The folder holds networks of other data.
    """
    _stamp(scale, data, out)
    # A run that is broken off should have each network with the first seeds.
    nets = [(net, seed) for seed in range(scale.seeds) for net in networks(models)]
    missing = [pair for pair in nets if not _estimates_path(out, *pair).exists()]
    for net, seed in set(nets) - set(missing):
        advance(f"{net}, seed {seed}")
    if missing:
        count = min(jobs, len(missing))
        reading = max(1, jobs // count)
        with process_pool(count) as pool:
            futures = {pool.submit(_train, scale, *pair, data, out, reading): pair for pair in missing}
            for future in as_completed(futures):
                future.result()
                advance("{}, seed {}".format(*futures[future]))
    clips = _clips(data, "test", scale, jobs)
    keep = [_labelled(scale, clip) for clip in clips]
    measured_n = np.concatenate([clip.forces_n[k] for clip, k in zip(clips, keep, strict=True)])
    counts = [int(k.sum()) for k in keep]
    return Test(
        clips=clips,
        measured_n=measured_n.astype(np.float64),
        set=np.repeat(np.arange(len(clips)), counts),
        object=np.repeat([clip.object for clip in clips], counts),
        estimates_n={pair: _read(_estimates_path(out, *pair), len(measured_n)) for pair in nets},
        seeds=scale.seeds,
    )


def networks(models: Iterable[str]) -> list[str]:
    """The networks that models are made of, each once."""
    return list(dict.fromkeys(net for model in models for net in MODELS[model]))


def checkpoint_path(out: Path, net: str, seed: int) -> Path:
    """Where `run` puts a network."""
    return out / f"{net}-{seed}.safetensors"


def _estimates_path(out: Path, net: str, seed: int) -> Path:
    return out / f"{net}-{seed}.npy"


def _stamp(scale: Scale, data: Path, out: Path) -> None:
    """Keeps networks of one scale and one folder of data in a folder."""
    out.mkdir(parents=True, exist_ok=True)
    stamp = out / "made_of.json"
    text = json.dumps([scale.model_dump(exclude={"seeds"}), str(data.resolve())])
    begun = any(out.glob("*.safetensors")) or any(out.glob("*.state"))
    if begun and not (stamp.exists() and stamp.read_text(encoding="utf-8") == text):
        raise DataError(
            f"{out} holds networks of another scale or other data; take another folder with --out"
        )
    stamp.write_text(text, encoding="utf-8")


def _labelled(scale: Scale, clip: Clip) -> npt.NDArray[np.bool_]:
    """Which frames count, (T,): those with a label for which a run would give an estimate."""
    lead_in = scale.recipe(_ANY_NET, 0).preprocess.lead_in
    labelled: npt.NDArray[np.bool_] = clip.valid & (np.arange(len(clip.frames)) >= lead_in)
    return labelled


def _read(path: Path, frames: int) -> Floats:
    estimates_n: Floats = np.load(path, allow_pickle=False)
    if estimates_n.shape != (frames,):
        raise DataError(f"{path} is of other test sets: {len(estimates_n)} frames, not {frames}; delete it")
    return estimates_n


def _clips(data: Path, side: str, scale: Scale, workers: int) -> list[Clip]:
    folder = data / side
    if not any(folder.glob("*.mcap")):
        raise DataError(f"no logs in {folder}; simulate the paper's protocol or import its database first")
    return load_clips(folder, scale.recipe(_ANY_NET, 0).preprocess, workers=workers)


@functools.cache
def _kept_clips(data: Path, side: str, scale: Scale, workers: int) -> list[Clip]:
    """Of a worker process: decoding the logs takes longer than a short training."""
    return _clips(data, side, scale, workers)


def _train(scale: Scale, net: str, seed: int, data: Path, out: Path, workers: int) -> None:
    if not torch.cuda.is_available():
        torch.set_num_threads(1)
    path = checkpoint_path(out, net, seed)
    with _quiet():
        training, testing = (_kept_clips(data, side, scale, workers) for side in ("train", "test"))
        checkpoint = load_checkpoint(str(path)) if path.exists() else None
        checkpoint = checkpoint or train(scale.recipe(net, seed), training, path, resume=True)
        forces_n = estimates(checkpoint, testing)
    labelled = [force_n[0, _labelled(scale, clip)] for force_n, clip in zip(forces_n, testing, strict=True)]
    unfinished = path.with_suffix(".part.npy")
    np.save(unfinished, np.concatenate(labelled).astype(np.float64), allow_pickle=False)
    unfinished.rename(_estimates_path(out, net, seed))


def _quiet() -> contextlib.redirect_stderr[io.StringIO]:
    """Several progress bars at once would be one too many."""
    return contextlib.redirect_stderr(io.StringIO())
