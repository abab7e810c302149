"""Reader of the run that a report shows, from a log in one pass."""

from collections import defaultdict
from collections.abc import Callable, Iterable
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from gripper_force.config import Config, config_from_text, dump_config
from gripper_force.control.state_machine import refused_ns
from gripper_force.errors import DataError
from gripper_force.jobs.dataset import CONTACT_N, label_at
from gripper_force.jobs.replay.feed import Replayed
from gripper_force.jobs.report.run import EventRow, Floats, Loss, Run, Series, Span, Touch, request_text
from gripper_force.jobs.score import (
    GraspScore,
    controls_with_vision,
    drop_out_reasons,
    score_grasp,
    vision_in_hold,
)
from gripper_force.runtime.log_reader import LogReader
from gripper_force.runtime.session import NO_ESTIMATE
from gripper_force.types import (
    GRIPPING,
    NS_PER_MS,
    NS_PER_S,
    EstimateSource,
    Event,
    Frame,
    FusedForce,
    GraspStatus,
    LoadCellSample,
    Outcome,
    Phase,
    Record,
    Request,
    RequestKind,
    ServoCommand,
    ServoState,
    VisualForce,
)

_KINDS: Final = (
    VisualForce,
    FusedForce,
    GraspStatus,
    Request,
    ServoState,
    ServoCommand,
    LoadCellSample,
    Event,
    Frame,
)

_CONTROLLER: Final = ("control", "vision")
"""Units of the controller's events."""

_MIN_LOSS_S: Final = 0.1
"""Shorter times without vision are not marked."""

_BETWEEN_TOUCHES_S: Final = 0.2
"""Time without contact that separates two touches."""


def read_run(
    log: LogReader,
    on_record: Callable[[Record], None] = lambda record: None,
    replayed: Replayed | None = None,
    config: Config | None = None,
) -> Run:
    """Reads a log in one pass.

    Args:
        log: Log of a run or of a recording.
        on_record: Called with each record while the log is read. Frames are not kept.
        replayed: Estimates and decisions of a replay, which replace those of the log.
        config: Configuration of that replay.

    Raises:
        LogError: The log can't be read.
        ConfigError: The log holds a configuration that this version does not understand.
    """
    records, ages_ns = _records(log, on_record)
    logged_status = records[GraspStatus]
    if replayed is not None:
        _replace(records, replayed)
    if config is None:
        config = config_from_text(log.config, str(log.path))
    vision = [visual for visual in records[VisualForce] if visual.is_familiar]
    fused, status, events = records[FusedForce], records[GraspStatus], records[Event]
    refused = refused_ns(events)
    grasps = [r for r in records[Request] if r.kind == RequestKind.GRASP and r.t_ns not in refused]
    zero_ns = grasps[0].t_ns if grasps else log.start_ns
    target_n, begin_ns = (grasps[-1].target_n, grasps[-1].t_ns) if grasps else (None, 0)
    of_grasp = [s for s in status if s.t_ns >= begin_ns]
    # An empty log still needs a time axis.
    end_s = (log.start_ns + max(log.duration_ns, NS_PER_MS) - zero_ns) / NS_PER_S
    samples = sorted((s for s in records[LoadCellSample] if s.valid), key=lambda s: s.t_ns)
    forces = _forces(zero_ns, samples, fused, vision)
    errors = _errors(forces)
    uses_vision = controls_with_vision(config)
    outcome = next((s.outcome for s in reversed(of_grasp) if s.outcome), "")
    # A simulated camera's latency is a constant, and no measurement.
    is_measured = config.camera.backend != "simulated"
    return Run(
        name=log.path.stem,
        config=config,
        config_text=log.config if replayed is None else dump_config(config),
        metadata=log.metadata,
        replayed=replayed is not None,
        zero_ns=zero_ns,
        begin_s=(log.start_ns - zero_ns) / NS_PER_S,
        end_s=end_s,
        target_n=target_n,
        outcome=outcome,
        score=_score(samples, logged_status, target_n, begin_ns),
        vision=vision_in_hold(of_grasp, fused, vision, events) if uses_vision else None,
        object_gain=_object_gain(fused) if outcome == Outcome.HELD else None,
        forces=forces,
        errors=errors,
        std_n=_series(zero_ns, ((r.t_ns, r.std_n) for r in fused)),
        motor=_motor(zero_ns, records[ServoState], records[ServoCommand], status),
        reference=_series(zero_ns, ((s.t_ns, s.reference_n) for s in status)),
        losses=_losses(zero_ns, status, fused, drop_out_reasons(vision, events)) if uses_vision else [],
        touches=_touches(forces.get("load_cell"), errors),
        phases=_phases(zero_ns, end_s, status),
        event_rows=_event_rows(zero_ns, records[Request], status, events),
        compute_ms=np.array([v.compute_ms for v in vision]),
        camera_age_ms=np.array(ages_ns if is_measured else []) / NS_PER_MS,
        latency_ms=np.array([v.ready_ns - v.t_ns for v in vision] if is_measured else []) / NS_PER_MS,
    )


