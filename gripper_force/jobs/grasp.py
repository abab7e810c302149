"""The main job: one grasp, its log and its summary."""

import math
import time
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, TypedDict

import numpy as np

from gripper_force.config import Config, config_from_text
from gripper_force.errors import DataError
from gripper_force.jobs.dataset import stiffness_floor_n, stiffness_of
from gripper_force.jobs.metrics import percentile
from gripper_force.jobs.replay.comparison import load_cell_errors
from gripper_force.jobs.score import (
    MIN_VISION_SHARE,
    HoldVision,
    VisionLoss,
    controls_with_vision,
    score_grasp,
    vision_in_hold,
)
from gripper_force.plugins import require
from gripper_force.progress import Progress, no_progress
from gripper_force.runtime.log_reader import LogReader
from gripper_force.runtime.resolve import resolve
from gripper_force.runtime.session import Session, open_run
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
        reason: Its reason; empty if interrupted.
        object: Name of the object.
        target_n: Target force.
        seed: Seed of the run.
        feedback: Configured feedback: ``fused``, ``current`` or ``vision``.
        vision_share: Share of the hold's cycles that used vision, 0 to 1; None without a hold or without vision.
        vision_losses: Reasons why it was not used in the hold, and their durations, the longest first.
        object_gain: Gain of the object by motor current (see `gripper_force.control.object_gain`); None if it is not
            known, or the grasp was not held.
        object_gain_std: Its relative standard deviation.
        object_gain_true: Stiffness of the simulated object over that of its kind; None for a real one, or without an
            object.
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
    reason: str
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


def summarise_grasp(path: Path) -> GraspSummary:
    """Computes the figures of a grasp from its log."""
    reader = LogReader(path)
    records: dict[type, list[Any]] = defaultdict(list)
    for record in reader.records(Event, GraspStatus, LoadCellSample, ServoState, VisualForce, FusedForce):
        records[type(record)].append(record)
    statuses, cells = records[GraspStatus], sorted(records[LoadCellSample], key=lambda c: c.t_ns)
    cycles_ns = [state.t_ns for state in records[ServoState]]
    outputs = [visual for visual in records[VisualForce] if math.isfinite(visual.force_n)]  # by the network
    compute_ms = [visual.compute_ms for visual in outputs]
    vision_s = (outputs[-1].t_ns - outputs[0].t_ns) / NS_PER_S if len(outputs) > 1 else 0.0
    visuals = [visual for visual in outputs if visual.is_familiar]
    config = config_from_text(reader.config, str(path))
    vision = vision_in_hold(statuses, records[FusedForce], visuals, records[Event])
    expects_vision = controls_with_vision(config) or config.control.feedback == "vision"
    hold_vision = vision if expects_vision else None
    if hold_vision is not None and not config.uses_vision:
        reason = "the configuration has no network or no camera"
        hold_vision = HoldVision(0.0, [VisionLoss(reason, sum(loss.time_s for loss in hold_vision.losses))])
    # A release that fails does not change what the grasp reached.
    outcomes = [s.outcome for s in statuses if s.outcome not in (Outcome.NONE, Outcome.BLOCKED)]
    result = outcomes[-1] if outcomes else "interrupted"
    # A grasp that was not held teaches no gain.
    gains = [fused for fused in records[FusedForce] if fused.object_gain and result == Outcome.HELD]
    has_object = "scene" in reader.metadata and config.object != "none"  # a simulated one
    span_s = (cycles_ns[-1] - cycles_ns[0]) / NS_PER_S if len(cycles_ns) > 1 else 0.0
    return {
        "result": result,
        "reason": next((s.reason for s in statuses if s.outcome == result), ""),
        "object": config.object,
        "target_n": config.target_n,
        "seed": config.seed,
        "feedback": config.control.feedback,
        "vision_share": None if hold_vision is None else hold_vision.share,
        "vision_losses": [] if hold_vision is None else hold_vision.losses,
        "object_gain": gains[-1].object_gain if gains else None,
        "object_gain_std": gains[-1].object_gain_std if gains else None,
        "object_gain_true": stiffness_of(reader.metadata) if has_object else None,
        "fell_back": expects_vision and vision is not None and vision.share < MIN_VISION_SHARE,
        **_score(cells, statuses, config.target_n),
        "peak_n": max((c.force_n for c in cells if c.valid), default=None),
        "estimator_p50_ms": percentile(compute_ms, 50),
        "estimator_p99_ms": percentile(compute_ms, 99),
        "loop_hz": (len(cycles_ns) - 1) / span_s if span_s else None,
        "camera_hz": (outputs[-1].seq - outputs[0].seq) / vision_s if vision_s else None,
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


def new_log(config: Config) -> Path:
    """Returns a path for the run's log that does not exist yet."""
    stamp = time.strftime("%Y%m%d-%H%M%S")
    stem = f"{stamp}-{config.object}-{config.target_n:g}N-{config.control.feedback}-seed{config.seed}"
    path = config.log.directory / f"{stem}.mcap"
    number = 1
    while path.exists():
        number += 1
        path = config.log.directory / f"{stem}-{number}.mcap"
    return path
