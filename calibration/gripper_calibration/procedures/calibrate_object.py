"""Calibration of an object: touches with the load cell in place, or logs of them, into an object profile."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Final

import numpy as np

from gripper_calibration.fits.cross_validation import Coverage
from gripper_calibration.fits.object_fit import (
    COVERAGE,
    LearningCurvePoint,
    ObjectFit,
    fit_correction,
    learning_curve,
)
from gripper_calibration.fits.plant_fit import crushing_touch, fit_plant, stiffness_n_m
from gripper_calibration.plots.object_plot import draw
from gripper_calibration.procedures.estimate_time import estimate_ms
from gripper_calibration.touch_logs import TouchRecording, join, read_log, started_ns
from gripper_force import __version__
from gripper_force.config import Config
from gripper_force.errors import ConfigError, DataError
from gripper_force.jobs.dataset import find_logs
from gripper_force.jobs.profile_files import check_object_place, pack, write_object
from gripper_force.jobs.recording.record import RecordingPlan, check_name, record
from gripper_force.jobs.trials import with_same_object
from gripper_force.profiles.object_profile import ObjectProfile, user_folder
from gripper_force.progress import Progress, Prompt, no_progress
from gripper_force.runtime.process import allowed_options
from gripper_force.runtime.resolve import ResolvedConfig, resolve_vision
from gripper_force.vision.engines import Engine
from gripper_force.vision.estimator import open_configured_engine
from gripper_force.vision.header import Model
from gripper_force.vision.stream_inference import features

TOUCHES: Final = 8
"""Default number of touches: enough for an object of a kind that the network was not trained on."""


@dataclass(frozen=True, slots=True)
class ObjectCalibration:
    """Result of `calibrate_object`.

    Attributes:
        profile: The profile.
        profile_path: Its YAML file. The ``.safetensors`` file beside it belongs to it.
        report_path: The figure, PNG.
        correction: Name of the selected correction, one of the keys of `candidates_mae_n`.
        candidates_mae_n: Cross-validated MAE of each candidate correction; empty with fewer than three touches.
        coverages: Share of the frames of each touch within an interval that the other touches gave: in contact, and
            by force level; empty with fewer than four touches.
        crushed_at_n: Largest force of the touch after which the object stayed narrower; None if it sprang back
            after all touches.
        stiffness_std_n_m: Standard deviation of the stiffness over the touches; None with fewer than two.
        touches_needed: Learning curve: mean results of fits on fewer touches, tested on the other touches.
        without_contact: Logs that were not used because they show no contact.
        contact_starts: Logs that were not used because they start in contact.
    """

    profile: ObjectProfile
    profile_path: Path
    report_path: Path
    correction: str
    candidates_mae_n: dict[str, float]
    coverages: tuple[Coverage, ...]
    crushed_at_n: float | None
    stiffness_std_n_m: float | None
    touches_needed: tuple[LearningCurvePoint, ...]
    without_contact: tuple[Path, ...]
    contact_starts: tuple[Path, ...]

    @property
    def mae_before_n(self) -> float:
        """MAE of the uncorrected network on the touches, in N."""
        return self.profile.before_n

    @property
    def mae_after_n(self) -> float | None:
        """Cross-validated MAE of the corrected estimate, in N; None with fewer than three touches."""
        return self.profile.after_n

    @property
    def coverage(self) -> float:
        """Coverage that the profile's interval is made for: the share of frames in contact within it."""
        return self.profile.interval.coverage

    def as_dict(self) -> dict[str, object]:
        """Returns the result as the command prints it: the profile's keys and those of the calibration."""
        return {
            **self.profile.model_dump(mode="json"),
            "correction": self.correction,
            "candidates_mae_n": self.candidates_mae_n,
            "coverages": [level._asdict() for level in self.coverages],
            "crushed_at_n": self.crushed_at_n,
            "stiffness_std_n_m": self.stiffness_std_n_m,
            "touches_needed": [point._asdict() for point in self.touches_needed],
            "without_contact": list(self.without_contact),
            "contact_starts": list(self.contact_starts),
            "profile": self.profile_path,
            "report": self.report_path,
        }


@dataclass(frozen=True, slots=True)
class Prepared:
    """Network, engine and output path of a calibration, opened and checked before its touches.

    Attributes:
        config: The configuration without ``auto``.
        model: The network to correct.
        engine: Its engine.
        name: Name of the object.
        out: Profile to write.
    """

    config: Config
    model: Model
    engine: Engine
    name: str
    out: Path


