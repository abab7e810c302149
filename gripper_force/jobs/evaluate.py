"""Evaluation of a checkpoint on recordings that training has not seen."""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gripper_force.config import Config, config_from, config_from_text
from gripper_force.errors import DataError
from gripper_force.jobs import metrics
from gripper_force.jobs.dataset import (
    CLIP_RECORDS,
    CONTACT_N,
    Clip,
    StreamedClip,
    find_logs,
    known_rig,
    label_mask,
    other_rig,
    starts_in_contact,
    stiffness_floor_n,
    without_contact_starts,
)
from gripper_force.jobs.object_gain import gain_of
from gripper_force.jobs.processes import Workers
from gripper_force.jobs.summary_files import check_writable, evaluation_tables, write_summary
from gripper_force.plugins import require
from gripper_force.profiles.apply import read_correction, read_profiles, with_bundle, with_object
from gripper_force.progress import Progress, no_progress
from gripper_force.runtime.log_reader import LogReader
from gripper_force.schema import Tree, as_path
from gripper_force.vision.model_files import read_model


@dataclass(frozen=True, slots=True)
class ObjectErrors:
    """Errors on one object.

    Attributes:
        mae_n: Mean absolute error.
        rmse_n: Root mean squared error.
        contact_mae_n: Mean absolute error over frames in contact; NaN without any.
        floor_n: Error floor: the MAE of a perfect estimator, because stiffness varies and cannot be seen; NaN
            for recordings of real objects.
        frames: Frames with a label.
    """

    mae_n: float
    rmse_n: float
    contact_mae_n: float
    floor_n: float
    frames: int


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Errors of estimates against the load cell.

    Attributes:
        mae_n: Mean absolute error over all frames.
        rmse_n: Root mean squared error.
        bias_n: Mean error; positive if estimates are too high.
        floor_n: Error floor: the MAE of a perfect estimator, because stiffness varies and cannot be seen; NaN
            for recordings of real objects.
        frames: Frames with a label.
        per_object: Errors by object.
        per_bin: Errors by measured force, in bins of 1 N.
        left_out: Logs that were left out because they start in contact.
        per_log: Errors by path of the log; empty for clips.
        failed: Problem of each log that could not be evaluated, by path.
        other_rig: Settings of camera and gripper in which logs differ from the one rig that the network learned from.
    """

    mae_n: float
    rmse_n: float
    bias_n: float
    floor_n: float
    frames: int
    per_object: dict[str, ObjectErrors]
    per_bin: list[metrics.ForceBin]
    left_out: int = 0
    per_log: dict[str, ObjectErrors] = field(default_factory=dict)
    failed: dict[str, str] = field(default_factory=dict)
    other_rig: list[str] = field(default_factory=list)


def evaluate(
    logs: str | Path | Sequence[str | Path],
    checkpoint: str | Path = "default",
    *,
    profile: str | None = None,
    objects: Collection[str] = (),
    config: Config | None = None,
    include_contact_starts: bool = False,
    workers: int = 1,
    ray: str | None = None,
    plot: str | Path | None = None,
    out: str | Path | None = None,
    progress: Progress = no_progress,
) -> Evaluation:
    """Compares a checkpoint's estimates with the load cell, over logs that training has not seen.

    Every frame gets the network's estimate, corrected as in a run; also the frames that a run would reject.
    A log that can't be read, or has no frames or no labels, does not stop the others; see `Evaluation.failed`.

    Example:
        >>> result = evaluate("data/test", "small")  # doctest: +SKIP
        >>> result.mae_n, result.per_object["sponge"].contact_mae_n  # doctest: +SKIP

    Args:
        logs: A folder, searched for ``*.mcap``, or the logs themselves. They need frames and load-cell
            samples: runs, recorded sets and imported recordings.
        checkpoint: Path of a checkpoint, or ``default`` or ``small`` for a shipped one.
        profile: Object profile that corrects the estimates, by name or path; ``own`` for the profile with
            the name of each log's object; None for the configuration's, by default none.
        objects: Only logs of these objects are used; empty for all.
        config: Its ``vision.region`` replaces the region in each log's own configuration, ``vision.precision``
            ``bfloat16`` rounds the convolutions for more speed, and its ``calibration.on_mismatch`` applies to
            profiles of another rig than a log's. Default: the defaults.
        include_contact_starts: Also use logs that start in contact. Their reference frames are wrong, and so
            are the estimates.
        workers: Processes to use. Results do not depend on them. With several, a program needs ``if __name__ ==
            "__main__":`` before this call, because each process imports it.
        ray: Address of a Ray cluster to use instead, see `gripper_force.jobs.ray_pool`; None for none.
        plot: Figure to write: estimates and errors against the load cell; None for none.
        out: Folder for a summary and the estimates, see `gripper_force.jobs.summary_files`; None for none.
        progress: Called after each log.

    Returns:
        The errors over all frames with a load-cell force, by object, and by measured force.

    Raises:
        DataError: There are no logs, none of these objects, or all start in contact.
        LogError: No log can be read. The error is that of the first.
        CheckpointError: The checkpoint can't be read.
        ConfigError: The profile can't be read, or belongs to another checkpoint or camera; or PyTorch is not installed.
    """
    require("torch", "evaluate")
    folder = None if out is None else as_path(out, "the folder of the summary", "name a folder")
    figure = None if plot is None else as_path(plot, "the figure")
    if folder is not None:
        check_writable(folder)
    if figure is not None:
        from gripper_force.jobs.report.plots import check_figure_path

        check_figure_path(figure)
    settings = _settings(config, checkpoint, profile)
    model = read_model(settings.vision.checkpoint)
    paths = find_logs(logs)
    evaluate_log = partial(
        _evaluate_log,
        checkpoint=(model.path, model.digest),
        config=settings.model_dump(mode="json"),
        objects=(objects,) if isinstance(objects, str) else tuple(objects),
        include_contact_starts=include_contact_starts,
    )
    results, failed = Workers(workers, ray).read_logs(evaluate_log, paths, "evaluated", progress)
    evaluated = {paths[number]: log for number, log in results.items() if log is not None}
    if not evaluated:
        raise _no_such_object(objects, [paths[number] for number in results])
    usable = [(path, log.clip, log.forces_n) for path, log in evaluated.items() if log.forces_n is not None]
    if not usable:
        without_contact_starts([log.clip for log in evaluated.values()], model.header.preprocess)  # raises
    clips = [clip for _, clip, _ in usable]
    forces_n = [estimates_n for _, _, estimates_n in usable]
    lead_in = model.header.preprocess.lead_in
    result = replace(
        errors_on(clips, forces_n, lead_in),
        left_out=len(evaluated) - len(clips),
        per_log={str(path): _log_errors(clip, estimates_n, lead_in) for path, clip, estimates_n in usable},
        failed={str(paths[number]): str(error) for number, error in failed.items()},
        other_rig=sorted({text for log in evaluated.values() for text in log.other_rig}),
    )
    if folder is not None:
        columns = [_columns(*log) for log in usable]
        write_summary(folder, f"Evaluation of {checkpoint}", evaluation_tables(result), columns)
    if figure is not None:
        from gripper_force.jobs.report.plots import draw_estimates

        title = f"{checkpoint}: MAE {result.mae_n:.3f} N on {len(clips)} logs"
        draw_estimates(*_labelled(clips, forces_n, lead_in), title, figure)
    return result


def _settings(config: Config | None, checkpoint: str | Path, profile: str | None) -> Config:
    """Returns the configuration with checkpoint and profile; a profile's bundle brings its own checkpoint."""
    settings = (Config() if config is None else config).with_values(vision={"checkpoint": str(checkpoint)})
    if profile is not None:
        settings = settings.with_values(calibration={"object": profile})
    if settings.calibration.object not in (None, "own"):
        settings, _ = with_bundle(settings)
    return settings


