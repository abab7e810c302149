"""Errors of the estimates of a replay against the load cell, of one log and of several."""

import math
from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from gripper_force.control.state_machine import Decision
from gripper_force.jobs import metrics
from gripper_force.jobs.dataset import CONTACT_N, CellSeries, label_at
from gripper_force.jobs.metrics import ForceBin
from gripper_force.types import (
    NS_PER_S,
    LoadCellSample,
    VisualForce,
)

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
        lag_s: Lag of the estimate, in seconds; None if the forces do not show it.
        frames: Number of estimates compared; frames that the network does not know are not among them.
        per_bin: Errors by force: ``from_n``, ``to_n``, ``mae_n``, ``bias_n``, ``frames``.
    """

    mae_n: float
    rmse_n: float
    bias_n: float
    contact_mae_n: float | None
    lag_s: float | None
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
        seen: Frames that vision has an estimate for, or has refused.
        refused: Those that the network does not know. They have no part in the errors of vision.
        per_object: The same figures by object.
        identical: True if the replay gave the log's estimates and decisions; None if the log holds no run.
        note: Reason why it cannot be identical; empty without one.
        changed: Largest differences from the log: ``goal_current_a``, ``fused_n``; empty without any.
        sources: `Comparison` by source: ``visual``, ``current``, ``fused``.
        log: Path of the log.
        other_rig: Settings of camera and gripper in which the log differs from the one rig that the network learned
            from.
    """

    mae_n: float | None
    rmse_n: float | None
    bias_n: float | None
    per_bin: list[ForceBin]
    frames: int
    seen: int
    refused: int
    per_object: dict[str, dict[str, float]]
    identical: bool | None
    note: str
    changed: dict[str, float]
    sources: dict[str, Comparison]
    log: str
    other_rig: list[str] = field(default_factory=list)


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
        seen: As in `ReplayResult`, over all logs.
        refused: Likewise.
        sources: Errors by source, as in `ReplayResult`.
        per_object: The same by object.
    """

    logs: int
    identical: int
    seen: int
    refused: int
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


Cells = tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]
"""Times and forces of the load cell's valid samples by rising time, (N,)."""


class EstimateSeries:
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
        """Takes the next visual estimate."""
        self.seq.append(visual.seq)
        self.visual_ns.append(visual.t_ns)
        self.visual_n.append(visual.force_n)
        self.visual_std_n.append(visual.std_n)

    def add_decision(self, decision: Decision) -> None:
        """Takes the next decision."""
        self.fused_ns.append(decision.estimate.t_ns)
        self.fused_n.append(decision.estimate.force_n)
        self.current_n.append(decision.estimate.current_n)

    def add_cell(self, sample: LoadCellSample) -> None:
        """Takes the next sample of the load cell."""
        self.cells.add(sample)


def columns_of(log: str, object_name: str, series: EstimateSeries, cells: Cells) -> Columns:
    """Returns the table of a replay's estimates, see `gripper_force.jobs.replay.replay_frames`."""
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


def errors_by_source(series: EstimateSeries, cells: Cells) -> dict[str, Comparison]:
    """Returns the errors of each source that has an estimate near a sample of the load cell."""
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
        if (figures := _errors(t_ns, force_n, cells)) is not None
    }


def load_cell_errors(
    t_ns: Sequence[int], force_n: Sequence[float], cells: Sequence[LoadCellSample]
) -> Comparison | None:
    """Returns the errors of an estimate against the load cell.

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
    return _errors(np.array(t_ns, np.int64), np.array(force_n), series.sorted())


def _errors(
    times_ns: npt.NDArray[np.int64], estimates_n: npt.NDArray[np.float64], cells: Cells
) -> Comparison | None:
    measured_n, valid = label_at(times_ns, *cells, 0)
    if not valid.any():
        return None
    t_s, predicted_n, measured_n = times_ns[valid] / NS_PER_S, estimates_n[valid], measured_n[valid]
    contact, lag_s = measured_n > CONTACT_N, metrics.lag_s(t_s, predicted_n, t_s, measured_n)
    return Comparison(
        mae_n=metrics.mae(predicted_n, measured_n),
        rmse_n=metrics.rmse(predicted_n, measured_n),
        bias_n=metrics.bias(predicted_n, measured_n),
        contact_mae_n=metrics.mae(predicted_n[contact], measured_n[contact]) if contact.any() else None,
        lag_s=None if math.isnan(lag_s) else lag_s,
        frames=len(predicted_n),
        per_bin=metrics.per_bin(predicted_n, measured_n),
    )


def summarise_replays(results: Sequence[ReplayResult]) -> ReplaySummary:
    """Computes the errors over several replays."""
    objects = sorted({name for result in results for name in result.per_object})
    return ReplaySummary(
        logs=len(results),
        identical=sum(result.identical is True for result in results),
        seen=sum(result.seen for result in results),
        refused=sum(result.refused for result in results),
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
    differences = {}
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
        differences[name] = PairedDifference(
            logs=len(pairs),
            first_n=float(a_n.mean()),
            second_n=float(b_n.mean()),
            difference_n=mean_n,
            low_n=low_n,
            high_n=high_n,
        )
    return differences


def _common_errors_n(first: Columns, second: Columns) -> tuple[float, float] | None:
    """Returns the mean absolute errors over the frames that both networks know, or None without any."""
    _, first_rows, second_rows = np.intersect1d(first["seq"], second["seq"], return_indices=True)
    errors_n = (
        first["visual_n"][first_rows] - first["measured_n"][first_rows],
        second["visual_n"][second_rows] - second["measured_n"][second_rows],
    )
    is_common = np.isfinite(
        first["visual_std_n"][first_rows] + second["visual_std_n"][second_rows] + errors_n[0] + errors_n[1]
    )
    if not is_common.any():
        return None
    return float(np.abs(errors_n[0][is_common]).mean()), float(np.abs(errors_n[1][is_common]).mean())
