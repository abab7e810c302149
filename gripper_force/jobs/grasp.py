"""The main job: grasp, and say how well, once or over many trials."""

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gripper_force.config import Config, config_from, config_from_text
from gripper_force.errors import DataError
from gripper_force.jobs.dataset import stiffness_floor_n, stiffness_of
from gripper_force.jobs.processes import process_pool
from gripper_force.jobs.replay import compare
from gripper_force.jobs.score import score_grasp
from gripper_force.runtime.assembly import checkpoint_of
from gripper_force.runtime.log import LogReader
from gripper_force.runtime.session import run_grasp
from gripper_force.types import (
    NS_PER_S,
    Event,
    FusedForce,
    GraspStatus,
    LoadCellSample,
    Outcome,
    ServoState,
    VisualForce,
)

TRIAL_OBJECTS = ("sponge", "paper_cup", "tube", "stapler")
TRIAL_TARGETS_N = (1.0, 8.0)
WITHIN_SHARE, WITHIN_N = 0.08, 0.25
"""A trial counts as good within this share of its target, or within this force."""

Summary = dict[str, Any]


def grasp(
    config: Config, progress: Callable[[GraspStatus], None] | None = None, path: Path | None = None
) -> Summary:
    """Runs one grasp, writes its log and its report, and sums it up.

    Args:
        config: The run.
        progress: Told of each new phase.
        path: The log to write; None for a `new_log`.

    Returns:
        ``result, object, target_n, load_cell_mean_n, steady_error_n, overshoot_n, settle_s, estimator_p50_ms,
        estimator_p99_ms, loop_hz, camera_hz, samples_rejected, taken, log, report`` and the seed and the peak
        force. ``taken`` says what was taken for each ``auto``, and why. None where a figure has no meaning,
        such as without a load cell.

    Raises:
        GripperError: The run failed; its log holds what was seen.
    """
    path = path or new_log(config)
    run_grasp(config, path, progress)
    result = {**summarise(path), "report": None}
    if config.log.report:
        from gripper_force.jobs.report import write_report

        result["report"] = str(write_report(path).html)
    return result


def trials(config: Config, count: int, jobs: int) -> Iterator[Summary]:
    """Runs ``count`` grasps, each of the objects in turn, with targets and seeds drawn from ``config.seed``.

    Args:
        config: Everything else.
        count: Number of grasps.
        jobs: Processes. A lockstep run comes out the same in any number of them.

    Yields:
        The summary of each, in order, with its ``seed``.
    """
    checkpoint_of(config)  # what `auto` measures is measured here and not in each process
    rng = np.random.default_rng([config.seed, 20])
    quiet = config.log.model_copy(update={"report": False})  # `replay LOG --report` draws any of them
    plan = [
        config.model_copy(
            update={
                "object": TRIAL_OBJECTS[i % len(TRIAL_OBJECTS)],
                "target_n": round(float(rng.uniform(*TRIAL_TARGETS_N)), 3),
                "seed": config.seed + i,
                "log": quiet,
            }
        )
        for i in range(count)
    ]
    trees = [trial.model_dump(mode="json") for trial in plan]
    with process_pool(jobs) as pool:
        yield from pool.map(_trial, trees)


def summarise(path: Path) -> Summary:
    """Reads the figures of a grasp from its log."""
    reader = LogReader(path)
    records: dict[type, list[Any]] = defaultdict(list)
    for record in reader.records(Event, GraspStatus, LoadCellSample, ServoState, VisualForce, FusedForce):
        records[type(record)].append(record)
    statuses, cells = records[GraspStatus], sorted(records[LoadCellSample], key=lambda c: c.t_ns)
    cycles_ns = [state.t_ns for state in records[ServoState]]
    visuals = records[VisualForce]
    compute_ms = [visual.compute_ms for visual in visuals]
    seen_s = (visuals[-1].t_ns - visuals[0].t_ns) / NS_PER_S if len(visuals) > 1 else 0.0
    config = config_from_text(reader.config, str(path))
    outcomes = [s.outcome for s in statuses if s.outcome != Outcome.NONE]
    span_s = (cycles_ns[-1] - cycles_ns[0]) / NS_PER_S if len(cycles_ns) > 1 else 0.0
    return {
        "result": outcomes[-1] if outcomes else "interrupted",
        "object": config.object,
        "target_n": config.target_n,
        "seed": config.seed,
        **_score(cells, statuses, config.target_n),
        "peak_n": max((c.force_n for c in cells if c.valid), default=None),
        "estimator_p50_ms": _percentile(compute_ms, 50),
        "estimator_p99_ms": _percentile(compute_ms, 99),
        "loop_hz": (len(cycles_ns) - 1) / span_s if span_s else None,
        "camera_hz": (visuals[-1].seq - visuals[0].seq) / seen_s if seen_s else None,
        "samples_rejected": sum(not cell.valid for cell in cells) if cells else None,
        "estimate_mae_n": {
            "visual": _mae_n([(v.t_ns, v.force_n) for v in visuals], cells),
            "current": _mae_n([(f.t_ns, f.current_n) for f in records[FusedForce]], cells),
            "fused": _mae_n([(f.t_ns, f.force_n) for f in records[FusedForce]], cells),
            "floor": _floor_n(reader.metadata, cells),
        },
        "taken": [event.text for event in records[Event] if event.text.startswith("took ")],
        "log": str(path),
    }


