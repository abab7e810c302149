"""Whether what followed from a fault is what was to follow, told from the log of the grasp."""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

from gripper_force.config import Config
from gripper_force.qualification.fault_matrix.cases import Expected, FaultCase
from gripper_force.runtime.log import LogReader
from gripper_force.types import (
    NS_PER_MS,
    NS_PER_S,
    EstimateSource,
    Event,
    FusedForce,
    GraspStatus,
    LoadCellSample,
    Phase,
    ServoCommand,
    VisualForce,
)

_LET_GO: Final = 0.97


@dataclass(frozen=True, slots=True)
class Grasp:
    """What one grasp left behind."""

    result: str
    start_ns: int
    cycles: int
    lost: int
    peak_n: float
    log: LogReader

    def records(self, kind: type) -> list[Any]:
        """All of one kind, in the order of the log."""
        return list(self.log.records(kind))


@dataclass(frozen=True, slots=True)
class Sound:
    """The grasp without the fault: when there was contact, and what was commanded."""

    begin_s: float
    end_s: float
    cycles: int
    peak_n: float
    commands: tuple[ServoCommand, ...]


def judge(row: FaultCase, run: Grasp, sound: Sound, config: Config, at_ns: int) -> tuple[float | None, str]:
    """When the safe state was there, in ms after the fault, and what is wrong with it, if anything is."""
    live = config.clock == "realtime"  # no two such runs are the same
    match row.expected:
        case Expected.STOP | Expected.STOP_OR_CARRY_ON:
            stop_ns = _stop_ns(run)
            if row.unit == "clock" and stop_ns is not None:
                stop_ns = _let_go_ns(run, at_ns) or stop_ns
            if stop_ns is None:
                return None, "" if row.expected == Expected.STOP_OR_CARRY_ON else f"it went on: {run.result}"
            return _ms(stop_ns - at_ns), ""
        case Expected.CURRENT_ALONE:
            return _judge_vision(row, run, config, at_ns)
        case Expected.CAP:
            return None, "" if run.result in _FINISHED else run.result
        case Expected.EASED:
            return _judge_easing(run, config.control.force_limit_n)
        case Expected.COMPARISON_INVALID:
            told = [e.t_ns for e in run.records(Event) if e.unit == "load_cell" and e.t_ns >= at_ns]
            same = live or tuple(run.records(ServoCommand)) == sound.commands
            return _ms(told[0] - at_ns) if told else None, "" if same else "the commands are not the same"
        case Expected.NO_EFFECT:
            same = live or tuple(run.records(ServoCommand)) == sound.commands
            return None, "" if same else "the commands are not the same"
        case Expected.CARRY_ON:
            missed = 0 if live else sound.cycles - run.cycles
            return None, f"{missed} cycles are missing" if missed else ""
        case _:
            raise AssertionError(row.expected)


_FINISHED: Final = ("held", "timeout", "slip")


def _ms(time_ns: float) -> float:
    return time_ns / NS_PER_MS


def _stop_ns(run: Grasp) -> int | None:
    """When the run stopped: the controller at fault, or the session ended by an error."""
    faults = [s.t_ns for s in run.records(GraspStatus) if s.phase == Phase.FAULT]
    errors = [e.t_ns for e in run.records(Event) if e.unit == "session"]
    return min([*faults, *errors], default=None)


def _let_go_ns(run: Grasp, at_ns: int) -> int | None:
    """When the force began to fall, for a loop that was not there to see the watchdog trip."""
    cells = [(s.t_ns, s.force_n) for s in run.records(LoadCellSample) if s.t_ns >= at_ns and s.valid]
    return next((t_ns for t_ns, force_n in cells if force_n < _LET_GO * cells[0][1]), None)


def _judge_vision(row: FaultCase, run: Grasp, config: Config, at_ns: int) -> tuple[float | None, str]:
    """The time from when the first estimate that the fault took away was due."""
    alone = [
        f.t_ns for f in run.records(FusedForce) if f.t_ns >= at_ns and f.source == EstimateSource.CURRENT
    ]
    if not alone:
        return None, "vision never dropped out"
    compute_ns = round(config.vision.lockstep_compute_ms * NS_PER_MS)
    passes = row.kind in ("slow", "intermittent")  # what still comes is sound
    good = [
        v.ready_ns
        for v in run.records(VisualForce)
        if v.ready_ns <= alone[0] and (passes or v.ready_ns - compute_ns < at_ns)
    ]
    due_ns = max(at_ns, good[-1] + round(NS_PER_S / config.camera.rate_hz)) if good else at_ns
    if row.unit == "estimator" and row.kind == "garbage":
        due_ns = min(v.ready_ns for v in run.records(VisualForce) if not math.isfinite(v.force_n))
    return max(_ms(alone[0] - due_ns), 0.0), "" if run.result in _FINISHED else run.result


def _judge_easing(run: Grasp, limit_n: float) -> tuple[float | None, str]:
    """The longest time from an estimate that rises over the limit to a goal current that is lower."""
    over = {f.t_ns: f.force_n > limit_n for f in run.records(FusedForce)}
    worst_ns, since_ns = 0, None
    for before, now in pairwise(run.records(ServoCommand)):
        if over[now.t_ns] and not over[before.t_ns]:
            since_ns = now.t_ns
        if since_ns is not None and (now.goal_current_a < before.goal_current_a or now.goal_current_a == 0):
            worst_ns, since_ns = max(worst_ns, now.t_ns - since_ns), None
    return _ms(worst_ns), ""
