"""The main job: one grasp with its summary, or many trials with their statistics."""

import math
import time
from collections import defaultdict
from collections.abc import Generator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, TypedDict

import numpy as np

from gripper_force.config import Config, config_from, config_from_text
from gripper_force.errors import ConfigError, DataError, DeviceError
from gripper_force.jobs.dataset import stiffness_floor_n, stiffness_of
from gripper_force.jobs.object_gain import learned_ratio
from gripper_force.jobs.processes import process_pool
from gripper_force.jobs.replay.comparison import load_cell_errors
from gripper_force.jobs.score import (
    MIN_VISION_SHARE,
    VisionLoss,
    controls_with_vision,
    score_grasp,
    vision_in_hold,
)
from gripper_force.plugins import require
from gripper_force.progress import Progress, Prompt, no_progress
from gripper_force.runtime.log_reader import LogReader
from gripper_force.runtime.resolve import resolve
from gripper_force.runtime.session import Session, open_run
from gripper_force.schema import Tree
from gripper_force.types import (
    NS_PER_S,
    Event,
    FusedForce,
    GraspStatus,
    LoadCellSample,
    Outcome,
    RequestKind,
    ServoState,
    VisualForce,
)

PAPER_OBJECTS: Final = ("sponge", "paper_cup", "tube", "stapler")
"""Simulated objects like the four of the dataset of Shin et al. 2019."""

TRIAL_TARGETS_N: Final = (1.0, 8.0)
WITHIN_SHARE, WITHIN_N = 0.08, 0.25
"""A trial counts as good if its error is within this share of its target, or within this force."""

_CHOICE_EVENT: Final = "took "
"""Start of the event in which logs of version 0.1 name the network that ``auto`` chose."""


class _Score(TypedDict):
    load_cell_mean_n: float | None
    steady_error_n: float | None
    overshoot_n: float | None
    settle_s: float | None


class GraspSummary(_Score):
    """Figures of one grasp; None for a figure without a value, such as without a load cell.

    Attributes:
        result: Outcome of the grasp, or ``interrupted``.
        object: Name of the object.
        target_n: Target force.
        seed: Seed of the run.
        feedback: Configured feedback: ``fused``, ``current`` or ``vision``.
        vision_share: Share of the hold's cycles that used vision, 0 to 1; None without a hold or without vision.
        vision_losses: Reasons why it was not used in the hold, and their durations, the longest first.
        object_gain: Gain of the object by motor current (see `gripper_force.control.object_gain`); None if it is not
            known.
        object_gain_std: Its relative standard deviation.
        object_gain_true: Stiffness of the simulated object over that of its kind; None for a real one.
        fell_back: True if the feedback includes vision, but less than half of the hold used it.
        load_cell_mean_n: Mean of the load cell over the last second of the hold.
        steady_error_n: That mean, less the target.
        overshoot_n: Highest force above the target.
        settle_s: Time from the start of the ramp until the force stays within 5 % of the target, or 0.1 N if that is
            more.
        peak_n: Highest force.
        estimator_p50_ms: Median time of an estimate.
        estimator_p99_ms: 99th percentile of it.
        loop_hz: Rate of the control loop.
        camera_hz: Rate of the camera.
        samples_rejected: Load cell samples that were rejected.
        estimate_mae_n: MAE over the run by source: ``visual``, ``current``, ``fused``, and the ``floor``.
        taken: What was chosen for each ``auto``, and why.
        log: Path of the log.
        report: Path of the report, or None.
    """

    result: str
    object: str
    target_n: float
    seed: int
    feedback: str
    vision_share: float | None
    vision_losses: list[VisionLoss]
    object_gain: float | None
    object_gain_std: float | None
    object_gain_true: float | None
    fell_back: bool
    peak_n: float | None
    estimator_p50_ms: float | None
    estimator_p99_ms: float | None
    loop_hz: float | None
    camera_hz: float | None
    samples_rejected: int | None
    estimate_mae_n: dict[str, float | None]
    taken: list[str]
    log: str
    report: str | None


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


def grasp(config: Config, progress: Progress = no_progress, path: Path | None = None) -> GraspSummary:
    """Runs one grasp, writes its log and its report, and summarises it.

    Args:
        config: The run.
        progress: Called at each change of phase.
        path: Log to write; None: `new_log`.

    Raises:
        GripperError: The run failed. Its log holds what was recorded until then.
    """
    path = path or new_log(config)
    run_grasp(config, path, progress)
    return summary_and_report(config, path)


def require_report(config: Config) -> None:
    """Raises `ConfigError` if ``log.report`` is set and a package for it is missing, so that no run is in vain."""
    if config.log.report:
        require("matplotlib", "log.report=true", ", or set log.report=false")


def summary_and_report(config: Config, path: Path) -> GraspSummary:
    """Summarises the log of a grasp, and writes its report if ``log.report`` is set."""
    result = summarise_grasp(path)
    if config.log.report:
        from gripper_force.jobs.report import write_report

        result["report"] = str(write_report(path).html)
    return result


