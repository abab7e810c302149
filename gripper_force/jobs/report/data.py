"""Data of a report, read from a log in one pass."""

from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from gripper_force.config import Config, config_from_text
from gripper_force.errors import DataError
from gripper_force.jobs.score import GraspScore, HoldVision, controls_with_vision, score_grasp, vision_in_hold
from gripper_force.runtime.log_reader import LogReader
from gripper_force.types import (
    NS_PER_MS,
    NS_PER_S,
    Event,
    Frame,
    FusedForce,
    GraspStatus,
    LoadCellSample,
    Phase,
    Request,
    RequestKind,
    VisualForce,
)

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SourceStyle:
    """Label and colours of a source of force, on a light and on a dark background."""

    label: str
    light: str
    dark: str


SOURCES: Final = {
    "current": SourceStyle("motor current", "#d55e00", "#f08c4a"),
    "vision": SourceStyle("vision", "#009e73", "#35c79c"),
    "fused": SourceStyle("fusion", "#0072b2", "#56b4e9"),
    "load_cell": SourceStyle("load cell", "#1b1f24", "#f2f4f7"),
}
"""Sources in drawing order. Hues of Okabe and Ito, which colour-blind readers can distinguish."""


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """A force over time: seconds since the request, (N,), and newtons, (N,)."""

    t_s: Floats
    value_n: Floats


@dataclass(frozen=True, slots=True)
class Span:
    """A phase of the grasp."""

    start_s: float
    end_s: float
    phase: str


@dataclass(frozen=True, slots=True)
class EventRow:
    """A row of the table of phases and events."""

    t_s: float
    unit: str
    text: str


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """A run as a report shows it.

    Attributes:
        name: File name of the log without its suffix.
        config: Configuration of the run.
        config_text: The same as YAML.
        metadata: Versions, digests and other facts.
        zero_ns: Log time of 0 s: the first grasp request, or the log's start.
        begin_s: Time of the first record.
        end_s: Time of the last record.
        target_n: Target force of the last grasp request; None in a recording without a request.
        outcome: Last outcome; empty without one.
        score: Grasp compared with the load cell; None without a hold or a load cell.
        vision: Use of vision in the hold; None without a hold or without vision.
        object_gain: Last gain of the object by motor current, and its relative standard deviation; None without one.
        forces: Force by source; sources that the log lacks are absent.
        errors: Force minus the load cell's force, by source; only where the load cell gives valid samples.
        reference: Target force, shaped by the ramp.
        phases: Phases in order, without the open ones.
        event_rows: Requests, phases and events in order.
        compute_ms: Computing time of each estimate, (N,).
        camera_age_ms: Age of each frame when it was received, (N,).
        latency_ms: Time from the middle of the exposure to the estimate, (N,).
    """

    name: str
    config: Config
    config_text: str
    metadata: dict[str, str]
    zero_ns: int
    begin_s: float
    end_s: float
    target_n: float | None
    outcome: str
    score: GraspScore | None
    vision: HoldVision | None
    object_gain: tuple[float, float] | None
    forces: dict[str, Series]
    errors: dict[str, Series]
    reference: Series
    phases: list[Span]
    event_rows: list[EventRow]
    compute_ms: Floats
    camera_age_ms: Floats
    latency_ms: Floats

    @property
    def object(self) -> str:
        """Name of the object, for a heading."""
        return self.config.object.replace("_", " ").capitalize()

    @property
    def title(self) -> str:
        """Object, target and outcome, in one line."""
        parts = [self.object]
        if self.target_n is not None:
            parts.append(f"target {self.target_n:g} N")
        if self.outcome:
            parts.append(self.outcome.replace("_", " "))
        return " · ".join(parts)


