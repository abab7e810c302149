"""Error of visual estimates of single objects, without and with the object's gain that grasps have shown."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from gripper_force.config import Config
from gripper_force.jobs.dataset import load_clips
from gripper_force.jobs.grasp import GraspSummary
from gripper_force.jobs.object_gain import gain_of, learned_ratio
from gripper_force.jobs.recording.touches import ramp, wait
from gripper_force.jobs.training.stated_errors import labelled_estimates
from gripper_force.jobs.trials import trials, with_same_object
from gripper_force.progress import Progress, no_progress
from gripper_force.runtime.session import open_run
from gripper_force.types import Outcome
from gripper_force.vision.checkpoint import load_checkpoint

TARGETS_N: Final = (1.5, 6.0)
"""Range of the target forces of the grasps."""

PEAKS_N: Final = (2.0, 8.0)
"""Range of the forces of the presses. The stapler's stop, beyond which no image shows the force, is at 8 to 9 N."""

Floats = npt.NDArray[np.floating]

_PRESS_SEEDS: Final = 500
"""Distance of the presses' seeds from those of the grasps."""

_OBJECT_SEEDS: Final = 1000
"""Distance of the seeds of two objects."""


@dataclass(frozen=True, slots=True)
class GainRow:
    """Figures of one object.

    Attributes:
        object: Kind of the object.
        seed: Seed of object and gripper.
        stiffness: The object's true gain: its stiffness over that of the kind.
        grasps: Number of grasps that were held.
        gain: The object's gain by motor current.
        gain_std: Its relative standard deviation.
        mae_n: MAE of the network on the presses.
        learned_n: The same with the gain.
        perfect_n: The same with the best possible gain, of these presses.
        errors_n: Error of the load cell's mean in the hold from the target, of each grasp.
    """

    object: str
    seed: int
    stiffness: float
    grasps: int
    gain: float
    gain_std: float
    mae_n: float
    learned_n: float
    perfect_n: float
    errors_n: list[float | None]


def bench(
    config: Config,
    objects: Sequence[str],
    *,
    rounds: int,
    grasps: int,
    presses: int,
    folder: Path,
    progress: Progress = no_progress,
) -> Iterator[GainRow]:
    """Grasps each object several times, learns its gain, and presses it in other places.

    Args:
        config: Everything else.
        objects: Kinds of objects.
        rounds: Number of objects of each kind.
        grasps: Number of grasps of each object.
        presses: Number of presses of each object.
        folder: Folder of the logs.
        progress: Called after each grasp and each press.

    Raises:
        GripperError: A grasp failed, or a scene can't be simulated.
    """
    for number, name in enumerate([name for _ in range(rounds) for name in objects]):
        seed = config.seed + _OBJECT_SEEDS * number
        one = with_same_object(config.with_values(object=name, seed=seed, log={"directory": folder}))
        rng = np.random.default_rng([seed, 21])
        results = []
        ratio = None
        for place in range(grasps):
            again = one.with_values(seed=seed + place, control={"object_ratio": ratio})
            target_n = round(float(rng.uniform(*TARGETS_N)), 2)
            results += list(trials(again, 1, 1, objects=(name,), target_n=target_n, same_object=True))
            ratio = learned_ratio(Path(results[-1]["log"]))
            progress(f"{name}, seed {seed}: grasp {place + 1}")
        logs = []
        for place in range(presses):
            logs.append(folder / f"press-{name}-{seed + _PRESS_SEEDS + place}.mcap")
            logs[-1].unlink(missing_ok=True)  # of an earlier run of this bench; a log is never overwritten
            _press(one.with_values(seed=seed + _PRESS_SEEDS + place), logs[-1], rng)
            progress(f"{name}, seed {seed}: press {place + 1}")
        yield _row(one, results, ratio, logs)


def _press(config: Config, path: Path, rng: np.random.Generator) -> None:
    config = config.with_values(control={"feedback": "current", "object_ratio": None})
    with open_run(config, path, vision=False) as session:
        wait(session, 0.2)
        for _ in range(2):
            ramp(session, float(rng.uniform(*PEAKS_N)), config.control.timeout_s)
            wait(session, 0.2)
        session.release()


def _row(
    config: Config, results: Sequence[GraspSummary], ratio: tuple[float, float] | None, logs: list[Path]
) -> GainRow:
    checkpoint = load_checkpoint(config.vision.checkpoint)
    preprocess = checkpoint.header.preprocess
    clips = load_clips(logs, preprocess, config.vision.region)
    seen_n, true_n = labelled_estimates(clips, checkpoint.networks, preprocess, "cpu")
    gain = gain_of(ratio, config.gripper.gain_std)

    def mae_n(factor: float) -> float:
        return float(np.abs(factor * seen_n - true_n).mean())

    held = [r for r in results if r["result"] == Outcome.HELD]
    return GainRow(
        object=config.object,
        seed=config.seed,
        stiffness=clips[0].stiffness,
        grasps=len(held),
        gain=1.0 if gain is None else gain.gain,
        gain_std=0.0 if gain is None else gain.std,
        mae_n=mae_n(1.0),
        learned_n=mae_n(1.0 if gain is None else gain.gain),
        perfect_n=mae_n(best_gain(seen_n, true_n)),
        errors_n=[r["steady_error_n"] for r in results],
    )


def best_gain(seen_n: Floats, true_n: Floats) -> float:
    """Returns the factor of visual estimates with the lowest MAE.

    It is the median of the ratios of measured to seen forces, with the seen forces as weights.
    """
    used = seen_n != 0
    ratios = true_n[used] / seen_n[used]
    order = np.argsort(ratios)
    weights = np.abs(seen_n[used])[order].cumsum()
    return float(ratios[order][np.searchsorted(weights, weights[-1] / 2)])
