"""A log once more: the same functions over the same inputs, and every estimate against the load cell."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gripper_force.config import Config, config_from_text
from gripper_force.control.state_machine import Decision
from gripper_force.errors import DataError
from gripper_force.jobs import metrics
from gripper_force.jobs.dataset import CONTACT_N, label_frames
from gripper_force.profiles.apply import correction_of
from gripper_force.runtime.assembly import checkpoint_of, controller_from, make_estimator, settled
from gripper_force.runtime.log import LogReader
from gripper_force.runtime.perception import FrameProcessor
from gripper_force.types import (
    NS_PER_S,
    Frame,
    FusedForce,
    GraspStatus,
    LoadCellSample,
    Request,
    ServoCommand,
    ServoState,
    VisualForce,
)

if TYPE_CHECKING:
    from gripper_force.vision.header import Model


@dataclass(frozen=True)
class Replayed:
    """What a replay computed, and whether it is what the log holds.

    Attributes:
        estimates_identical: Every visual estimate came out as logged, to the bit; None without any.
        decisions_identical: So did every command, status and fused force; None without any.
        changed: How far off the log's they are at most: ``goal_current_a``, ``fused_n``; empty without any.
        visual: Visual estimates, as computed now.
        decisions: Decisions, as computed now.
        load_cell: The log's load-cell samples.
    """

    estimates_identical: bool | None
    decisions_identical: bool | None
    changed: dict[str, float]
    visual: list[VisualForce]
    decisions: list[Decision]
    load_cell: list[LoadCellSample]


def replay(
    path: Path,
    checkpoint_source: str | None = None,
    *,
    overrides: list[str] | None = None,
    recover: bool = False,
) -> dict[str, Any]:
    """Replays a log and reports it against its load cell.

    Args:
        path: Log of a run or of an imported recording.
        checkpoint_source: Another checkpoint to estimate with, instead of the log's own.
        overrides: Assignments ``key.path=value`` that change the log's own configuration, such as a gain.
        recover: Whether to read what is whole of a truncated log.

    Returns:
        ``mae_n, rmse_n, bias_n, per_bin, frames`` of the estimate that the run acted on (or of vision, where
        nothing acted), ``identical`` (None where the log holds no run), ``note`` (why it can't be),
        ``changed`` (see `Replayed`), and the same figures with ``lag_s`` by source.

    Raises:
        LogError: The log can't be read.
        CheckpointError: The checkpoint can't be read.
        DataError: The log holds nothing to replay, or no load cell to compare with.
    """
    reader = LogReader(path, recover=recover)
    config = config_from_text(reader.config, str(path), overrides)
    if checkpoint_source is not None:
        vision = config.vision.model_copy(update={"checkpoint": checkpoint_source})
        config = config.model_copy(update={"vision": vision})
    checkpoint = checkpoint_of(config)
    if checkpoint is not None:
        config, _ = settled(config)
    replayed = run_again(reader, config, checkpoint)
    flags = [f for f in (replayed.estimates_identical, replayed.decisions_identical) if f is not None]
    sources = _sources(replayed)
    best = next((sources[name] for name in ("fused", "visual") if name in sources), None)
    if best is None:
        raise DataError(f"{path} holds no estimate that could be compared with a load cell")
    return {
        **{key: best[key] for key in ("mae_n", "rmse_n", "bias_n", "per_bin", "frames")},
        "per_object": {config.object: {k: best[k] for k in ("mae_n", "rmse_n", "bias_n", "frames")}},
        "identical": all(flags) if flags else None,
        "note": _note(reader, config, checkpoint),
        "changed": replayed.changed,
        "sources": sources,
        "log": str(path),
    }


def run_again(reader: LogReader, config: Config, checkpoint: "Model | None") -> Replayed:
    """Feeds estimator and controller from a log, in the order in which the run had its inputs.

    Where faults were injected into the estimator, the controller has the estimates that it had then.
    """
    spoilt = _spoilt(config)
    processor = FrameProcessor(make_estimator(config, checkpoint, correction_of(config, checkpoint)))
    runs = config.gripper.nm_per_a is not None  # a recording that was imported never had a controller
    controller = controller_from(config) if runs else None
    visual: list[VisualForce] = []
    decisions: list[Decision] = []
    cells: list[LoadCellSample] = []
    logged: dict[type, list[Any]] = defaultdict(list)
    fresh: VisualForce | None = None
    request: Request | None = None
    pending: dict[int, VisualForce] = {}
    for record in reader.records():
        logged[type(record)].append(record)
        if isinstance(record, Frame):
            if (seen := processor.process(record).visual) is not None:
                visual.append(seen)
                pending[record.seq] = seen
        elif isinstance(record, VisualForce):
            again = None if spoilt else pending.pop(record.seq, None)
            # The time an estimate was ready is the run's own, not this computer's.
            fresh = record if again is None else replace(again, ready_ns=record.ready_ns)
        elif isinstance(record, Request):
            request = record
        elif isinstance(record, ServoState) and controller is not None:
            decisions.append(controller.step(record.t_ns, record, fresh, request))
            fresh = request = None
        elif isinstance(record, LoadCellSample):
            cells.append(record)
    return Replayed(
        _same_estimates(logged[VisualForce], visual) if logged[VisualForce] and not spoilt else None,
        _same_decisions(logged, decisions) if logged[ServoCommand] else None,
        _changed(logged, decisions) if logged[ServoCommand] else {},
        visual,
        decisions,
        cells,
    )


def _same_estimates(logged: list[VisualForce], again: list[VisualForce]) -> bool:
    def key(v: VisualForce) -> tuple[int, float, float]:
        return v.seq, v.force_n, v.std_n

    # The last frames may have been seen and not been used any more.
    return [key(v) for v in logged] == [key(v) for v in again[: len(logged)]]


def _same_decisions(logged: dict[type, list[Any]], again: list[Decision]) -> bool:
    # Of a log that was cut, the last cycle may lack its end.
    pairs = (
        (logged[ServoCommand], [d.command for d in again]),
        (logged[FusedForce], [d.estimate for d in again]),
        (logged[GraspStatus], [d.status for d in again]),
    )
    return all(a == b[: len(a)] and len(b) - len(a) <= 1 for a, b in pairs)


def _changed(logged: dict[type, list[Any]], again: list[Decision]) -> dict[str, float]:
    commands = zip(logged[ServoCommand], again, strict=False)
    fused = zip(logged[FusedForce], again, strict=False)
    return {
        "goal_current_a": max(abs(a.goal_current_a - b.command.goal_current_a) for a, b in commands),
        "fused_n": max((abs(a.force_n - b.estimate.force_n) for a, b in fused), default=0.0),
    }


def _spoilt(config: Config) -> bool:
    return any(fault.unit == "estimator" for fault in config.faults)


def _note(reader: LogReader, config: Config, checkpoint: "Model | None") -> str:
    """Why the estimates can't come out the same, or an empty text."""
    used = reader.metadata.get("checkpoint", "")
    if checkpoint is None or used == "":
        return ""
    if _spoilt(config):
        return "faults were injected into the run's estimator: its decisions alone are compared"
    if used != checkpoint.digest:
        return f"the run's checkpoint was {used[:12]}, this one is {checkpoint.digest[:12]}: estimates differ"
    correction = correction_of(config, checkpoint)
    profile, used = (correction.profile.weights if correction else ""), reader.metadata.get("profile", "")
    if used != profile:
        names = [text[:12] or "none" for text in (used, profile)]
        return f"the run's object profile was {names[0]}, this one is {names[1]}: estimates differ"
    return ""


def _sources(replayed: Replayed) -> dict[str, dict[str, Any]]:
    series: dict[str, tuple[list[int], list[float]]] = {}
    if replayed.visual:
        series["visual"] = [v.t_ns for v in replayed.visual], [v.force_n for v in replayed.visual]
    if replayed.decisions:
        estimates = [d.estimate for d in replayed.decisions]
        times = [e.t_ns for e in estimates]
        series["current"] = times, [e.current_n for e in estimates]
        series["fused"] = times, [e.force_n for e in estimates]
    cells = sorted(replayed.load_cell, key=lambda sample: sample.t_ns)
    return {
        name: figures
        for name, (t_ns, force_n) in series.items()
        if (figures := compare(t_ns, force_n, cells)) is not None
    }


def compare(
    t_ns: Sequence[int], force_n: Sequence[float], cells: Sequence[LoadCellSample]
) -> dict[str, Any] | None:
    """An estimate against the load cell: ``mae_n, rmse_n, bias_n, contact_mae_n, lag_s, frames, per_bin``.

    Args:
        t_ns: Times of the estimates, rising.
        force_n: The estimates.
        cells: Load-cell samples by rising time.

    Returns:
        The figures, or None where the load cell has no valid sample near any estimate.
    """
    times_ns, estimates_n = np.array(t_ns, np.int64), np.array(force_n)
    measured_n, valid = label_frames(times_ns, cells, 0)
    if not valid.any():
        return None
    t_s, predicted_n, measured_n = times_ns[valid] / NS_PER_S, estimates_n[valid], measured_n[valid]
    contact = measured_n > CONTACT_N
    return {
        "mae_n": metrics.mae(predicted_n, measured_n),
        "rmse_n": metrics.rmse(predicted_n, measured_n),
        "bias_n": metrics.bias(predicted_n, measured_n),
        "contact_mae_n": metrics.mae(predicted_n[contact], measured_n[contact]) if contact.any() else None,
        "lag_s": metrics.lag_s(t_s, predicted_n, t_s, measured_n),
        "frames": len(predicted_n),
        "per_bin": metrics.per_bin(predicted_n, measured_n),
    }
