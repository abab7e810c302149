"""Estimator and controller run again on the inputs that a log holds."""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol

from gripper_force.config import Config, Overrides, config_from_text
from gripper_force.control.state_machine import Decision, GraspController
from gripper_force.jobs.dataset import known_rig
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
        read_correction(config, profiles, model, known_rig(config)),
        choices=(choice,) if choice else (),
    )


def run_again(reader: LogReader, resolved: ResolvedConfig) -> Replayed:
    """Feeds estimator and controller from a log, in the order in which the run had its inputs.

    If faults were injected into the run's estimator, the controller gets the logged estimates.

    Args:
        reader: The log.
        resolved: Its configuration.
    """
    sink = _ReplayRecords([], [], [])
    agreement = feed(reader, resolved, sink)
    return Replayed(
        agreement.estimates, agreement.decisions, agreement.changed, sink.visual, sink.decisions, sink.cells
    )


class Sink(Protocol):
    """Receiver of all that a replay computes, and of the load cell's samples."""

    def add_visual(self, visual: VisualForce) -> None:
        """Takes the next visual estimate."""

    def add_decision(self, decision: Decision) -> None:
        """Takes the next decision."""

    def add_cell(self, sample: LoadCellSample) -> None:
        """Takes the next sample of the load cell."""


class _ReplayRecords(NamedTuple):
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
    replay = _Feed(reader, resolved, sink)
    for record in reader.records():
        replay.take(record)
    return replay.agreement()


class _Feed:
    """Estimator and controller that take a log's records in their order, and the comparison with the log."""

    def __init__(self, reader: LogReader, resolved: ResolvedConfig, sink: Sink) -> None:
        config, self._sink = resolved.config, sink
        self._processor = FrameProcessor(make_estimator(resolved))
        had_controller = config.gripper.nm_per_a is not None  # an imported recording had none
        self._controller = make_controller(config) if had_controller else None
        self._is_faulty = has_faulty_estimates(config)
        self._has_network = resolved.model is not None
        self._had_network = bool(reader.metadata.get("checkpoint"))
        self._newest: VisualForce | None = None
        self._request: Request | None = None
        # By number of the frame, until the log's estimate comes.
        self._pending: dict[int, VisualForce | None] = {}
        # NaN, of a covered view, does not equal itself.
        self._estimates = _RecordMatcher(
            lambda v: (v.seq, None if math.isnan(v.force_n) else v.force_n, v.std_n)
        )
        self._commands = _RecordMatcher(lambda c: c, lambda a, b: abs(a.goal_current_a - b.goal_current_a))
        self._fused = _RecordMatcher(lambda f: f, lambda a, b: abs(a.force_n - b.force_n))
        self._status = _RecordMatcher(lambda s: s)
        self._matchers = {
            VisualForce: self._estimates,
            ServoCommand: self._commands,
            FusedForce: self._fused,
            GraspStatus: self._status,
        }

    def take(self, record: Record) -> None:
        """Takes the log's next record."""
        if (matcher := self._matchers.get(type(record))) is not None:
            matcher.add_logged(record)
        if isinstance(record, Frame):
            self._estimate(record)
        elif isinstance(record, VisualForce):
            # A log whose disk was slow lacks frames; only their estimates are the logged ones.
            is_logged = self._is_faulty or (self._has_network and record.seq not in self._pending)
            estimate = record if is_logged else self._pending.pop(record.seq, None)
            if estimate is not None:  # the time at which it was ready is the run's, not this computer's
                self._newest = replace(estimate, ready_ns=record.ready_ns)
        elif isinstance(record, Request):
            self._request = record
        elif isinstance(record, ServoState) and self._controller is not None:
            self._decide(self._controller, record)
        elif isinstance(record, LoadCellSample):
            self._sink.add_cell(record)

    def _estimate(self, frame: Frame) -> None:
        estimate = self._processor.process(frame).visual
        if estimate is not None:
            self._sink.add_visual(estimate)
            self._estimates.add_replayed(estimate)
            if not self._had_network:  # so the log has no time at which an estimate was ready
                self._newest = replace(estimate, ready_ns=frame.received_ns)
        self._pending[frame.seq] = estimate
        if len(self._pending) > _BACKLOG:
            del self._pending[next(iter(self._pending))]

    def _decide(self, controller: GraspController, state: ServoState) -> None:
        request = self._request
        decision = controller.step(state.t_ns, state, self._newest, request)
        if request is not None and request.new_object and not decision.refusal:
            self._processor.renewal_ns = state.t_ns
        self._newest = self._request = None
        self._sink.add_decision(decision)
        self._commands.add_replayed(decision.command)
        self._fused.add_replayed(decision.estimate)
        self._status.add_replayed(decision.status)

    def agreement(self) -> Agreement:
        """Returns the agreement of all records so far."""
        estimates, commands = self._estimates, self._commands
        # The run may have ended before it used the estimates of its last frames, and the last cycle of a truncated log
        # may be incomplete.
        decisions_agree = all(matcher.agree(extra=1) for matcher in (commands, self._fused, self._status))
        return Agreement(
            estimates.agree() if estimates.logged and not self._is_faulty else None,
            decisions_agree if commands.logged else None,
            {"goal_current_a": commands.largest, "fused_n": self._fused.largest} if commands.logged else {},
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
        self._all_equal, self._is_out_of_step = True, False
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
        return self._all_equal and not self._logged and (extra is None or len(self._replayed) <= extra)

    def _compare(self) -> None:
        while self._logged and self._replayed and not self._is_out_of_step:
            a, b = self._logged.popleft(), self._replayed.popleft()
            self._all_equal = self._all_equal and self._key(a) == self._key(b)
            self.largest = max(self.largest, self._difference(a, b))
        # In the second case a counterpart is missing.
        if self._is_out_of_step or max(len(self._logged), len(self._replayed)) > _BACKLOG:
            self._all_equal, self._is_out_of_step = False, True
            self._logged.clear()
            self._replayed.clear()


def has_faulty_estimates(config: Config) -> bool:
    """Returns True if faults were injected into the run's estimator."""
    return any(fault.unit == "estimator" for fault in config.faults)
