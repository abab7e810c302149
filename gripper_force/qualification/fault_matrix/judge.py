"""Judges from the log of a grasp if the reaction to a fault was as expected."""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

from gripper_force.config import Config
from gripper_force.qualification.fault_matrix.cases import Expected, FaultCase
from gripper_force.runtime.log_reader import LogReader
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
"""Share of the force at the fault below which the grip is taken as let go."""


@dataclass(frozen=True, slots=True)
class Grasp:
    """Result and log of one grasp.

    Attributes:
        result: Outcome, or the name of the error that ended the grasp.
        start_ns: Start of the run.
        cycles: Control cycles run.
        lost: Records that the log lacks.
        peak_n: Highest load-cell force.
        true_peak_n: Highest force in the simulated world.
        log: The log.
    """

    result: str
    start_ns: int
    cycles: int
    lost: int
    peak_n: float
    true_peak_n: float
    log: LogReader

    def records(self, kind: type) -> list[Any]:
        """All records of one kind, in the order of the log."""
        return list(self.log.records(kind))


@dataclass(frozen=True, slots=True)
class FaultFreeGrasp:
    """The same grasp without the fault.

    Attributes:
        begin_s: Time of first contact.
        end_s: Time of the last cycle in contact.
        cycles: Control cycles run.
        peak_n: Highest load-cell force.
        commands: All commands to the servo.
    """

    begin_s: float
    end_s: float
    cycles: int
    peak_n: float
    commands: tuple[ServoCommand, ...]


def judge(
    row: FaultCase, run: Grasp, fault_free: FaultFreeGrasp, config: Config, at_ns: int
) -> tuple[float | None, str]:
    """Judges the reaction to a fault.

    Args:
        row: The fault and the expected reaction.
        run: The grasp with the fault.
        fault_free: The same grasp without it.
        config: Configuration of the grasp.
        at_ns: Time of the fault.

    Returns:
        Time from the fault to the safe state in ms, or None; and the deviation from the expected reaction,
        empty if there is none. The time limit is not checked here.
    """
    live = config.clock == "realtime"  # real-time runs are not reproducible, so commands can't be compared
    match row.expected:
        case Expected.STOP | Expected.STOP_OR_CARRY_ON:
            stop_ns = _stop_ns(run)
            if row.unit == "clock" and stop_ns is not None:
                stop_ns = _let_go_ns(run, at_ns) or stop_ns
            if stop_ns is None:
                return (
                    None,
                    ""
                    if row.expected == Expected.STOP_OR_CARRY_ON
                    else f"the grasp was not stopped: {run.result}",
                )
            return _ms(stop_ns - at_ns), ""
        case Expected.CURRENT_ALONE:
            return _judge_vision(row, run, config, at_ns)
        case Expected.CURRENT_LIMIT:
            return None, "" if run.result in _FINISHED else run.result
        case Expected.CURRENT_LOWERED:
            return _judge_lowering(run, config.control.force_limit_n)
        case Expected.COMPARISON_INVALID:
            reports_ns = [e.t_ns for e in run.records(Event) if e.unit == "load_cell" and e.t_ns >= at_ns]
            same = live or tuple(run.records(ServoCommand)) == fault_free.commands
            return _ms(reports_ns[0] - at_ns) if reports_ns else None, "" if same else "the commands differ"
        case Expected.NO_EFFECT:
            same = live or tuple(run.records(ServoCommand)) == fault_free.commands
            return None, "" if same else "the commands differ"
        case Expected.CARRY_ON:
            missed = 0 if live else fault_free.cycles - run.cycles
            return None, f"{missed} cycles are missing" if missed else ""
        case _:
            raise AssertionError(row.expected)


_FINISHED: Final = ("held", "timeout", "slip")
"""Results of a grasp that was not stopped."""


def _ms(time_ns: float) -> float:
    return time_ns / NS_PER_MS


def _stop_ns(run: Grasp) -> int | None:
    """Time at which the controller went to phase fault or an error ended the session; None if neither."""
    faults = [s.t_ns for s in run.records(GraspStatus) if s.phase == Phase.FAULT]
    errors = [e.t_ns for e in run.records(Event) if e.unit == "session"]
    return min([*faults, *errors], default=None)


def _let_go_ns(run: Grasp, at_ns: int) -> int | None:
    """Time at which the force began to fall. A blocked loop can't observe that the watchdog trips."""
    cells = [(s.t_ns, s.force_n) for s in run.records(LoadCellSample) if s.t_ns >= at_ns and s.valid]
    return next((t_ns for t_ns, force_n in cells if force_n < _LET_GO * cells[0][1]), None)


def _judge_vision(row: FaultCase, run: Grasp, config: Config, at_ns: int) -> tuple[float | None, str]:
    """Judges the drop of vision. The time starts when the first missing estimate was due."""
    alone = [
        f.t_ns for f in run.records(FusedForce) if f.t_ns >= at_ns and f.source == EstimateSource.CURRENT
    ]
    if not alone:
        return None, "vision was never dropped"
    compute_ns = round(config.vision.lockstep_compute_ms * NS_PER_MS)
    some_valid = row.kind in ("slow", "intermittent")  # the estimates that still arrive are valid
    good = [
        v.ready_ns
        for v in run.records(VisualForce)
        if v.is_familiar and v.ready_ns <= alone[0] and (some_valid or v.ready_ns - compute_ns < at_ns)
    ]
    due_ns = max(at_ns, good[-1] + round(NS_PER_S / config.camera.rate_hz)) if good else at_ns
    if row.unit == "estimator" and row.kind == "garbage":
        bad_ns = [
            v.ready_ns for v in run.records(VisualForce) if v.is_familiar and not math.isfinite(v.force_n)
        ]
        due_ns = min(bad_ns, default=at_ns)  # none if the frames were unfamiliar
    return max(_ms(alone[0] - due_ns), 0.0), "" if run.result in _FINISHED else run.result


def _judge_lowering(run: Grasp, limit_n: float) -> tuple[float | None, str]:
    """Longest time from an estimate rising over the limit to a lower goal current; None if none rose over it."""
    over = {f.t_ns: f.force_n > limit_n for f in run.records(FusedForce)}
    worst_ns: int | None = None
    since_ns: int | None = None
    for before, now in pairwise(run.records(ServoCommand)):
        if not over[now.t_ns]:
            since_ns = None
        elif not over[before.t_ns]:
            since_ns = now.t_ns
        if since_ns is not None and (now.goal_current_a < before.goal_current_a or now.goal_current_a == 0):
            worst_ns, since_ns = max(worst_ns or 0, now.t_ns - since_ns), None
    if since_ns is not None:
        return None, "the goal current was not lowered"
    return None if worst_ns is None else _ms(worst_ns), ""