def run_grasp(config: Config, path: Path, progress: Progress = no_progress) -> None:
    """Grasps, holds and releases as configured, and writes the log.

    Args:
        config: The run.
        path: Log to write.
        progress: Called at each change of phase.

    Raises:
        RequestError: The target is above the force limit or a profile's calibrated range.
        GripperError: Something failed. The servo was stopped as configured, and the log holds the run until
            then.
    """
    require_report(config)
    resolved = resolve(config)
    resolved.check_target(config.target_n)
    with open_run(resolved, path) as session:
        grasp_and_release(session, config.target_n, progress)


def grasp_and_release(session: Session, target_n: float, progress: Progress = no_progress) -> str:
    """Grasps, holds for ``control.hold_s`` and releases as configured. Returns the outcome.

    Args:
        session: An open session.
        target_n: Target force.
        progress: Called at each change of phase.
    """
    config = session.resolved.config
    session.wait_for_reference()
    status = session.cycle(RequestKind.GRASP, target_n).status
    begin_ns, phase = status.t_ns, ""
    ended_ns: int | None = None
    while True:
        if status.phase != phase:
            _report_phase(progress, status, begin_ns)
        phase = status.phase
        if status.outcome != Outcome.NONE and ended_ns is None:
            ended_ns = status.t_ns
        if ended_ns is not None:
            hold_s = config.control.hold_s if status.outcome == Outcome.HELD else 0.0
            if status.t_ns - ended_ns >= hold_s * NS_PER_S:
                break
        status = session.cycle().status
    if status.outcome == Outcome.FAULT or config.on_exit == "hold":
        return status.outcome  # the session ends as configured
    status = session.release()
    _report_phase(progress, status, begin_ns)
    return status.outcome


def _report_phase(progress: Progress, status: GraspStatus, begin_ns: int) -> None:
    parts = (f"{(status.t_ns - begin_ns) / NS_PER_S:8.2f} s", status.phase, status.outcome, status.reason)
    progress("  ".join(part for part in parts if part))


def exclusive_device(config: Config) -> str:
    """Returns key and value of a device that only one process can open, or an empty text."""
    servo = config.servo
    if servo.backend != "dynamixel":
        return f"servo.backend={servo.backend}"
    if not servo.is_virtual:
        return f"servo.port={servo.port}"
    for unit, backend in (("camera", config.camera.backend), ("load_cell", config.load_cell.backend)):
        if backend not in ("none", "simulated", "playback"):
            return f"{unit}.backend={backend}"
    return ""


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
                "grasps of the same object follow one another; pass one --object, and no --jobs but 1"
            )
        config = with_same_object(config)
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
                f"and at the fault with: gripper-force replay {result['log']} --report"
            )


def with_same_object(config: Config) -> Config:
    """Returns a configuration whose simulated object and gripper do not depend on the seed of the trial."""
    sim = config.sim
    return config.with_values(
        sim={
            "object_seed": config.seed if sim.object_seed is None else sim.object_seed,
            "rig_seed": config.seed if sim.rig_seed is None else sim.rig_seed,
        }
    )


def summarise_grasp(path: Path) -> GraspSummary:
    """Computes the figures of a grasp from its log."""
    reader = LogReader(path)
    records: dict[type, list[Any]] = defaultdict(list)
    for record in reader.records(Event, GraspStatus, LoadCellSample, ServoState, VisualForce, FusedForce):
        records[type(record)].append(record)
    statuses, cells = records[GraspStatus], sorted(records[LoadCellSample], key=lambda c: c.t_ns)
    cycles_ns = [state.t_ns for state in records[ServoState]]
    visuals = [visual for visual in records[VisualForce] if visual.is_familiar]
    compute_ms = [visual.compute_ms for visual in visuals]
    vision_s = (visuals[-1].t_ns - visuals[0].t_ns) / NS_PER_S if len(visuals) > 1 else 0.0
    config = config_from_text(reader.config, str(path))
    vision = vision_in_hold(statuses, records[FusedForce], visuals, records[Event])
    shown = vision if controls_with_vision(config) else None
    expects_vision = controls_with_vision(config) or config.control.feedback == "vision"
    # A release that fails does not change what the grasp reached.
    outcomes = [s.outcome for s in statuses if s.outcome not in (Outcome.NONE, Outcome.BLOCKED)]
    gains = [fused for fused in records[FusedForce] if fused.object_gain]
    span_s = (cycles_ns[-1] - cycles_ns[0]) / NS_PER_S if len(cycles_ns) > 1 else 0.0
    return {
        "result": outcomes[-1] if outcomes else "interrupted",
        "object": config.object,
        "target_n": config.target_n,
        "seed": config.seed,
        "feedback": config.control.feedback,
        "vision_share": None if shown is None else shown.share,
        "vision_losses": [] if shown is None else shown.losses,
        "object_gain": gains[-1].object_gain if gains else None,
        "object_gain_std": gains[-1].object_gain_std if gains else None,
        "object_gain_true": stiffness_of(reader.metadata) if "scene" in reader.metadata else None,
        "fell_back": expects_vision and vision is not None and vision.share < MIN_VISION_SHARE,
        **_score(cells, statuses, config.target_n),
        "peak_n": max((c.force_n for c in cells if c.valid), default=None),
        "estimator_p50_ms": _percentile(compute_ms, 50),
        "estimator_p99_ms": _percentile(compute_ms, 99),
        "loop_hz": (len(cycles_ns) - 1) / span_s if span_s else None,
        "camera_hz": (visuals[-1].seq - visuals[0].seq) / vision_s if vision_s else None,
        "samples_rejected": sum(not cell.valid for cell in cells) if cells else None,
        "estimate_mae_n": {
            "visual": _mae_n([(v.t_ns, v.force_n) for v in visuals], cells),
            "current": _mae_n([(f.t_ns, f.current_n) for f in records[FusedForce]], cells),
            "fused": _mae_n([(f.t_ns, f.force_n) for f in records[FusedForce]], cells),
            "floor": _floor_n(reader.metadata, cells),
        },
        "taken": _choices(reader.metadata, records[Event]),
        "log": str(path),
        "report": None,
    }