def overall(results: list[Summary], force_limit_n: float) -> Summary:
    """The figures over all trials."""
    scored = [r for r in results if r["steady_error_n"] is not None]
    error_n = np.array([abs(r["steady_error_n"]) for r in scored])
    target_n = np.array([r["target_n"] for r in scored])
    share = error_n / target_n
    good = (share <= WITHIN_SHARE) | (error_n <= WITHIN_N)
    overshoot = np.array([r["overshoot_n"] for r in scored]) / target_n
    peaks = [r["peak_n"] for r in results if r["peak_n"] is not None]
    return {
        "trials": len(results),
        "held": sum(r["result"] == Outcome.HELD for r in results),
        "median_error_percent": _percentile(100 * share, 50),
        "p90_error_percent": _percentile(100 * share, 90),
        "median_error_n": _percentile(error_n, 50),
        "good_percent": 100 * int(good.sum()) / len(results),
        "median_overshoot_percent": _percentile(100 * overshoot, 50),
        "max_overshoot_percent": _percentile(100 * overshoot, 100),
        "median_settle_s": _percentile([r["settle_s"] for r in scored if r["settle_s"] is not None], 50),
        "peak_n": max(peaks, default=None),
        "over_limit": sum(peak > force_limit_n for peak in peaks),
        "estimator_p50_ms": _percentile(
            [r["estimator_p50_ms"] for r in results if r["estimator_p50_ms"]], 50
        ),
        "estimate_mae_n": {
            name: _mean_mae_n([r for r in results if name in ("all", r["object"])])
            for name in ("all", *dict.fromkeys(r["object"] for r in results))
        },
    }


def _trial(tree: dict[str, Any]) -> Summary:
    return grasp(config_from(tree, "trials"))


def _mae_n(estimates: list[tuple[int, float]], cells: list[LoadCellSample]) -> float | None:
    """Mean error of an estimate over the whole run."""
    figures = compare([t for t, _ in estimates], [f for _, f in estimates], cells)
    return None if figures is None else float(figures["mae_n"])


def _floor_n(metadata: Mapping[str, str], cells: list[LoadCellSample]) -> float | None:
    """What the spread of stiffness alone costs; None for a real object."""
    if "scene" not in metadata or not cells:
        return None
    forces_n = np.array([c.force_n for c in cells])
    return float(stiffness_floor_n(forces_n, stiffness_of(metadata)).mean())


def _mean_mae_n(results: list[Summary]) -> dict[str, float | None]:
    means = {}
    for source in results[0]["estimate_mae_n"]:
        values = [v for r in results if (v := r["estimate_mae_n"][source]) is not None]
        means[source] = float(np.mean(values)) if values else None
    return means


def _score(cells: list[LoadCellSample], statuses: list[GraspStatus], target_n: float) -> Summary:
    try:
        score = score_grasp(cells, statuses, target_n)
    except DataError:
        return dict.fromkeys(("load_cell_mean_n", "steady_error_n", "overshoot_n", "settle_s"))
    return {
        "load_cell_mean_n": score.steady_n,
        "steady_error_n": score.steady_error_n,
        "overshoot_n": score.overshoot_n,
        "settle_s": score.settle_s if np.isfinite(score.settle_s) else None,
    }


def _percentile(values: Any, q: float) -> float | None:
    return float(np.percentile(values, q)) if len(values) else None


def new_log(config: Config) -> Path:
    """A path for the run's log that is free."""
    stamp = time.strftime("%Y%m%d-%H%M%S")
    stem = f"{stamp}-{config.object}-{config.target_n:g}N-{config.control.feedback}-seed{config.seed}"
    path = config.log.directory / f"{stem}.mcap"
    again = 1
    while path.exists():
        again += 1
        path = config.log.directory / f"{stem}-{again}.mcap"
    return path
