"""Replay of logs: the same functions over the same inputs, and every estimate against the load cell."""

import math
from array import array
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from gripper_force import __version__
from gripper_force.config import Config, Overrides, config_from_text
from gripper_force.control.state_machine import Decision
from gripper_force.errors import DataError, GripperError, UnfamiliarFrameError
from gripper_force.jobs import metrics
from gripper_force.jobs.dataset import CONTACT_N, CellSeries, label_at
from gripper_force.jobs.metrics import ForceBin
from gripper_force.jobs.processes import Workers
from gripper_force.profiles.apply import read_correction, read_profiles
from gripper_force.progress import Progress, no_progress
from gripper_force.runtime.log_reader import LogReader
from gripper_force.runtime.perception import FrameProcessor
from gripper_force.runtime.process import allowed
from gripper_force.runtime.resolve import ResolvedConfig, make_controller, make_estimator, resolve_vision
from gripper_force.types import (
    NS_PER_S,
    ForceEstimate,
    Frame,
    FusedForce,
    GraspStatus,
    Gray,
    LoadCellSample,
    Record,
    Request,
    ServoCommand,
    ServoState,
    VisualForce,
)

if TYPE_CHECKING:  # a log without vision needs no estimator
    from gripper_force.vision.engines import Floats
    from gripper_force.vision.estimator import ForceEstimator