def read_run(log: LogReader, on_frame: Callable[[Frame], None] = lambda frame: None) -> Run:
    """Reads a log in one pass.

    Args:
        log: Log of a run or of a recording.
        on_frame: Called with each frame while the log is read. Frames are not kept.

    Raises:
        LogError: The log can't be read.
        ConfigError: The log holds a configuration that this version does not understand.
    """
    records: dict[type, list[Any]] = defaultdict(list)
    ages_ns = []
    for record in log.records(VisualForce, FusedForce, GraspStatus, Request, LoadCellSample, Event, Frame):
        if isinstance(record, Frame):
            ages_ns.append(record.received_ns - record.t_ns)
            on_frame(record)
        else:
            records[type(record)].append(record)
    vision, fused, status = records[VisualForce], records[FusedForce], records[GraspStatus]
    requests = records[Request]
    grasps = [request for request in requests if request.kind == RequestKind.GRASP]
    zero_ns = grasps[0].t_ns if grasps else log.start_ns
    target_n = grasps[-1].target_n if grasps else None
    samples = sorted((s for s in records[LoadCellSample] if s.valid), key=lambda s: s.t_ns)
    forces = {
        "current": _series(zero_ns, ((r.t_ns, r.current_n) for r in fused)),
        "vision": _series(zero_ns, ((r.t_ns, r.force_n) for r in vision)),
        "fused": _series(zero_ns, ((r.t_ns, r.force_n) for r in fused)),
        "load_cell": _series(zero_ns, ((r.t_ns, r.force_n) for r in samples)),
    }
    forces = {source: series for source, series in forces.items() if len(series.t_s)}
    # An empty log still needs a time axis.
    end_s = (log.start_ns + max(log.duration_ns, NS_PER_MS) - zero_ns) / NS_PER_S
    config = config_from_text(log.config, str(log.path))
    return Run(
        name=log.path.stem,
        config=config,
        config_text=log.config,
        metadata=log.metadata,
        zero_ns=zero_ns,
        begin_s=(log.start_ns - zero_ns) / NS_PER_S,
        end_s=end_s,
        target_n=target_n,
        outcome=next((s.outcome for s in reversed(status) if s.outcome), ""),
        score=_score(samples, status, target_n),
        vision=vision_in_hold(status, fused, vision, records[Event])
        if controls_with_vision(config)
        else None,
        object_gain=next(
            ((f.object_gain, f.object_gain_std) for f in reversed(fused) if f.object_gain), None
        ),
        forces=forces,
        errors=_errors(forces),
        reference=_series(zero_ns, ((s.t_ns, s.reference_n) for s in status)),
        phases=_phases(zero_ns, end_s, status),
        event_rows=_event_rows(zero_ns, requests, status, records[Event]),
        compute_ms=np.array([v.compute_ms for v in vision]),
        camera_age_ms=np.array(ages_ns) / NS_PER_MS,
        latency_ms=np.array([v.ready_ns - v.t_ns for v in vision]) / NS_PER_MS,
    )


def histogram(values: Floats) -> tuple[Floats, Floats]:
    """Histogram up to just above the 99.5th percentile; the last bin also counts all larger values.

    Returns:
        Counts, (30,), and edges, (31,).
    """
    top = max(float(np.percentile(values, 99.5)) * 1.15, 1e-3)
    counts, edges = np.histogram(np.clip(values, 0, top), bins=30, range=(0, top))
    return counts.astype(np.float64), edges


def _series(zero_ns: int, pairs: Iterable[tuple[int, float]]) -> Series:
    values = sorted((pair for pair in pairs if np.isfinite(pair[1])), key=lambda pair: pair[0])
    t_s = np.array([t_ns - zero_ns for t_ns, _ in values], np.float64) / NS_PER_S
    return Series(t_s, np.array([value for _, value in values], np.float64))


def _score(
    samples: list[LoadCellSample], status: list[GraspStatus], target_n: float | None
) -> GraspScore | None:
    if target_n is None:
        return None
    try:
        return score_grasp(samples, status, target_n)
    except DataError:
        return None


def _errors(forces: dict[str, Series]) -> dict[str, Series]:
    cell = forces.get("load_cell")
    if cell is None:
        return {}
    errors = {}
    for source, series in forces.items():
        shared = (series.t_s >= cell.t_s[0]) & (series.t_s <= cell.t_s[-1])
        if source != "load_cell" and shared.any():
            t_s = series.t_s[shared]
            errors[source] = Series(t_s, series.value_n[shared] - np.interp(t_s, cell.t_s, cell.value_n))
    return errors


def _phases(zero_ns: int, end_s: float, status: list[GraspStatus]) -> list[Span]:
    pairs = zip([None, *status], status, strict=False)
    starts = [s for before, s in pairs if before is None or before.phase != s.phase]
    times = [(s.t_ns - zero_ns) / NS_PER_S for s in starts] + [end_s]
    spans = [Span(times[i], times[i + 1], s.phase) for i, s in enumerate(starts)]
    return [span for span in spans if span.phase != Phase.OPEN]


def _event_rows(
    zero_ns: int, requests: list[Request], status: list[GraspStatus], events: list[Event]
) -> list[EventRow]:
    entries = [(r.t_ns, "request", _request_text(r)) for r in requests]
    before: GraspStatus | None = None
    for s in status:
        if before is None or s.phase != before.phase:
            reason = f": {s.reason}" if s.reason not in {"", s.phase} else ""
            entries.append((s.t_ns, "phase", s.phase + reason))
        elif s.reason:
            entries.append((s.t_ns, "control", s.reason))
        if s.outcome and (before is None or s.outcome != before.outcome):
            entries.append((s.t_ns, "outcome", s.outcome))
        before = s
    entries += [(e.t_ns, e.unit, e.text) for e in events]
    entries.sort(key=lambda entry: entry[0])
    return [EventRow((t_ns - zero_ns) / NS_PER_S, unit, text) for t_ns, unit, text in entries]


def _request_text(request: Request) -> str:
    return f"{request.kind} at {request.target_n:g} N" if request.kind == RequestKind.GRASP else request.kind