def _no_such_object(objects: Collection[str], paths: Sequence[Path]) -> DataError:
    known_objects = sorted({config_from_text(LogReader(path).config, str(path)).object for path in paths})
    names = [objects] if isinstance(objects, str) else objects
    return DataError(f"no log is of {', '.join(names)}; there are {', '.join(known_objects)}")


def _columns(path: Path, clip: Clip, forces_n: npt.NDArray[np.floating]) -> dict[str, npt.NDArray[Any]]:
    """Returns the estimate of each frame of a log, and its load-cell force, NaN without a label; all (T,)."""
    return {
        "log": np.full(len(forces_n), str(path)),
        "object": np.full(len(forces_n), clip.object),
        "frame": np.arange(len(forces_n)),
        "measured_n": np.where(clip.valid, clip.forces_n, np.float32("nan")),
        "visual_n": forces_n,
    }


@dataclass(frozen=True, eq=False)
class _Evaluated:
    """A recording without its images, the estimates (None if it starts in contact), and how its rig differs."""

    clip: Clip
    forces_n: npt.NDArray[np.floating] | None
    other_rig: Sequence[str] = ()


def _evaluate_log(
    path: Path,
    *,
    checkpoint: tuple[Path, str],
    config: Tree,
    objects: tuple[str, ...],
    include_contact_starts: bool,
) -> _Evaluated | None:
    """Reads and estimates one log. None: it is of another object."""
    # The process that only collects the results of others needs no PyTorch, whose import takes seconds.
    from gripper_force.jobs.estimates import estimate_frames
    from gripper_force.vision.batch_inference import kept_checkpoint

    settings = config_from(config, "evaluate")
    reader = LogReader(path)
    logged = config_from_text(reader.config, str(path))
    log_settings = settings.with_values(object=logged.object)
    if settings.calibration.object == "own":
        log_settings, _ = with_bundle(log_settings)
        if log_settings.vision.checkpoint != settings.vision.checkpoint:
            model = read_model(log_settings.vision.checkpoint)
            checkpoint = model.path, model.digest
    ensemble = kept_checkpoint(*checkpoint)
    preprocess = ensemble.header.preprocess
    stream = StreamedClip(reader, logged, reader.records(*CLIP_RECORDS), preprocess, settings.vision.region)
    if objects and logged.object not in objects:
        return None
    profiles = read_profiles(log_settings)
    gain = gain_of(with_object(log_settings.control, profiles).object_ratio, logged.gripper.gain_std)
    correction = None
    if settings.calibration.object is not None:
        correction = read_correction(log_settings, profiles, ensemble, known_rig(logged))
    forces_n = np.concatenate(
        [
            estimate_frames(ensemble, frames, correction, settings.vision.precision)[repeated:]
            for repeated, frames in stream.parts()
        ]
        or [np.empty(0, np.float32)]
    )
    clip = stream.clip(stream.no_images)
    if starts_in_contact(clip.forces_n, preprocess) and not include_contact_starts:
        return _Evaluated(clip, None)
    region = settings.vision.region or logged.vision.region
    log_config = logged.with_values(vision={"region": region})
    differences = other_rig(ensemble.header, log_config, is_profiled=correction is not None)
    return _Evaluated(clip, (1.0 if gain is None else gain.gain) * forces_n, differences)