Columns = dict[str, npt.NDArray[Any]]
"""Table of estimates: name and values of each column, (N,)."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """Errors of an estimate against the load cell, in newtons.

    Attributes:
        mae_n: Mean absolute error.
        rmse_n: Root mean square error.
        bias_n: Mean error.
        contact_mae_n: Mean absolute error in contact; None without contact.
        lag_s: Lag of the estimate, in seconds.
        frames: Number of estimates compared.
        per_bin: Errors by force: ``from_n``, ``to_n``, ``mae_n``, ``bias_n``, ``frames``.
    """

    mae_n: float
    rmse_n: float
    bias_n: float
    contact_mae_n: float | None
    lag_s: float
    frames: int
    per_bin: list[ForceBin]


@dataclass(frozen=True, slots=True)
class ReplayResult:
    """Result of `replay`.

    Attributes:
        mae_n: Mean absolute error of the estimate that the run acted on (of vision where there was no loop).
        rmse_n: Its root mean square error.
        bias_n: Its mean error.
        per_bin: Its errors by force.
        frames: Number of estimates compared.
        per_object: The same figures by object.
        identical: True if the replay gave the log's estimates and decisions; None if the log holds no run.
        note: Reason why it cannot be identical; empty without one.
        changed: Largest differences from the log: ``goal_current_a``, ``fused_n``; empty without any.
        sources: `Comparison` by source: ``visual``, ``current``, ``fused``.
        log: Path of the log.
    """

    mae_n: float
    rmse_n: float
    bias_n: float
    per_bin: list[ForceBin]
    frames: int
    per_object: dict[str, dict[str, float]]
    identical: bool | None
    note: str
    changed: dict[str, float]
    sources: dict[str, Comparison]
    log: str


@dataclass(frozen=True, slots=True)
class SourceErrors:
    """Errors of one source over several logs, weighted by their estimates. Fields as in `Comparison`."""

    mae_n: float
    rmse_n: float
    bias_n: float
    frames: int


@dataclass(frozen=True, slots=True)
class ReplaySummary:
    """Result of several replays.

    Attributes:
        logs: Number of logs.
        identical: Number of logs of which the replay gave the same estimates and decisions.
        sources: Errors by source, as in `ReplayResult`.
        per_object: The same by object.
    """

    logs: int
    identical: int
    sources: dict[str, SourceErrors]
    per_object: dict[str, dict[str, SourceErrors]]


@dataclass(frozen=True, slots=True)
class PairedDifference:
    """Difference of a source's error between two replays of the same logs.

    Attributes:
        logs: Number of logs that have the source in both.
        first_n: Mean over the logs of the first replay's mean absolute error.
        second_n: The same of the second.
        difference_n: Mean of second less first.
        low_n: Lower end of the 95 % interval of that mean (Student's t over logs); None with one log.
        high_n: Its upper end.
    """

    logs: int
    first_n: float
    second_n: float
    difference_n: float
    low_n: float | None
    high_n: float | None


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


def replay(
    path: str | Path,
    checkpoint: str | Path | None = None,
    *,
    overrides: Overrides | None = None,
    recover: bool = False,
) -> ReplayResult:
    """Runs estimator and controller again on a log, and compares the estimates with its load cell.

    The replay is open loop: a changed setting changes the decisions, but not what the log's servo, camera and
    load cell measured.

    Args:
        path: Log of a run or of an imported recording.
        checkpoint: Another network to estimate with; None: the log's own.
        overrides: Changes of the log's configuration: ``{"control.ramp_n_s": 4}`` or
            ``["control.ramp_n_s=4"]``.
        recover: Read the intact part of a truncated log.

    Raises:
        LogError: The log cannot be read.
        CheckpointError: The network's file cannot be read.
        DataError: The log holds nothing to replay, or no load cell to compare with.
    """
    return replay_frames(path, checkpoint, overrides=overrides, recover=recover)[0]


def replay_frames(
    path: str | Path,
    checkpoint: str | Path | None = None,
    *,
    overrides: Overrides | None = None,
    recover: bool = False,
) -> "tuple[ReplayResult, Columns]":
    """Replays one log, and returns its errors and its estimates: one row for each visual estimate, or for each cycle.

    Arguments and errors are those of `replay`. The columns are ``log``, ``object``, ``seq`` (0 for a cycle), ``t_ns``,
    ``measured_n`` (load cell), ``visual_n``, ``visual_std_n``, ``fused_n`` and ``current_n``; NaN where there is none.
    """
    reader = LogReader(Path(path), recover=recover)
    run = resolve_replay(changed_config(reader, checkpoint, overrides))
    series = _Series()
    agreement = _feed(reader, run, series, in_batches=_may_batch(reader, run))
    flags = [flag for flag in (agreement.estimates, agreement.decisions) if flag is not None]
    cells = series.cells.sorted()
    sources = _sources(series, cells)
    best = next((sources[name] for name in ("fused", "visual") if name in sources), None)
    if best is None:
        raise DataError(
            f"{path} holds no estimate to compare with a load cell; replay a log of a run with a load cell"
        )
    overall = {"mae_n": best.mae_n, "rmse_n": best.rmse_n, "bias_n": best.bias_n, "frames": best.frames}
    result = ReplayResult(
        mae_n=best.mae_n,
        rmse_n=best.rmse_n,
        bias_n=best.bias_n,
        per_bin=best.per_bin,
        frames=best.frames,
        per_object={run.config.object: overall},
        identical=all(flags) if flags else None,
        note=_note(reader, run),
        changed=agreement.changed,
        sources=sources,
        log=str(path),
    )
    return result, _columns(result.log, run.config.object, series, cells)


def _may_batch(reader: LogReader, run: ResolvedConfig) -> bool:
    """Returns True if no estimate can equal a logged one bit for bit: then batches, which round otherwise, do."""
    model, vision = run.model, run.config.vision
    if model is None or vision.engine != "torch":
        return False
    return reader.metadata.get("checkpoint", "") != model.digest


class _Sink(Protocol):
    """Receiver of all that a replay computes, and of the load cell's samples."""

    def add_visual(self, visual: VisualForce) -> None:
        """Takes the next visual estimate."""

    def add_decision(self, decision: Decision) -> None:
        """Takes the next decision."""

    def add_cell(self, sample: LoadCellSample) -> None:
        """Takes the next sample of the load cell."""


_Cells = tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]
"""Times and forces of the load cell's valid samples by rising time, (N,)."""