def calibrate_object(
    config: Config,
    name: str,
    *,
    logs: Sequence[str | Path] | None = None,
    touches: int = TOUCHES,
    peak_n: float | None = None,
    folder: str | Path | None = None,
    out: str | Path | None = None,
    prompt: Prompt | None = None,
    progress: Progress = no_progress,
) -> ObjectCalibration:
    """Makes an object profile and a figure, from new touches or from logs.

    Without ``logs``, the configured devices touch the object with random peak forces, with the load cell in
    place; see `record_touches`. An interrupted recording continues with the same arguments.

    Args:
        config: The configuration: the devices, and the network that the profile belongs to. Its ``object`` is
            replaced by ``name``.
        name: Name of the object. In simulation it must be one of the simulated objects.
        logs: Logs of touches, or folders to search for ``*.mcap``. The devices are then not used.
        touches: Number of touches, including those already in ``folder``. Not used with ``logs``.
        peak_n: Largest force of a touch in N; None for what the force limit permits, up to 12 N.
        folder: Folder of the touches' logs; None for ``data/touches/NAME``.
        out: Profile to write, ``*.yaml``; None for ``NAME.yaml`` in the user's folder of profiles.
        prompt: Called before each touch, so that a person can place the object again; None for no pause.
        progress: Called during the touches, with one step for each touch, and after them, with one step for each
            log read and two for the fit.

    Returns:
        The profile, its files, and the errors of all candidate corrections.

    Raises:
        ConfigError: There is no camera or load cell, the peak is not within the force limit, or the profile
            can't be written.
        DataError: The load cell reads a force at rest, a touch failed, or the touches are not sufficient for a
            calibration.
        LogError: A log can't be read.
        CheckpointError: The network can't be read.
        DeviceError: A device failed. The servo was stopped as configured, and completed touches are kept.

    Example:
        ::

            config = gripper_force.load_config("my.yaml")
            result = gripper_force.calibrate_object(config, "mug", touches=8)
            print(result.profile_path, result.mae_before_n, result.mae_after_n)
    """
    prepared = prepare(config, name, out)
    if logs is None:
        named = config.with_values(object=name)
        paths = []
        touch_folder = None if folder is None else Path(folder)
        for path in record_touches(named, touches, peak_n, touch_folder, prompt=prompt, progress=progress):
            paths.append(path)
            progress(f"touch {len(paths)} of {touches}")
    else:
        paths = find_logs(logs)
    if not paths:
        raise DataError(f"there is no log to calibrate {name!r} from; record touches of it first")
    return fit_and_write(prepared, paths, progress)


def prepare(config: Config, name: str, out: str | Path | None = None) -> Prepared:
    """Opens and checks what a calibration needs, before the first touch. The arguments are `calibrate_object`'s.

    Raises:
        ConfigError: There is no network to correct, its engine can't run it, the name can't be part of a file name, or
            the profile can't be written.
        CheckpointError: The network can't be read.
    """
    check_name(name)
    path = user_folder() / f"{name}.yaml" if out is None else Path(out)
    check_object_place(path)
    config, model, _ = resolve_vision(config)
    if model is None:
        raise ConfigError(
            "calibrate object corrects a network, but vision.checkpoint is none; name a network, such as default"
        )
    set_threads = allowed_options().torch_threads
    engine = open_configured_engine(model, config.vision, set_threads=set_threads)
    return Prepared(config, model, engine, name, path)


def record_touches(
    config: Config,
    touches: int,
    peak_n: float | None = None,
    folder: Path | None = None,
    *,
    prompt: Prompt | None = None,
    progress: Progress = no_progress,
) -> Iterator[Path]:
    """Touches the configured object with random peak forces, one log each. Existing logs are kept.

    A simulated object and rig stay the same; the object is placed again for each touch.

    Args:
        config: The configuration.
        touches: Number of touches, including existing ones.
        peak_n: Largest force in N; None for what the force limit permits, up to 12 N.
        folder: Folder of the logs; None for ``data/touches/OBJECT``.
        prompt: Called before each new touch; None for no pause.
        progress: Called with the touch and the force a few times per second, with 0 steps.

    Yields:
        The log of each touch, once it is complete.

    Raises:
        GripperError: As `gripper_force.jobs.recording.record.record`. Completed touches are kept.
    """
    config = with_same_object(config)
    folder = folder or default_folder(config.object)
    yield from record(config, _plan(touches, peak_n), folder, progress, prompt)


def touch_paths(config: Config, touches: int, folder: Path | None = None) -> list[Path]:
    """Returns the paths of the logs that `record_touches` writes, in order."""
    return _plan(touches, None).paths(config, folder or default_folder(config.object))


def move_away(config: Config, folder: Path) -> Path | None:
    """Moves the logs of an object's earlier touches to a new folder beside theirs.

    Args:
        config: The configuration; its ``object`` selects the logs.
        folder: Folder of the logs.

    Returns:
        The new folder; None if there are no such logs.

    Raises:
        DataError: The logs can't be moved.
    """
    first_path = touch_paths(config, 1, folder)[0]
    stem = first_path.stem.removesuffix("01")
    logs = [path for path in folder.glob("*.mcap") if re.fullmatch(rf"{re.escape(stem)}\d\d+", path.stem)]
    if not logs:
        return None
    number = 1
    while (new_folder := folder.with_name(f"{folder.name}-old-{number}")).exists():
        number += 1
    try:
        new_folder.mkdir()
        for path in logs:
            path.rename(new_folder / path.name)
    except OSError as error:
        raise DataError(
            f"can't move the touches in {folder} to {new_folder}: {error}; move them yourself"
        ) from error
    return new_folder


def default_folder(name: str) -> Path:
    """Returns the folder of the logs of an object's touches."""
    return Path("data/touches") / name