def _choices(metadata: Mapping[str, str], events: list[Event]) -> list[str]:
    if "choices" in metadata:
        return metadata["choices"].splitlines()
    return [event.text for event in events if event.text.startswith(_CHOICE_EVENT)]


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
        "median_error_percent": _percentile(100 * share, 50),
        "p90_error_percent": _percentile(100 * share, 90),
        "median_error_n": _percentile(error_n, 50),
        "good_percent": 100 * int(good.sum()) / len(counted) if peaks and counted else None,
        "median_overshoot_percent": _percentile(100 * overshoot, 50),
        "max_overshoot_percent": _percentile(100 * overshoot, 100),
        "median_settle_s": _percentile([r["settle_s"] for r in scored if r["settle_s"] is not None], 50),
        "peak_n": max(peaks, default=None),
        "over_limit": sum(peak > force_limit_n for peak in peaks) if peaks else None,
        "estimator_p50_ms": _percentile(
            [r["estimator_p50_ms"] for r in results if r["estimator_p50_ms"]], 50
        ),
        "estimate_mae_n": {
            name: _mean_mae_n([r for r in results if name in ("all", r["object"])])
            for name in ("all", *dict.fromkeys(r["object"] for r in results))
        },
    }


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


def _trial(tree: Tree) -> GraspSummary:
    return grasp(config_from(tree, "trials"))


def _mae_n(estimates: list[tuple[int, float]], cells: list[LoadCellSample]) -> float | None:
    """Mean absolute error of the finite estimates over the whole run."""
    finite = [(t_ns, force_n) for t_ns, force_n in estimates if math.isfinite(force_n)]
    figures = load_cell_errors([t for t, _ in finite], [f for _, f in finite], cells)
    return None if figures is None else figures.mae_n


def _floor_n(metadata: Mapping[str, str], cells: list[LoadCellSample]) -> float | None:
    """Mean error floor from the spread of stiffness; None for a real object."""
    if "scene" not in metadata:
        return None
    forces_n = np.array([c.force_n for c in cells if c.valid and math.isfinite(c.force_n)])
    if not len(forces_n):
        return None
    return float(stiffness_floor_n(forces_n, stiffness_of(metadata)).mean())


def _mean_mae_n(results: list[GraspSummary]) -> dict[str, float | None]:
    means = {}
    for source in results[0]["estimate_mae_n"]:
        values = [v for r in results if (v := r["estimate_mae_n"][source]) is not None]
        means[source] = float(np.mean(values)) if values else None
    return means


def _score(cells: list[LoadCellSample], statuses: list[GraspStatus], target_n: float) -> _Score:
    try:
        score = score_grasp(cells, statuses, target_n)
    except DataError:
        return {"load_cell_mean_n": None, "steady_error_n": None, "overshoot_n": None, "settle_s": None}
    return {
        "load_cell_mean_n": score.steady_n,
        "steady_error_n": score.steady_error_n,
        "overshoot_n": score.overshoot_n,
        "settle_s": score.settle_s if np.isfinite(score.settle_s) else None,
    }


def _percentile(values: Any, q: float) -> float | None:
    return float(np.percentile(values, q)) if len(values) else None


def new_log(config: Config) -> Path:
    """Returns a path for the run's log that does not exist yet."""
    stamp = time.strftime("%Y%m%d-%H%M%S")
    stem = f"{stamp}-{config.object}-{config.target_n:g}N-{config.control.feedback}-seed{config.seed}"
    path = config.log.directory / f"{stem}.mcap"
    again = 1
    while path.exists():
        again += 1
        path = config.log.directory / f"{stem}-{again}.mcap"
    return path