class _Series:
    """The numbers that figures and columns need: 8 bytes each, so that a long log takes little memory."""

    def __init__(self) -> None:
        self.seq, self.visual_ns, self.visual_n, self.visual_std_n = (
            array("q"),
            array("q"),
            array("d"),
            array("d"),
        )
        self.fused_ns, self.fused_n, self.current_n = array("q"), array("d"), array("d")
        self.cells = CellSeries()

    def add_visual(self, visual: VisualForce) -> None:
        self.seq.append(visual.seq)
        self.visual_ns.append(visual.t_ns)
        self.visual_n.append(visual.force_n)
        self.visual_std_n.append(visual.std_n)

    def add_decision(self, decision: Decision) -> None:
        self.fused_ns.append(decision.estimate.t_ns)
        self.fused_n.append(decision.estimate.force_n)
        self.current_n.append(decision.estimate.current_n)

    def add_cell(self, sample: LoadCellSample) -> None:
        self.cells.add(sample)


def _columns(log: str, object_name: str, series: _Series, cells: _Cells) -> Columns:
    has_visual = len(series.seq) > 0
    t_ns = np.array(series.visual_ns if has_visual else series.fused_ns)
    measured_n, valid = label_at(t_ns, *cells, 0)
    missing = np.full(len(t_ns), np.nan)
    fused_n, current_n = missing, missing
    if series.fused_ns:
        newest = np.searchsorted(np.array(series.fused_ns), t_ns, "right") - 1
        fused_n, current_n = (
            np.where(newest < 0, np.nan, np.array(values)[newest])
            for values in (series.fused_n, series.current_n)
        )
    return {
        "log": np.full(len(t_ns), log, object),  # one text; an array of texts would hold a copy in each row
        "object": np.full(len(t_ns), object_name, object),
        "seq": np.array(series.seq) if has_visual else np.zeros(len(t_ns), np.int64),
        "t_ns": t_ns,
        "measured_n": np.where(valid, measured_n, np.nan),
        "visual_n": np.array(series.visual_n) if has_visual else missing,
        "visual_std_n": np.array(series.visual_std_n) if has_visual else missing,
        "fused_n": fused_n,
        "current_n": current_n,
    }


class Replays(NamedTuple):
    """Replays of several logs, in the order of the logs.

    Attributes:
        results: Results of the logs that could be replayed.
        columns: Their estimates, see `replay_frames`.
        failed: Problem of each other log, by path.
    """

    results: list[ReplayResult]
    columns: list[Columns]
    failed: dict[str, GripperError]


def replay_each(
    logs: Sequence[Path],
    checkpoint: str | Path | None = None,
    *,
    overrides: Overrides | None = None,
    recover: bool = False,
    workers: int = 1,
    ray: str | None = None,
    progress: Progress = no_progress,
) -> Replays:
    """Replays several logs. A log that can't be replayed does not stop the others.

    Args:
        logs: The logs.
        checkpoint: As for `replay`.
        overrides: As for `replay`.
        recover: As for `replay`.
        workers: Processes to use. Results do not depend on them.
        ray: Address of a Ray cluster to use instead, see `gripper_force.jobs.ray_pool`; None for none.
        progress: Called after each log.

    Raises:
        GripperError: No log could be replayed; the first one's error, as for `replay`.
    """
    one = partial(replay_frames, checkpoint=checkpoint, overrides=overrides, recover=recover)
    found, failed = Workers(workers, ray).read_logs(one, logs, "replayed", progress)
    return Replays(
        [result for result, _ in found.values()],
        [columns for _, columns in found.values()],
        {str(logs[number]): error for number, error in failed.items()},
    )