def errors_on(
    clips: Sequence[Clip], forces_n: Sequence[npt.NDArray[np.floating]], lead_in: int
) -> Evaluation:
    """Returns the errors of estimates against the load cell, over all frames with a label.

    Args:
        clips: Recordings.
        forces_n: Estimates for each clip's frames in N, (T,).
        lead_in: First frames of each clip to leave out. They only serve as reference, and a run gives no
            estimate for them.

    Raises:
        DataError: There are no clips or no labels.
    """
    valid = label_mask(clips, lead_in)
    measured_n, predicted_n, objects = _labelled(clips, forces_n, lead_in)
    floors_n = np.concatenate([stiffness_floor_n(clip.forces_n, clip.stiffness) for clip in clips])[valid]
    return Evaluation(
        mae_n=metrics.mae(predicted_n, measured_n),
        rmse_n=metrics.rmse(predicted_n, measured_n),
        bias_n=metrics.bias(predicted_n, measured_n),
        floor_n=float(floors_n.mean()),
        frames=len(measured_n),
        per_object={
            str(name): _object_errors(
                *(part[objects == name] for part in (predicted_n, measured_n, floors_n))
            )
            for name in np.unique(objects)
        },
        per_bin=metrics.per_bin(predicted_n, measured_n),
    )


def _object_errors(
    predicted_n: npt.NDArray[np.floating],
    measured_n: npt.NDArray[np.float32],
    floors_n: npt.NDArray[np.floating],
) -> ObjectErrors:
    contact = measured_n > CONTACT_N
    return ObjectErrors(
        mae_n=metrics.mae(predicted_n, measured_n),
        rmse_n=metrics.rmse(predicted_n, measured_n),
        contact_mae_n=metrics.mae(predicted_n[contact], measured_n[contact])
        if contact.any()
        else float("nan"),
        floor_n=float(floors_n.mean()),
        frames=len(measured_n),
    )


def _log_errors(clip: Clip, forces_n: npt.NDArray[np.floating], lead_in: int) -> ObjectErrors:
    valid = clip.labelled(lead_in)
    if not valid.any():
        return ObjectErrors(math.nan, math.nan, math.nan, math.nan, 0)
    measured_n = clip.forces_n[valid]
    return _object_errors(forces_n[valid], measured_n, stiffness_floor_n(measured_n, clip.stiffness))


def _labelled(
    clips: Sequence[Clip], forces_n: Sequence[npt.NDArray[np.floating]], lead_in: int
) -> tuple[npt.NDArray[np.floating], npt.NDArray[np.floating], npt.NDArray[np.str_]]:
    """Returns measured and estimated force in N, and the object, of each frame with a label; all (N,)."""
    valid = label_mask(clips, lead_in)
    measured_n = np.concatenate([clip.forces_n for clip in clips])[valid]
    objects = np.concatenate([np.full(len(clip.frames), clip.object) for clip in clips])[valid]
    return measured_n, np.concatenate(forces_n)[valid], objects