def _plan(touches: int, peak_n: float | None) -> RecordingPlan:
    return RecordingPlan(touches, touches=1, peak_n=peak_n, test_every=None)


def fit_and_write(prepared: Prepared, paths: Sequence[Path], progress: Progress) -> ObjectCalibration:
    """Makes the profile and the figure from the logs of the touches, as `calibrate_object`."""
    model, out = prepared.model, prepared.out
    run = partial(features, prepared.engine)
    recordings = {}
    for path in sorted(paths, key=started_ns):  # the order shows after which touch the object stayed narrower
        recordings[path] = read_log(path, model.header.preprocess, run)
        progress(path.name)
    with_reference = {path: one for path, one in recordings.items() if not one.starts_in_contact}
    if not with_reference:
        raise DataError(
            f"all {len(recordings)} logs start in contact, so their first frames are no reference; touch the object "
            "from open jaws"
        )
    with_contact = {path: one for path, one in with_reference.items() if one.has_contact}
    recording = join(with_contact or with_reference)  # without any contact, the fit reports the largest force
    touches = recording.touches
    fit = fit_correction(touches, COVERAGE, prepared.engine.header.ood)  # bfloat16 has no score to limit
    progress("fitted the correction")
    curve = list(learning_curve(touches, COVERAGE))
    progress("computed the learning curve")
    digests = [sha256_of(path) for path in with_contact or with_reference]
    profile, crushed_at_n = make_profile(
        prepared.name, recording, fit, ResolvedConfig(prepared.config, model), digests, prepared.engine
    )
    write_object(out, profile, pack(fit.arrays))
    report = out.with_suffix(".png")
    draw(profile, fit, touches, curve, report)
    stiffness = stiffness_n_m(recording.width_m, [press.force_n for press in recording.presses])
    return ObjectCalibration(
        profile=profile,
        profile_path=out,
        report_path=report,
        correction=fit.candidate,
        candidates_mae_n=fit.errors_n,
        coverages=fit.coverages,
        crushed_at_n=crushed_at_n,
        stiffness_std_n_m=float(stiffness.std(ddof=1)) if len(stiffness) > 1 else None,
        touches_needed=_mean_curve(curve),
        without_contact=tuple(path for path in with_reference if path not in with_contact),
        contact_starts=tuple(path for path in recordings if path not in with_reference),
    )


def sha256_of(path: Path) -> str:
    """Returns the SHA-256 of a file."""
    return sha256(path.read_bytes()).hexdigest()


def make_profile(
    name: str,
    recording: TouchRecording,
    fit: ObjectFit,
    resolved: ResolvedConfig,
    logs: Sequence[str],
    engine: Engine | None = None,
) -> tuple[ObjectProfile, float | None]:
    """Makes an object profile of a fit.

    Args:
        name: Name of the object.
        recording: The touches that it was fitted to.
        fit: The fit.
        resolved: Configuration, and the network.
        logs: SHA-256 of each log of the touches.
        engine: The network's engine, if it is open.

    Returns:
        The profile, and the largest force of the touch after which the object stayed narrower, or None.
    """
    assert resolved.model is not None
    touches = recording.touches
    forces_n = [press.force_n for press in recording.presses]
    stiffness = stiffness_n_m(recording.width_m, forces_n)
    peaks_n = np.array([force_n.max() for force_n in forces_n])
    crushed = crushing_touch(np.array([width_m[0] for width_m in recording.width_m]), peaks_n)
    size = resolved.model.header.preprocess.size
    frame = np.random.default_rng(0).integers(60, 180, (size, size), np.uint8)
    timed = replace(
        resolved, config=resolved.config.with_values(vision={"region": None})
    )  # the frame is cropped
    compute_ms = estimate_ms(timed, frame, engine)
    profile = ObjectProfile(
        object=name,
        date=datetime.now(UTC).date(),
        checkpoint=resolved.model.digest,
        camera=recording.camera,
        touches=len(touches.numbers),
        frames=len(touches.touch),
        force_n=float(touches.force_n.max() if crushed is None else peaks_n[:crushed].max()),
        output=fit.output,
        interval=fit.interval,
        ood_limits=None if fit.arrays.known is None else fit.arrays.known.limits,
        stiffness_n_m=float(np.median(stiffness)) if len(stiffness) else None,
        plant=fit_plant(recording.presses, recording.delay_s + compute_ms / 1e3),
        before_n=fit.before_n,
        after_n=fit.after_n,
        weights=sha256(pack(fit.arrays)).hexdigest(),
        logs=tuple(logs),
        version=__version__,
    )
    return profile, None if crushed is None else float(peaks_n[crushed])


def _mean_curve(curve: Sequence[LearningCurvePoint]) -> tuple[LearningCurvePoint, ...]:
    """Mean over the draws of each number of touches."""
    rows = []
    for count in sorted({point.touches for point in curve}):
        _, mae_n, covered = np.array([point for point in curve if point.touches == count]).T
        rows.append(LearningCurvePoint(count, float(mae_n.mean()), float(covered.mean())))
    return tuple(rows)