def summary(results: Sequence[ReplayResult]) -> ReplaySummary:
    """Computes the errors over several replays."""
    objects = sorted({name for result in results for name in result.per_object})
    return ReplaySummary(
        logs=len(results),
        identical=sum(result.identical is True for result in results),
        sources=_pooled(results),
        per_object={name: _pooled([r for r in results if name in r.per_object]) for name in objects},
    )


def _pooled(results: Sequence[ReplayResult]) -> dict[str, SourceErrors]:
    pooled = {}
    for name in dict.fromkeys(name for result in results for name in result.sources):
        parts = [result.sources[name] for result in results if name in result.sources]
        frames = np.array([part.frames for part in parts])
        weights = frames / frames.sum()
        pooled[name] = SourceErrors(
            mae_n=float(weights @ [part.mae_n for part in parts]),
            rmse_n=float(np.sqrt(weights @ [part.rmse_n**2 for part in parts])),
            bias_n=float(weights @ [part.bias_n for part in parts]),
            frames=int(frames.sum()),
        )
    return pooled


def paired_differences(
    first: Sequence[ReplayResult],
    second: Sequence[ReplayResult],
    columns: "tuple[Sequence[Columns], Sequence[Columns]] | None" = None,
) -> dict[str, PairedDifference]:
    """Compares two replays of the same logs, by source. Each log counts once, however long it is.

    Args:
        first: Results of one side.
        second: Those of the other side, of the same logs.
        columns: Their estimates (see `replay_frames`). With them, visual estimates are compared on the frames that
            the networks of both sides know: otherwise a network that rejects the hard frames would look better.
    """
    found = {}
    for name in ("visual", "current", "fused"):
        pairs = [
            (a.sources[name].mae_n, b.sources[name].mae_n)
            for a, b in zip(first, second, strict=True)
            if name in a.sources and name in b.sources
        ]
        if name == "visual" and columns is not None:
            pairs = [errors for a, b in zip(*columns, strict=True) if (errors := _common_errors_n(a, b))]
        if not pairs:
            continue
        a_n, b_n = np.array(pairs).T
        mean_n, low_n, high_n = metrics.mean_interval(b_n - a_n)
        found[name] = PairedDifference(
            logs=len(pairs),
            first_n=float(a_n.mean()),
            second_n=float(b_n.mean()),
            difference_n=mean_n,
            low_n=low_n,
            high_n=high_n,
        )
    return found


def _common_errors_n(first: Columns, second: Columns) -> tuple[float, float] | None:
    """Returns the mean absolute errors over the frames that both networks know, or None without any."""
    _, at, and_at = np.intersect1d(first["seq"], second["seq"], return_indices=True)
    errors_n = (
        first["visual_n"][at] - first["measured_n"][at],
        second["visual_n"][and_at] - second["measured_n"][and_at],
    )
    known = np.isfinite(
        first["visual_std_n"][at] + second["visual_std_n"][and_at] + errors_n[0] + errors_n[1]
    )
    if not known.any():
        return None
    return float(np.abs(errors_n[0][known]).mean()), float(np.abs(errors_n[1][known]).mean())


def changed_config(
    reader: LogReader, checkpoint: str | Path | None = None, overrides: Overrides | None = None
) -> Config:
    """Returns the configuration of a log with changes."""
    config = config_from_text(reader.config, str(reader.path), overrides)
    if checkpoint is None:
        return config
    vision = config.vision.model_copy(update={"checkpoint": str(checkpoint)})
    return config.model_copy(update={"vision": vision})


def resolve_replay(config: Config) -> ResolvedConfig:
    """Resolves the configuration of a log: network and object profile; the rest of it is complete.

    Raises:
        ConfigError: The profile does not belong to the network, or nothing fits the budget.
        CheckpointError: The network's file cannot be read.
    """
    config, model, choice = resolve_vision(config)
    return ResolvedConfig(
        config,
        model,
        read_correction(config, read_profiles(config), model),
        choices=(choice,) if choice else (),
    )


