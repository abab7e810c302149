"""Replay of logs: the same functions over the same inputs, and every estimate against the load cell."""

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from gripper_force import __version__
from gripper_force.config import Overrides, config_from_text
from gripper_force.errors import DataError, GripperError
from gripper_force.jobs.dataset import other_rig
from gripper_force.jobs.processes import Workers
from gripper_force.jobs.replay.comparison import (
    Columns,
    EstimateSeries,
    ReplayResult,
    columns_of,
    errors_by_source,
)
from gripper_force.jobs.replay.feed import changed_config, feed, has_faulty_estimates, resolve_replay
from gripper_force.progress import Progress, no_progress
from gripper_force.runtime.log_reader import LogReader
from gripper_force.runtime.resolve import ResolvedConfig


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

    Returns:
        The errors against the load cell, in newtons, and whether the replay equals the run.

    Raises:
        ConfigError: An override is wrong, or the object profile belongs to another network or camera.
        LogError: The log cannot be read.
        CheckpointError: The network's file cannot be read.
        DataError: The log holds nothing to replay.
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
    reader = LogReader(path, recover=recover)
    resolved = resolve_replay(changed_config(reader, checkpoint, overrides))
    series = EstimateSeries()
    agreement = feed(reader, resolved, series)
    flags = [flag for flag in (agreement.estimates, agreement.decisions) if flag is not None]
    cells = series.cells.sorted()
    sources = errors_by_source(series, cells)
    best = next((sources[name] for name in ("fused", "visual") if name in sources), None)
    if not (series.seq or series.fused_ns):
        raise DataError(f"{path} holds nothing to replay: neither frames of a network nor control cycles")
    overall = (
        {} if best is None else {key: getattr(best, key) for key in ("mae_n", "rmse_n", "bias_n", "frames")}
    )
    rig_differences = (
        []
        if resolved.model is None
        else other_rig(resolved.model.header, resolved.config, is_profiled=resolved.correction is not None)
    )
    result = ReplayResult(
        mae_n=None if best is None else best.mae_n,
        rmse_n=None if best is None else best.rmse_n,
        bias_n=None if best is None else best.bias_n,
        per_bin=[] if best is None else best.per_bin,
        frames=0 if best is None else best.frames,
        seen=len(series.seq),
        refused=series.visual_std_n.count(math.inf),
        per_object={resolved.config.object: overall},
        identical=all(flags) if flags else None,
        note=_note(reader, resolved),
        changed=agreement.changed,
        sources=sources,
        log=str(path),
        other_rig=rig_differences,
    )
    return result, columns_of(result.log, resolved.config.object, series, cells)


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
    replay_one = partial(replay_frames, checkpoint=checkpoint, overrides=overrides, recover=recover)
    results, failed = Workers(workers, ray).read_logs(replay_one, logs, "replayed", progress)
    return Replays(
        [result for result, _ in results.values()],
        [columns for _, columns in results.values()],
        {str(logs[number]): error for number, error in failed.items()},
    )


def _other_vision(resolved: ResolvedConfig) -> str:
    """Returns the difference where only the log or the replay has a network."""
    return (
        "the run had a network, this has none"
        if resolved.model is None
        else "the run had no network, this has one"
    )


def _note(reader: LogReader, resolved: ResolvedConfig) -> str:
    """Returns the reason why estimates or decisions may differ from the logged ones, or an empty text."""
    if reader.damaged:
        return f"{len(reader.damaged)} damaged parts of the log, of 0.1 s each, are left out"
    if resolved.config.gripper.nm_per_a is None:  # an imported recording
        return ""
    run_version = reader.metadata.get("version gripper-force", "")
    if run_version != __version__:
        version = run_version or "unknown"
        return f"version {version} wrote the log, this is {__version__}: its controller may decide otherwise"
    run_digest = reader.metadata.get("checkpoint", "")
    if resolved.model is None or run_digest == "":
        return "" if (resolved.model is None) == (run_digest == "") else _other_vision(resolved)
    if has_faulty_estimates(resolved.config):
        return "faults were injected into the run's estimator, so only decisions are compared"
    if run_digest != resolved.model.digest:
        return f"the run's checkpoint was {run_digest[:12]}, this one is {resolved.model.digest[:12]}: estimates differ"
    profile = resolved.correction.profile.weights if resolved.correction else ""
    run_digest = reader.metadata.get("profile", "")
    if run_digest != profile:
        names = [text[:12] or "none" for text in (run_digest, profile)]
        return f"the run's object profile was {names[0]}, this one is {names[1]}: estimates differ"
    engine = config_from_text(reader.config, str(reader.path)).vision.engine
    if engine != resolved.config.vision.engine:
        return (
            f"the run's engine was {engine}, this one is {resolved.config.vision.engine}: last digits differ"
        )
    return ""
