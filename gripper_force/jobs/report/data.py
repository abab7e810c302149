"""What a report shows, read from a log. No drawing here."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from gripper_force.config import Config, config_from_text
from gripper_force.errors import DataError
from gripper_force.jobs.score import GraspScore, score_grasp
from gripper_force.runtime.log import LogReader
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
class Style:
    """How a source of force is named and coloured, in every picture; on light and on dark ground."""

    label: str
    light: str
    dark: str


SOURCES: Final = {
    "current": Style("motor current", "#d55e00", "#f08c4a"),
    "vision": Style("vision", "#009e73", "#35c79c"),
    "fused": Style("fusion", "#0072b2", "#56b4e9"),
    "load_cell": Style("load cell", "#1b1f24", "#f2f4f7"),
}
"""In the order they are drawn. Hues by Okabe and Ito, which colour-blind readers tell apart."""


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """A quantity over time: s since the request, and N. Both (N,)."""

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
    """A line of the table of events."""

    t_s: float
    unit: str
    text: str


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """A run as a report shows it.

    Attributes:
        name: The log's name.
        config: Its configuration.
        config_text: The same as YAML.
        metadata: Versions, digests and other facts.
        zero_ns: Log time of 0 s: the first grasp request, or the log's start.
        begin_s: Time of the first record.
        end_s: Time of the last record.
        target_n: What was asked for; None in a recording without a request.
        outcome: The last outcome, empty where there is none.
        score: The grasp against the load cell; None where nothing was held, or nothing measured it.
        forces: By source; a source that the log lacks is absent.
        errors: Force less the load cell's, by source; only where the load cell gives valid samples.
        reference: The target, shaped by the ramp.
        phases: In order, open ones left out.
        lines: Requests, phases and events in order.
        compute_ms: Time each estimate took.
        camera_age_ms: Age of each frame when it could first be used.
        latency_ms: From the middle of the exposure to the estimate.
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
        """What was grasped, in words."""
        return self.config.object.replace("_", " ").capitalize()

    @property
    def title(self) -> str:
        """What was grasped, how hard, and what came of it."""
        parts = [self.object]
        if self.target_n is not None:
            parts.append(f"target {self.target_n:g} N")
        if self.outcome:
            parts.append(self.outcome.replace("_", " "))
        return " · ".join(parts)


def read_run(path: Path, *, recover: bool = False) -> Run:
    """Reads a log.

    Raises:
        LogError: The log can't be read.
        ConfigError: It holds a configuration that this version does not understand.
    """
    log = LogReader(path, recover=recover)
    vision = list(log.records(VisualForce))
    fused = list(log.records(FusedForce))
    status = list(log.records(GraspStatus))
    requests = list(log.records(Request))
    grasps = [request for request in requests if request.kind == RequestKind.GRASP]
    zero_ns = grasps[0].t_ns if grasps else log.start_ns
    target_n = grasps[-1].target_n if grasps else None
    cell = sorted((s for s in log.records(LoadCellSample) if s.valid), key=lambda s: s.t_ns)
    forces = {
        "current": _series(zero_ns, ((r.t_ns, r.current_n) for r in fused)),
        "vision": _series(zero_ns, ((r.t_ns, r.force_n) for r in vision)),
        "fused": _series(zero_ns, ((r.t_ns, r.force_n) for r in fused)),
        "load_cell": _series(zero_ns, ((r.t_ns, r.force_n) for r in cell)),
    }
    forces = {source: series for source, series in forces.items() if len(series.t_s)}
    # An empty log still has a time axis.
    end_s = (log.start_ns + max(log.duration_ns, NS_PER_MS) - zero_ns) / NS_PER_S
    ages = [frame.received_ns - frame.t_ns for frame in log.records(Frame)]
    return Run(
        name=path.stem,
        config=config_from_text(log.config, str(path)),
        config_text=log.config,
        metadata=log.metadata,
        zero_ns=zero_ns,
        begin_s=(log.start_ns - zero_ns) / NS_PER_S,
        end_s=end_s,
        target_n=target_n,
        outcome=next((s.outcome for s in reversed(status) if s.outcome), ""),
        score=_score(cell, status, target_n),
        forces=forces,
        errors=_errors(forces),
        reference=_series(zero_ns, ((s.t_ns, s.reference_n) for s in status)),
        phases=_phases(zero_ns, end_s, status),
        event_rows=_lines(zero_ns, requests, status, log.records(Event)),
        compute_ms=np.array([v.compute_ms for v in vision]),
        camera_age_ms=np.array(ages) / NS_PER_MS,
        latency_ms=np.array([v.ready_ns - v.t_ns for v in vision]) / NS_PER_MS,
    )


def bins(values: Floats) -> tuple[Floats, Floats]:
    """Counts, (30,), and edges, (31,), to just above the 99.5th percentile; the rest is in the last bin."""
    top = max(float(np.percentile(values, 99.5)) * 1.15, 1e-3)
    counts, edges = np.histogram(np.clip(values, 0, top), bins=30, range=(0, top))
    return counts.astype(np.float64), edges


def _series(zero_ns: int, pairs: Iterable[tuple[int, float]]) -> Series:
    values = sorted((pair for pair in pairs if np.isfinite(pair[1])), key=lambda pair: pair[0])
    t_s = np.array([t_ns - zero_ns for t_ns, _ in values], np.float64) / NS_PER_S
    return Series(t_s, np.array([value for _, value in values], np.float64))


def _score(
    cell: list[LoadCellSample], status: list[GraspStatus], target_n: float | None
) -> GraspScore | None:
    if target_n is None:
        return None
    try:
        return score_grasp(cell, status, target_n)
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


def _lines(
    zero_ns: int, requests: list[Request], status: list[GraspStatus], events: Iterable[Event]
) -> list[EventRow]:
    entries = [(r.t_ns, "request", _request_text(r)) for r in requests]
    before: GraspStatus | None = None
    for s in status:
        if before is None or s.phase != before.phase:
            why = f": {s.reason}" if s.reason not in {"", s.phase} else ""
            entries.append((s.t_ns, "phase", s.phase + why))
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