def run_again(reader: LogReader, run: ResolvedConfig, *, in_batches: bool = False) -> Replayed:
    """Feeds estimator and controller from a log, in the order in which the run had its inputs.

    If faults were injected into the run's estimator, the controller gets the logged estimates.

    Args:
        reader: The log.
        run: Its configuration.
        in_batches: Computes the networks on many frames at a time, with PyTorch. Its rounding differs in the last
            digits from that of a run, which has one frame at a time.
    """
    kept = _Kept([], [], [])
    agreement = _feed(reader, run, kept, in_batches=in_batches)
    return Replayed(
        agreement.estimates, agreement.decisions, agreement.changed, kept.visual, kept.decisions, kept.cells
    )


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


class _Agreement(NamedTuple):
    """Agreement of a replay with its log; the fields are those of `Replayed`."""

    estimates: bool | None
    decisions: bool | None
    changed: dict[str, float]


def _feed(reader: LogReader, run: ResolvedConfig, sink: _Sink, *, in_batches: bool) -> _Agreement:
    """Runs estimator and controller on a log, as `run_again`. Keeps no record for longer than it is needed."""
    config = run.config
    has_faulty_estimates = _has_faulty_estimates(config)
    had_controller = config.gripper.nm_per_a is not None  # an imported recording had none
    controller = make_controller(config) if had_controller else None
    newest: VisualForce | None = None
    request: Request | None = None
    pending: dict[int, VisualForce] = {}
    estimates = _Pairs(lambda v: (v.seq, v.force_n, v.std_n))
    commands = _Pairs(lambda c: c, lambda a, b: abs(a.goal_current_a - b.goal_current_a))
    fused = _Pairs(lambda f: f, lambda a, b: abs(a.force_n - b.force_n))
    status = _Pairs(lambda s: s)
    pairs_of = {VisualForce: estimates, ServoCommand: commands, FusedForce: fused, GraspStatus: status}
    estimated = _in_batches if in_batches and run.model is not None else _frame_by_frame
    for record, estimate in estimated(reader.records(), run):
        if isinstance(record, Frame):
            if estimate is not None:
                sink.add_visual(estimate)
                estimates.add_again(estimate)
                pending[record.seq] = estimate
                if len(pending) > _BACKLOG:
                    del pending[next(iter(pending))]
            continue
        if (pairs := pairs_of.get(type(record))) is not None:
            pairs.add_logged(record)
        if isinstance(record, VisualForce):
            again = None if has_faulty_estimates else pending.pop(record.seq, None)
            # The time at which an estimate was ready is the run's, not this computer's.
            newest = record if again is None else replace(again, ready_ns=record.ready_ns)
        elif isinstance(record, Request):
            request = record
        elif isinstance(record, ServoState) and controller is not None:
            decision = controller.step(record.t_ns, record, newest, request)
            sink.add_decision(decision)
            commands.add_again(decision.command)
            fused.add_again(decision.estimate)
            status.add_again(decision.status)
            newest = request = None
        elif isinstance(record, LoadCellSample):
            sink.add_cell(record)
    # The run may have ended before it used the estimates of its last frames, and the last cycle of a truncated log
    # may be incomplete.
    same_decisions = all(pairs.agree(spare=1) for pairs in (commands, fused, status))
    return _Agreement(
        estimates.agree() if estimates.logged and not has_faulty_estimates else None,
        same_decisions if commands.logged else None,
        {"goal_current_a": commands.largest, "fused_n": fused.largest} if commands.logged else {},
    )


_BACKLOG: Final = 1024
"""Records that wait for their counterpart: a log has it a few records later, or not at all."""