def _records(log: LogReader, on_record: Callable[[Record], None]) -> tuple[dict[type, list[Any]], list[int]]:
    """Returns all records but the frames by type, and each frame's age when it was received, in nanoseconds."""
    records: dict[type, list[Any]] = defaultdict(list)
    ages_ns = []
    for record in log.records(*_KINDS):
        on_record(record)
        if isinstance(record, Frame):
            ages_ns.append(record.received_ns - record.t_ns)
        else:
            records[type(record)].append(record)
    return records, ages_ns


def _replace(records: dict[type, list[Any]], replayed: Replayed) -> None:
    """Replaces the estimates, decisions and events of a log by those of a replay."""
    if replayed.visual:
        records[VisualForce] = replayed.visual
    if replayed.decisions:
        records[FusedForce] = [decision.estimate for decision in replayed.decisions]
        records[GraspStatus] = [decision.status for decision in replayed.decisions]
        records[ServoCommand] = [decision.command for decision in replayed.decisions]
        events = [e for e in records[Event] if e.unit not in _CONTROLLER or e.text.startswith(NO_ESTIMATE)]
        records[Event] = events + [event for decision in replayed.decisions for event in decision.events]


def _series(zero_ns: int, pairs: Iterable[tuple[int, float]]) -> Series:
    values = sorted((pair for pair in pairs if np.isfinite(pair[1])), key=lambda pair: pair[0])
    t_s = np.array([t_ns - zero_ns for t_ns, _ in values], np.float64) / NS_PER_S
    return Series(t_s, np.array([value for _, value in values], np.float64))


def _forces(
    zero_ns: int, samples: list[LoadCellSample], fused: list[FusedForce], vision: list[VisualForce]
) -> dict[str, Series]:
    """Returns the force by source, for each source that the log has."""
    forces = {
        "current": _series(zero_ns, ((r.t_ns, r.current_n) for r in fused)),
        "vision": _series(zero_ns, ((r.t_ns, r.force_n) for r in vision)),
        "fused": _series(zero_ns, ((r.t_ns, r.force_n) for r in fused)),
        "load_cell": _series(zero_ns, ((r.t_ns, r.force_n) for r in samples)),
    }
    return {source: series for source, series in forces.items() if len(series.t_s)}


def _object_gain(fused: list[FusedForce]) -> tuple[float, float] | None:
    """Returns the last gain of the object, and its relative standard deviation; None without one."""
    return next(((f.object_gain, f.object_gain_std) for f in reversed(fused) if f.object_gain), None)


def _motor(
    zero_ns: int, states: list[ServoState], commands: list[ServoCommand], status: list[GraspStatus]
) -> dict[str, Series]:
    motor = {
        "goal_a": _series(zero_ns, ((c.t_ns, c.goal_current_a) for c in commands)),
        "current_a": _series(zero_ns, ((s.t_ns, abs(s.current_a)) for s in states)),
        "width_mm": _series(zero_ns, ((s.t_ns, 1e3 * s.width_m) for s in status)),
        "temperature_c": _series(zero_ns, ((s.t_ns, s.temperature_c) for s in states)),
    }
    return {name: series for name, series in motor.items() if len(series.t_s)}


