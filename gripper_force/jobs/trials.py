"""Several grasps with drawn targets and seeds, and their statistics."""

import time
from collections.abc import Generator, Sequence
from pathlib import Path
from shlex import quote
from typing import Final, TypedDict

import numpy as np

from gripper_force.config import Config, config_from
from gripper_force.errors import ConfigError, DeviceError
from gripper_force.jobs.grasp import PAPER_OBJECTS, GraspSummary, exclusive_device, grasp, require_report
from gripper_force.jobs.metrics import percentile
from gripper_force.jobs.object_gain import learned_ratio
from gripper_force.jobs.processes import process_pool
from gripper_force.progress import Progress, Prompt, no_progress
from gripper_force.runtime.resolve import resolve
from gripper_force.schema import Tree
from gripper_force.types import Outcome

TRIAL_TARGETS_N: Final = (1.0, 8.0)
"""Range of the targets that are drawn."""

WITHIN_SHARE, WITHIN_N = 0.08, 0.25
"""A trial counts as good if its error is within this share of its target, or within this force."""


class TrialsSummary(TypedDict):
    """Figures over all trials; None for a figure without a value, such as an error without a load cell.

    Errors, overshoot and settling time leave out the trials with the feedback ``vision`` that fell back.
    """

    trials: int
    held: int
    fell_back: int
    median_error_percent: float | None
    p90_error_percent: float | None
    median_error_n: float | None
    good_percent: float | None
    median_overshoot_percent: float | None
    max_overshoot_percent: float | None
    median_settle_s: float | None
    peak_n: float | None
    over_limit: int | None
    estimator_p50_ms: float | None
    estimate_mae_n: dict[str, dict[str, float | None]]


def trials(
    config: Config,
    count: int,
    workers: int,
    *,
    objects: Sequence[str] = PAPER_OBJECTS,
    target_n: float | None = None,
    same_object: bool = False,
    prompt: Prompt | None = None,
    progress: Progress = no_progress,
) -> Generator[GraspSummary, None, None]:
    """Runs grasps of the objects in turn, with targets and seeds drawn from ``config.seed``.

    Args:
        config: Everything else.
        count: Number of grasps.
        workers: Processes; 1: the grasps run in this process. The results of lockstep runs do not depend on it.
        objects: Names of the objects.
        target_n: Target force of each grasp; None: drawn from 1 to 8 N, or to what the limits permit.
        same_object: Grasps one object with one gripper, in another place each time, and passes what was learned of
            its gain from grasp to grasp.
        prompt: Called before each grasp, so that a person can place the object; None for no pause.
        progress: Called before each grasp and at each change of phase, if ``workers`` is 1.

    Yields:
        The summary of each grasp, in order.

    Raises:
        ConfigError: Several processes can't open a device at the same time, or pass on what was learned; or there
            are several objects where one is to be grasped again.
        RequestError: The target, or the smallest that is drawn, is beyond a limit.
        DeviceError: A grasp with a real device ended with a fault: nothing moves until a person has looked.
        GripperError: A grasp failed.
    """
    require_report(config)
    device = exclusive_device(config)
    if device and workers > 1:
        raise ConfigError(
            f"only one process can open {device}, not {workers}; leave out --jobs, or set it to 1"
        )
    if same_object:
        if workers > 1 or len(objects) > 1:
            raise ConfigError(
                "grasps of the same object follow one another; pass one --object, and leave out --jobs"
            )
        config = with_same_object(config)
    plan = _planned(config, count, objects, target_n)
    if workers > 1:
        with process_pool(workers) as pool:
            yield from pool.map(_trial, [trial.model_dump(mode="json") for trial in plan])
        return
    ratio = config.control.object_ratio
    for number, trial in enumerate(plan, 1):
        if prompt is not None:
            prompt(f"Put the {trial.object} between the jaws for trial {number} of {count}")
        progress(f"trial {number} of {count}: {trial.object}, {trial.target_n:g} N")
        if same_object:
            trial = trial.with_values(control={"object_ratio": ratio})
        result = grasp(trial, progress)
        if same_object:
            ratio = learned_ratio(Path(result["log"]))
        yield result
        if device and result["result"] == Outcome.FAULT:
            raise DeviceError(
                f"trial {number} of {count} ended with a fault, so no further one was run; look at the gripper, "
                f"and at the fault with: gripper-force replay {quote(result['log'])} --report"
            )