class _Pairs:
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
        self._again: deque[Any] = deque()
        self._same, self._ended = True, False
        self.logged = False
        self.largest = 0.0

    def add_logged(self, record: Record) -> None:
        """Takes the log's next record."""
        self.logged = True
        self._logged.append(record)
        self._compare()

    def add_again(self, record: Record) -> None:
        """Takes the replay's next record."""
        self._again.append(record)
        self._compare()

    def agree(self, spare: int | None = None) -> bool:
        """Returns True if all logged records equal the replay's, which may have ``spare`` more; None: any number."""
        return self._same and not self._logged and (spare is None or len(self._again) <= spare)

    def _compare(self) -> None:
        while self._logged and self._again and not self._ended:
            a, b = self._logged.popleft(), self._again.popleft()
            self._same = self._same and self._key(a) == self._key(b)
            self.largest = max(self.largest, self._difference(a, b))
        if self._ended or max(len(self._logged), len(self._again)) > _BACKLOG:  # a counterpart is missing
            self._same, self._ended = False, True
            self._logged.clear()
            self._again.clear()


def _frame_by_frame(
    records: Iterable[Record], run: ResolvedConfig
) -> Iterator[tuple[Record, VisualForce | None]]:
    """Yields each record, with the estimate of a frame."""
    processor = FrameProcessor(make_estimator(run))
    for record in records:
        yield record, processor.process(record).visual if isinstance(record, Frame) else None


def _in_batches(
    records: Iterable[Record], run: ResolvedConfig
) -> Iterator[tuple[Record, VisualForce | None]]:
    """Yields the records with their estimates, computed many frames at a time. Frames are empty."""
    import torch

    from gripper_force.vision.batch_inference import BATCH, kept_checkpoint, prepared_features
    from gripper_force.vision.engines import Step
    from gripper_force.vision.engines.pytorch import TorchEngine, restored_threads
    from gripper_force.vision.estimator import ForceEstimator

    assert run.model is not None
    vision, checkpoint = run.config.vision, kept_checkpoint(run.model.path, run.model.digest)
    engine = TorchEngine(checkpoint, threads=vision.threads if allowed().torch_threads else None)
    estimator = ForceEstimator(engine, vision.region, run.correction)
    preparation = _Preparation(estimator)
    processor = FrameProcessor(preparation)
    waiting: deque[tuple[Record, VisualForce | None, int]] = deque()  # the last: inputs up to the record

    def batches() -> "Iterator[Floats]":
        """Reads records until there are frames enough."""
        inputs, count = preparation.inputs, 0
        for record in records:
            visual, before = None, len(inputs)
            if isinstance(record, Frame):
                visual = processor.process(record).visual
                record = replace(record, gray=_NO_IMAGE)
            count += len(inputs) - before
            waiting.append((record, visual, count))
            while len(inputs) >= BATCH["cpu"]:
                yield np.stack(inputs[: BATCH["cpu"]])  # (N, S, S)
                del inputs[: BATCH["cpu"]]
        if inputs:
            yield np.stack(inputs)

    chunks = prepared_features(checkpoint.networks, batches())
    works, done = False, 0
    while True:
        with restored_threads():
            torch.set_num_threads(1)  # the last digits depend on their number
            forces_n, features = next(chunks, (_NOTHING, _NOTHING))  # (M, K), (K, F)
        known = done + len(features)
        while waiting and waiting[0][2] <= known:
            record, visual, count = waiting.popleft()
            if visual is not None:
                try:
                    last = count - 1 - done
                    estimate = estimator.finish(Step(forces_n[:, last], features[last], None))
                    visual = replace(visual, force_n=estimate.force_n, std_n=estimate.std_n)
                except GripperError as error:  # as `FrameProcessor` treats it
                    if not works:
                        raise
                    if isinstance(error, UnfamiliarFrameError):
                        visual = replace(visual, force_n=error.force_n, std_n=math.inf)
                    else:
                        visual = None
                works = True
            yield record, visual
        if not len(features):
            return
        done = known


