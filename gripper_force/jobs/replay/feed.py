"""Estimator and controller run again on the inputs that a log holds."""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol

from gripper_force.config import Config, Overrides, config_from_text
from gripper_force.control.state_machine import Decision
from gripper_force.profiles.apply import read_correction, read_profiles
from gripper_force.runtime.log_reader import LogReader
from gripper_force.runtime.perception import FrameProcessor
from gripper_force.runtime.resolve import ResolvedConfig, make_controller, make_estimator, resolve_vision
from gripper_force.types import (
    Frame,
    FusedForce,
    GraspStatus,
    LoadCellSample,
    Record,
    Request,
    ServoCommand,
    ServoState,
    VisualForce,
)


@dataclass(frozen=True)
class Replayed:
    """Estimates and decisions that a replay computed, and their agreement with the log.

    Attributes:
        estimates_identical: True if every visual estimate equals the logged one; None without any.
        decisions_identical: True if every command, status and fused force does; None without any.
        changed: Largest differences from the log: ``goal_current_a``, ``fused_n``; empty without any.
        visual: Visual estimates, as computed now.
        decisions: Decisions, as computed now.
        load_cell: Load cell samples of the log.
    """

    estimates_identical: bool | None
    decisions_identical: bool | None
    changed: dict[str, float]
    visual: list[VisualForce]
    decisions: list[Decision]
    load_cell: list[LoadCellSample]


def changed_config(
    reader: LogReader, checkpoint: str | Path | None = None, overrides: Overrides | None = None
) -> Config:
    """Returns the configuration of a log with changes."""
    config = config_from_text(reader.config, str(reader.path), overrides)
    return config if checkpoint is None else config.with_values(vision={"checkpoint": str(checkpoint)})


def resolve_replay(config: Config) -> ResolvedConfig:
    """Resolves the configuration of a log: network and object profile; the rest of it is complete.

    Raises:
        ConfigError: The profile does not belong to the network, or nothing fits the budget.
        CheckpointError: The network's file cannot be read.
    """
    config, model, choice = resolve_vision(config)
    # The log's configuration contains the values of the rig profile, whose file may be gone.
    profiles = read_profiles(config.with_values(calibration={"rig": None}))
    return ResolvedConfig(
        config,
        model,
        read_correction(config, profiles, model),
        choices=(choice,) if choice else (),
    )


def run_again(reader: LogReader, resolved: ResolvedConfig) -> Replayed:
    """Feeds estimator and controller from a log, in the order in which the run had its inputs.

    If faults were injected into the run's estimator, the controller gets the logged estimates.

    Args:
        reader: The log.
        resolved: Its configuration.
    """
    kept = _Kept([], [], [])
    agreement = feed(reader, resolved, kept)
    return Replayed(
        agreement.estimates, agreement.decisions, agreement.changed, kept.visual, kept.decisions, kept.cells
    )


class Sink(Protocol):
    """Receiver of all that a replay computes, and of the load cell's samples."""

    def add_visual(self, visual: VisualForce) -> None:
        """Takes the next visual estimate."""

    def add_decision(self, decision: Decision) -> None:
        """Takes the next decision."""

    def add_cell(self, sample: LoadCellSample) -> None:
        """Takes the next sample of the load cell."""


class _Kept(NamedTuple):
    """All that a replay computed, as records."""

    visual: list[VisualForce]
    decisions: list[Decision]
    cells: list[LoadCellSample]

    def add_visual(self, visual: VisualForce) -> None:
        self.visual.append(visual)

    def add_decision(self, decision: Decision) -> None:
        self.decisions.append(decision)

    def add_cell(self, sample: LoadCellSample) -> None:
        self.cells.append(sample)


class Agreement(NamedTuple):
    """Agreement of a replay with its log; the fields are those of `Replayed`."""

    estimates: bool | None
    decisions: bool | None
    changed: dict[str, float]