def _planned(config: Config, count: int, objects: Sequence[str], target_n: float | None) -> list[Config]:
    """Returns the configuration of each trial: its object, target and seed."""
    min_n, max_n = TRIAL_TARGETS_N
    largest_n = {}
    for name in objects:
        resolved = resolve(config.with_values(object=name))  # measures what `auto` needs once, here
        resolved.check_target(min_n if target_n is None else target_n)
        largest_n[name] = min(max_n, resolved.largest_target_n)
    rng = np.random.default_rng([config.seed, 20])
    plan = []
    for i in range(count):
        name = objects[i % len(objects)]
        drawn_n = min(round(float(rng.uniform(min_n, largest_n[name])), 3), largest_n[name])
        plan.append(
            config.with_values(
                object=name,
                target_n=drawn_n if target_n is None else target_n,
                seed=config.seed + i,
                log={"report": False},  # `replay LOG --report` draws any of them later
            )
        )
    return plan


def _trial(tree: Tree) -> GraspSummary:
    return grasp(config_from(tree, "trials"))


def with_same_object(config: Config) -> Config:
    """Returns a configuration whose simulated object and gripper do not depend on the seed of the trial."""
    sim = config.sim
    return config.with_values(
        sim={
            "object_seed": config.seed if sim.object_seed is None else sim.object_seed,
            "rig_seed": config.seed if sim.rig_seed is None else sim.rig_seed,
        }
    )


def summarise_trials(results: list[GraspSummary], force_limit_n: float) -> TrialsSummary:
    """Computes the figures over all trials."""
    counted = [r for r in results if not (r["fell_back"] and r["feedback"] == "vision")]
    scored = [r for r in counted if r["steady_error_n"] is not None]
    error_n = np.array([abs(r["steady_error_n"] or 0.0) for r in scored])
    target_n = np.array([r["target_n"] for r in scored])
    share = error_n / target_n
    good = (share <= WITHIN_SHARE) | (error_n <= WITHIN_N)
    overshoot = np.array([r["overshoot_n"] for r in scored]) / target_n
    peaks = [r["peak_n"] for r in results if r["peak_n"] is not None]  # empty without a load cell
    return {
        "trials": len(results),
        "held": sum(r["result"] == Outcome.HELD for r in results),
        "fell_back": sum(r["fell_back"] for r in results),
        "median_error_percent": percentile(100 * share, 50),
        "p90_error_percent": percentile(100 * share, 90),
        "median_error_n": percentile(error_n, 50),
        "good_percent": 100 * int(good.sum()) / len(counted) if peaks and counted else None,
        "median_overshoot_percent": percentile(100 * overshoot, 50),
        "max_overshoot_percent": percentile(100 * overshoot, 100),
        "median_settle_s": percentile([r["settle_s"] for r in scored if r["settle_s"] is not None], 50),
        "peak_n": max(peaks, default=None),
        "over_limit": sum(peak > force_limit_n for peak in peaks) if peaks else None,
        "estimator_p50_ms": percentile([r["estimator_p50_ms"] for r in results if r["estimator_p50_ms"]], 50),
        "estimate_mae_n": {
            name: _mean_mae_n([r for r in results if name in ("all", r["object"])])
            for name in ("all", *dict.fromkeys(r["object"] for r in results))
        },
    }


def _mean_mae_n(results: list[GraspSummary]) -> dict[str, float | None]:
    means = {}
    for source in results[0]["estimate_mae_n"]:
        values = [v for r in results if (v := r["estimate_mae_n"][source]) is not None]
        means[source] = float(np.mean(values)) if values else None
    return means


def write_figure(config: Config, results: Sequence[GraspSummary], summary: TrialsSummary) -> str | None:
    """Draws the errors of trials over their targets, beside the logs. Returns the file.

    Returns None without a load cell, or with ``log.report=false``.

    Raises:
        DataError: The file can't be written.
    """
    if not config.log.report or summary["median_error_percent"] is None:
        return None
    from gripper_force.jobs.report.plots import draw_grasps

    path = config.log.directory / f"{time.strftime('%Y%m%d-%H%M%S')}-trials.png"
    title = (
        f"{summary['held']} of {summary['trials']} grasps held, {config.control.feedback} feedback, median error "
        f"{summary['median_error_percent']:.1f} %"
    )
    draw_grasps(results, title, path)
    return str(path)