class _Preparation:
    """Takes the place of an estimator in `FrameProcessor`, and only prepares the frames for the networks."""

    def __init__(self, estimator: "ForceEstimator") -> None:
        self._estimator = estimator
        self.inputs: list[Floats] = []

    def update(self, gray: Gray) -> ForceEstimate | None:
        """Prepares the next frame; returns None while the reference is being collected."""
        ready = self._estimator.prepare(gray)
        self.inputs += ready
        return _UNKNOWN if ready else None

    def attention_map(self) -> None:
        """Returns None: nothing was computed yet."""


_UNKNOWN: Final = ForceEstimate(math.nan, math.nan)
_NO_IMAGE: Final = np.zeros((0, 0), np.uint8)
_NOTHING: Final = np.zeros((0, 0), np.float32)


def _has_faulty_estimates(config: Config) -> bool:
    return any(fault.unit == "estimator" for fault in config.faults)


def _note(reader: LogReader, run: ResolvedConfig) -> str:
    """Returns the reason why estimates or decisions may differ from the logged ones, or an empty text."""
    wrote = reader.metadata.get("version gripper-force", "")
    if wrote != __version__:
        return f"version {wrote or 'unknown'} wrote the log, this is {__version__}: its controller may decide otherwise"
    used = reader.metadata.get("checkpoint", "")
    if run.model is None or used == "":
        return ""
    if _has_faulty_estimates(run.config):
        return "faults were injected into the run's estimator, so only decisions are compared"
    if used != run.model.digest:
        return f"the run's checkpoint was {used[:12]}, this one is {run.model.digest[:12]}: estimates differ"
    profile = run.correction.profile.weights if run.correction else ""
    used = reader.metadata.get("profile", "")
    if used != profile:
        names = [text[:12] or "none" for text in (used, profile)]
        return f"the run's object profile was {names[0]}, this one is {names[1]}: estimates differ"
    return ""


def _sources(series: _Series, cells: _Cells) -> dict[str, Comparison]:
    columns: dict[str, tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]] = {}
    if series.seq:
        known = np.array(series.visual_std_n) != np.inf
        columns["visual"] = np.array(series.visual_ns)[known], np.array(series.visual_n)[known]
    if series.fused_ns:
        columns["current"] = np.array(series.fused_ns), np.array(series.current_n)
        columns["fused"] = np.array(series.fused_ns), np.array(series.fused_n)
    return {
        name: figures
        for name, (t_ns, force_n) in columns.items()
        if (figures := _compare(t_ns, force_n, cells)) is not None
    }


def compare(
    t_ns: Sequence[int], force_n: Sequence[float], cells: Sequence[LoadCellSample]
) -> Comparison | None:
    """Compares an estimate with the load cell.

    Args:
        t_ns: Times of the estimates in nanoseconds, rising, (N,).
        force_n: The estimates in newtons, (N,).
        cells: Load cell samples by rising time.

    Returns:
        The errors, or None if the load cell has no valid sample near any estimate.
    """
    series = CellSeries()
    for sample in cells:
        series.add(sample)
    return _compare(np.array(t_ns, np.int64), np.array(force_n), series.sorted())


def _compare(
    times_ns: npt.NDArray[np.int64], estimates_n: npt.NDArray[np.float64], cells: _Cells
) -> Comparison | None:
    measured_n, valid = label_at(times_ns, *cells, 0)
    if not valid.any():
        return None
    t_s, predicted_n, measured_n = times_ns[valid] / NS_PER_S, estimates_n[valid], measured_n[valid]
    contact = measured_n > CONTACT_N
    return Comparison(
        mae_n=metrics.mae(predicted_n, measured_n),
        rmse_n=metrics.rmse(predicted_n, measured_n),
        bias_n=metrics.bias(predicted_n, measured_n),
        contact_mae_n=metrics.mae(predicted_n[contact], measured_n[contact]) if contact.any() else None,
        lag_s=metrics.lag_s(t_s, predicted_n, t_s, measured_n),
        frames=len(predicted_n),
        per_bin=metrics.per_bin(predicted_n, measured_n),
    )
