"""A run as a report shows it."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from gripper_force.config import Config
from gripper_force.jobs.score import GraspScore, HoldVision
from gripper_force.runtime.backends import is_simulated
from gripper_force.types import Request, RequestKind

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
    """A quantity over time: seconds since the request, (N,), and values in the unit of the quantity, (N,)."""

    t_s: Floats
    value: Floats


@dataclass(frozen=True, slots=True)
class Span:
    """A phase of the grasp."""

    start_s: float
    end_s: float
    phase: str


@dataclass(frozen=True, slots=True)
class Loss:
    """A time of the grip in which the force estimate did not use vision, and its reason."""

    start_s: float
    end_s: float
    reason: str


@dataclass(frozen=True, slots=True)
class Touch:
    """A time in contact by the load cell.

    Attributes:
        start_s: First contact.
        end_s: Last contact.
        peak_n: Largest force.
        mae_n: Mean absolute error by source.
    """

    start_s: float
    end_s: float
    peak_n: float
    mae_n: dict[str, float]


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
        replayed: True if estimates and decisions are those of an open-loop replay with changes.
        zero_ns: Log time of 0 s: the first grasp request, or the log's start.
        begin_s: Time of the first record.
        end_s: Time of the last record.
        target_n: Target force of the last grasp request; None in a recording without a request.
        outcome: Last outcome; empty without one.
        score: Grasp compared with the load cell; None without a hold or a load cell.
        vision: Use of vision in the hold; None without a hold or without vision.
        object_gain: Last gain of the object by motor current, and its relative standard deviation; None without one,
            or if the last grasp was not held: it taught none.
        forces: Force by source; sources that the log lacks are absent.
        errors: Force minus the load cell's force, by source; only where the load cell gives valid samples.
        std_n: Claimed standard deviation of the fused estimate.
        motor: ``current_a``, ``goal_a`` (the largest allowed current), ``width_mm`` and ``temperature_c``, as far as
            the log has them.
        reference: Target force, shaped by the ramp.
        losses: Times of the grip without vision, if it was to be used.
        touches: Touches by the load cell.
        phases: Phases in order, without the open ones.
        event_rows: Requests, phases and events in order.
        compute_ms: Computing time of each estimate, (N,).
        camera_age_ms: Age of each frame when it was received, (N,); empty with a simulated camera.
        latency_ms: Time from the middle of the exposure to the estimate, (N,); empty with a simulated camera.
    """

    name: str
    config: Config
    config_text: str
    metadata: dict[str, str]
    replayed: bool
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
    std_n: Series
    motor: dict[str, Series]
    reference: Series
    losses: list[Loss]
    touches: list[Touch]
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
    def simulated(self) -> bool:
        """True if the run has a simulated world."""
        return is_simulated(self.config)

    @property
    def title(self) -> str:
        """Object, target, outcome and origin, in one line."""
        parts = [self.object]
        if self.target_n is not None:
            parts.append(f"target {self.target_n:g} N")
        if self.outcome:
            parts.append(self.outcome.replace("_", " "))
        if self.simulated:
            parts.append("simulated")
        if self.replayed:
            parts.append("replayed with changes, open loop")
        return " · ".join(parts)


def request_text(request: Request) -> str:
    """Returns a request in words."""
    return f"{request.kind} at {request.target_n:g} N" if request.kind == RequestKind.GRASP else request.kind