def feed(reader: LogReader, resolved: ResolvedConfig, sink: Sink) -> Agreement:
    """Runs estimator and controller on a log, as `run_again`. Keeps no record for longer than it is needed."""
    config = resolved.config
    is_faulty = has_faulty_estimates(config)
    had_controller = config.gripper.nm_per_a is not None  # an imported recording had none
    controller = make_controller(config) if had_controller else None
    newest: VisualForce | None = None
    request: Request | None = None
    pending: dict[int, VisualForce | None] = {}
    had_network = bool(reader.metadata.get("checkpoint"))
    # NaN, of a covered view, does not equal itself.
    estimates = _RecordMatcher(lambda v: (v.seq, None if math.isnan(v.force_n) else v.force_n, v.std_n))
    commands = _RecordMatcher(lambda c: c, lambda a, b: abs(a.goal_current_a - b.goal_current_a))
    fused = _RecordMatcher(lambda f: f, lambda a, b: abs(a.force_n - b.force_n))
    status = _RecordMatcher(lambda s: s)
    matcher_of = {VisualForce: estimates, ServoCommand: commands, FusedForce: fused, GraspStatus: status}
    processor = FrameProcessor(make_estimator(resolved))
    for record in reader.records():
        if isinstance(record, Frame):
            if (estimate := processor.process(record).visual) is not None:
                sink.add_visual(estimate)
                estimates.add_replayed(estimate)
                if not had_network:  # so the log has no time at which an estimate was ready
                    newest = replace(estimate, ready_ns=record.received_ns)
            pending[record.seq] = estimate
            if len(pending) > _BACKLOG:
                del pending[next(iter(pending))]
            continue
        if (matcher := matcher_of.get(type(record))) is not None:
            matcher.add_logged(record)
        if isinstance(record, VisualForce):
            # A log whose disk was slow lacks frames; only their estimates are the logged ones.
            is_logged = is_faulty or (resolved.model is not None and record.seq not in pending)
            again = record if is_logged else pending.pop(record.seq, None)
            if again is not None:  # the time at which it was ready is the run's, not this computer's
                newest = replace(again, ready_ns=record.ready_ns)
        elif isinstance(record, Request):
            request = record
        elif isinstance(record, ServoState) and controller is not None:
            decision = controller.step(record.t_ns, record, newest, request)
            sink.add_decision(decision)
            commands.add_replayed(decision.command)
            fused.add_replayed(decision.estimate)
            status.add_replayed(decision.status)
            newest = request = None
        elif isinstance(record, LoadCellSample):
            sink.add_cell(record)
    # The run may have ended before it used the estimates of its last frames, and the last cycle of a truncated log
    # may be incomplete.
    same_decisions = all(matcher.agree(extra=1) for matcher in (commands, fused, status))
    return Agreement(
        estimates.agree() if estimates.logged and not is_faulty else None,
        same_decisions if commands.logged else None,
        {"goal_current_a": commands.largest, "fused_n": fused.largest} if commands.logged else {},
    )


_BACKLOG: Final = 1024
"""Records that wait for their counterpart: a log has it a few records later, or not at all."""


class _RecordMatcher:
    """Compares a log's records of a type with those of the replay, in their order, while both are made.

    Args:
        key: Returns what is compared of a record.
        difference: Difference of two records of which the largest counts.
    """

    def __init__(
        self, key: Callable[[Any], object], difference: Callable[[Any, Any], float] = lambda a, b: 0.0
    ) -> None:
        self._key, self._difference = key, difference
        self._logged: deque[Any] = deque()
        self._replayed: deque[Any] = deque()
        self._same, self._ended = True, False
        self.logged = False
        self.largest = 0.0

    def add_logged(self, record: Record) -> None:
        """Takes the log's next record."""
        self.logged = True
        self._logged.append(record)
        self._compare()

    def add_replayed(self, record: Record) -> None:
        """Takes the replay's next record."""
        self._replayed.append(record)
        self._compare()

    def agree(self, extra: int | None = None) -> bool:
        """Returns True if all logged records equal the replay's, which may have ``extra`` more; None: any number."""
        return self._same and not self._logged and (extra is None or len(self._replayed) <= extra)

    def _compare(self) -> None:
        while self._logged and self._replayed and not self._ended:
            a, b = self._logged.popleft(), self._replayed.popleft()
            self._same = self._same and self._key(a) == self._key(b)
            self.largest = max(self.largest, self._difference(a, b))
        if self._ended or max(len(self._logged), len(self._replayed)) > _BACKLOG:  # a counterpart is missing
            self._same, self._ended = False, True
            self._logged.clear()
            self._replayed.clear()


def has_faulty_estimates(config: Config) -> bool:
    """Returns True if faults were injected into the run's estimator."""
    return any(fault.unit == "estimator" for fault in config.faults)