def _losses(
    zero_ns: int, status: list[GraspStatus], fused: list[FusedForce], reasons: list[tuple[int, str]]
) -> list[Loss]:
    """Finds the times of the grip in which the estimate rests on motor current alone."""
    sources = {estimate.t_ns: estimate.source for estimate in fused}
    losses: list[Loss] = []
    begin_ns: int | None = None
    for s in status:
        is_lost = (
            s.phase in GRIPPING and sources.get(s.t_ns, EstimateSource.CURRENT) == EstimateSource.CURRENT
        )
        if is_lost and begin_ns is None:
            begin_ns = s.t_ns
        if begin_ns is not None and (not is_lost or s is status[-1]):
            if (s.t_ns - begin_ns) / NS_PER_S >= _MIN_LOSS_S:
                reason = next(
                    (text for t_ns, text in reversed(reasons) if t_ns <= s.t_ns), "no estimate was used"
                )
                losses.append(Loss((begin_ns - zero_ns) / NS_PER_S, (s.t_ns - zero_ns) / NS_PER_S, reason))
            begin_ns = None
    return losses


def _touches(cell: Series | None, errors: dict[str, Series]) -> list[Touch]:
    if cell is None:
        return []
    times_s = cell.t_s[cell.value > CONTACT_N]
    if not len(times_s):
        return []
    touches = []
    for part_s in np.split(times_s, np.flatnonzero(np.diff(times_s) > _BETWEEN_TOUCHES_S) + 1):
        begin_s, end_s = float(part_s[0]), float(part_s[-1])
        mae_n = {
            source: float(np.abs(series.value[inside]).mean())
            for source, series in errors.items()
            if (inside := (series.t_s >= begin_s) & (series.t_s <= end_s)).any()
        }
        inside = (cell.t_s >= begin_s) & (cell.t_s <= end_s)
        touches.append(Touch(begin_s, end_s, float(cell.value[inside].max()), mae_n))
    return touches


def _score(
    samples: list[LoadCellSample], status: list[GraspStatus], target_n: float | None, begin_ns: int
) -> GraspScore | None:
    if target_n is None:
        return None
    try:
        return score_grasp(samples, status, target_n, begin_ns)
    except DataError:
        return None


def _errors(forces: dict[str, Series]) -> dict[str, Series]:
    cell = forces.get("load_cell")
    if cell is None:
        return {}
    errors = {}
    cell_ns = _ns(cell.t_s)
    for source, series in forces.items():
        measured_n, is_near = label_at(_ns(series.t_s), cell_ns, cell.value, 0)
        if source != "load_cell" and is_near.any():
            errors[source] = Series(series.t_s[is_near], series.value[is_near] - measured_n[is_near])
    return errors


def _ns(t_s: Floats) -> npt.NDArray[np.int64]:
    return np.round(t_s * NS_PER_S).astype(np.int64)


def _phases(zero_ns: int, end_s: float, status: list[GraspStatus]) -> list[Span]:
    pairs = zip([None, *status], status, strict=False)
    starts = [s for previous, s in pairs if previous is None or previous.phase != s.phase]
    times = [(s.t_ns - zero_ns) / NS_PER_S for s in starts] + [end_s]
    spans = [Span(times[i], times[i + 1], s.phase) for i, s in enumerate(starts)]
    return [span for span in spans if span.phase != Phase.OPEN]


def _event_rows(
    zero_ns: int, requests: list[Request], status: list[GraspStatus], events: list[Event]
) -> list[EventRow]:
    entries = [(r.t_ns, "request", request_text(r)) for r in requests]
    previous: GraspStatus | None = None
    for s in status:
        if previous is None or s.phase != previous.phase:
            reason = f": {s.reason}" if s.reason not in {"", s.phase} else ""
            entries.append((s.t_ns, "phase", s.phase + reason))
        elif s.reason:
            entries.append((s.t_ns, "control", s.reason))
        if s.outcome and (previous is None or s.outcome != previous.outcome):
            entries.append((s.t_ns, "outcome", s.outcome))
        previous = s
    entries += [(e.t_ns, e.unit, e.text) for e in events]
    entries.sort(key=lambda entry: entry[0])
    return [EventRow((t_ns - zero_ns) / NS_PER_S, unit, text) for t_ns, unit, text in entries]
