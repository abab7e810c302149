"""Teaching of an object: the estimator that is best on touches left out, calibrated, in one bundle.

The best of the `teach_candidates` is trained on all touches, and calibrated.
"""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Final

import numpy as np
import torch  # noqa: F401  # first: the extra that has it has SciPy, too, so one message is enough

from gripper_calibration.fits.cross_validation import Coverage, coverages
from gripper_calibration.fits.interval_fit import touch_interval
from gripper_calibration.fits.object_fit import COVERAGE, ObjectFit, fit_correction
from gripper_calibration.fits.object_ood_fit import left_out_shares, object_limits, object_subspace
from gripper_calibration.fits.touches import Touches
from gripper_calibration.plots.taught_plot import draw
from gripper_calibration.procedures.calibrate_object import (
    default_folder,
    make_profile,
    record_touches,
    sha256_of,
)
from gripper_calibration.procedures.teach_candidates import (
    FOLDS,
    Candidate,
    CandidateWork,
    Comparison,
    LeftOut,
    compare,
    make_candidates,
)
from gripper_calibration.touch_logs import join, read_log, started_ns
from gripper_force.config import Config, config_from_text
from gripper_force.errors import ConfigError, DataError
from gripper_force.jobs.dataset import CONTACT_N, StreamedClip, find_logs, load_clips, starts_in_contact
from gripper_force.jobs.profile_files import check_writable, pack, write_object
from gripper_force.jobs.recording.record import check_name
from gripper_force.jobs.training.ood_fit import model_of_scores
from gripper_force.jobs.training.stated_errors import errors, residuals
from gripper_force.profiles.correction import KnownFrames, ProfileArrays
from gripper_force.profiles.object_profile import BUNDLED, ObjectProfile, read_object, user_folder
from gripper_force.progress import Progress, Prompt, no_progress
from gripper_force.runtime.log_reader import LogReader
from gripper_force.runtime.resolve import ResolvedConfig, resolve_vision
from gripper_force.types import Frame, LoadCellSample
from gripper_force.vision.batch_inference import features
from gripper_force.vision.checkpoint import load_checkpoint
from gripper_force.vision.checkpoint_writer import replace_header
from gripper_force.vision.estimator import claimed_std_n
from gripper_force.vision.header import Header, Model
from gripper_force.vision.model_files import read_model
from gripper_force.vision.preprocess import Preprocess

TOUCHES: Final = 16
"""Default number of touches."""

STEPS: Final = 3 * 2 * FOLDS + 3
"""Steps of progress that `teach` reports after the touches: three candidates, without one fold and without two."""

_HELPS: Final = 0.85
"""More touches help if the error after two of three folds is less than this share of that after one."""

_FRAMES_AFTER: Final = 10
"""Frames after the reference frames until whose time the load cell's samples of these are in a log."""

_NETWORK: Final = "network.safetensors"
_FIGURE: Final = "teach.png"


@dataclass(frozen=True, slots=True)
class Taught:
    """Result of `teach`.

    Attributes:
        bundle: Folder with network, profile and figure. A grasp of the object uses it.
        profile: The profile in it.
        learned: Name of the selected candidate, one of the keys of `candidates_mae_n`.
        candidates_mae_n: MAE of each candidate on touches left out, after it has learned from the other two thirds.
        before_n: MAE of the configured network without calibration.
        mae_n: Expected MAE, on touches that took no part in the selection of the candidate either.
        contact_mae_n: The same, of the frames in contact.
        fewer_mae_n: MAE of the selected candidate after it has learned from one third of the touches.
        more_touches_help: True if the error still falls clearly with the number of touches.
        coverages: Share of the frames of each touch within an interval that the other folds gave: in contact, and by
            force level.
        without_contact: Logs that were not used because they show no contact.
        contact_starts: Logs that were not used because they start in contact.
    """

    bundle: Path
    profile: ObjectProfile
    learned: str
    candidates_mae_n: dict[str, float]
    before_n: float
    mae_n: float
    contact_mae_n: float
    fewer_mae_n: float
    more_touches_help: bool
    coverages: tuple[Coverage, ...]
    without_contact: tuple[Path, ...]
    contact_starts: tuple[Path, ...]

    @property
    def figure(self) -> Path:
        """The figure, PNG."""
        return self.bundle / _FIGURE


def teach(
    config: Config,
    name: str,
    *,
    logs: Sequence[str | Path] | None = None,
    touches: int = TOUCHES,
    peak_n: float | None = None,
    folder: str | Path | None = None,
    out: str | Path | None = None,
    replay: Sequence[str | Path] = (),
    workers: int = 1,
    prompt: Prompt | None = None,
    progress: Progress = no_progress,
) -> Taught:
    """Teaches an object: touches it, takes the best estimator for it, and writes a bundle that grasps of it use.

    Each part of the work is kept in ``folder``. After an interruption, the same arguments continue it. With more
    ``touches`` the old ones are used too.

    Args:
        config: The configuration: the devices, and the network to begin with. Its ``object`` is replaced by ``name``.
        name: Name of the object. In simulation it must be one of the simulated objects.
        logs: Logs of touches, or folders to search for ``*.mcap``. The devices are then not used.
        touches: Number of touches, including those already in ``folder``. Not used with ``logs``.
        peak_n: Largest force of a touch in N; None for what the force limit permits, up to 12 N.
        folder: Folder of the touches' logs and of the parts of the work; None for ``data/touches/NAME``.
        out: Folder of the bundle; None for ``NAME`` in the user's folder of profiles.
        replay: Logs of an earlier training, or folders of them. They are mixed in, so that their objects are not
            forgotten.
        workers: Processes; 1: everything runs in this one.
        prompt: Called before each touch, so that a person can place the object again; None for no pause.
        progress: Called once for each touch, and then with `STEPS` steps.

    Returns:
        The bundle, the selected candidate, and the expected error.

    Raises:
        ConfigError: There is no camera, load cell or network, the peak is not within the force limit, or the bundle
            can't be written.
        DataError: The load cell reads a force at rest, a touch failed, or there are fewer than four logs with
            contact.
        LogError: A log can't be read.
        CheckpointError: The network can't be read.
        DeviceError: A device failed. The servo was stopped as configured, and completed touches are kept.

    Example:
        ::

            config = gripper_force.load_config("my.yaml")
            result = gripper_force.teach(config, "mug", touches=16)
            print(result.bundle, result.mae_n, result.more_touches_help)
    """
    out = (user_folder() / name if out is None else Path(out)).absolute()
    work_folder = default_folder(name) if folder is None else Path(folder)
    config, model = check_before_touches(config, name, out)
    if logs is None:
        named = config.with_values(object=name)
        paths = []
        for path in record_touches(named, touches, peak_n, work_folder, prompt=prompt, progress=progress):
            paths.append(path)
            progress(f"touch {len(paths)} of {touches}")
    else:
        paths = find_logs(logs)
    logs_in_contact, without_contact, contact_starts = _sorted_by_contact(paths, model)
    # The same touch in two folds would be both learned and left out.
    logs_by_digest = {sha256_of(path): path for path in logs_in_contact}
    # A touch that is replayed would be learned where it is left out.
    replay_logs = {} if not replay else {sha256_of(path): path for path in find_logs(replay)}
    other_logs = {digest: path for digest, path in replay_logs.items() if digest not in logs_by_digest}
    in_contact = [path for path in other_logs.values() if _starts_in_contact(path, model.header.preprocess)]
    other_logs = {digest: path for digest, path in other_logs.items() if path not in in_contact}
    work = CandidateWork(logs_by_digest, other_logs, work_folder / "teach", workers)
    taught = _make_bundle(work, config, model, name, out, progress)
    return replace(taught, without_contact=without_contact, contact_starts=(*contact_starts, *in_contact))


def check_before_touches(config: Config, name: str, out: Path) -> tuple[Config, Model]:
    """Checks what `teach` needs before the first touch.

    Args:
        config: The configuration.
        name: Name of the object.
        out: Folder of the bundle.

    Returns:
        The configuration with the choice of the network made, and the network to begin with.

    Raises:
        ConfigError: There is no network, the name can't be part of a file name, the bundle can't be written, or it is
            that of another object.
        CheckpointError: The network can't be read.
    """
    check_name(name)
    out = out.absolute()  # `.` has a name then
    if out.exists() and not (out / BUNDLED).is_file():
        raise ConfigError(f"{out} exists and is not a bundle; name another folder")
    file = _object_file(config)
    if file is not None and out.exists() and (other_file := _file_of(out)) not in (None, file):
        raise ConfigError(
            f"the bundle {out} is that of the object in {other_file}, not of {file}; rename one of the files, or name "
            "another folder with --out"
        )
    check_writable(out.with_name(f"{out.name}.yaml"))
    config, model, _ = resolve_vision(config)
    if model is None:
        raise ConfigError("teach needs a network to begin with; set vision.checkpoint, such as to default")
    return config, model


def _file_of(bundle: Path) -> str | None:
    """Returns the path of the simulated object's file that a bundle is of; None for an object known by name."""
    try:
        return read_object(bundle / BUNDLED).file
    except ConfigError as error:
        raise ConfigError(
            f"the bundle {bundle} can't be read, so it may be that of another object; move it away, or name another "
            f"folder with --out ({error})"
        ) from error


def _object_file(config: Config) -> str | None:
    """Returns the path of a simulated object's file; None for an object known by name."""
    return None if config.sim.object is None else str(config.sim.object.resolve())


def _make_bundle(
    work: CandidateWork, config: Config, model: Model, name: str, out: Path, progress: Progress
) -> Taught:
    """Takes the best candidate, makes it of all logs, calibrates it, and writes the bundle."""
    candidates = make_candidates(config, model, len(work.logs))
    comparison = compare(work.left_out(candidates, progress), len(work.logs))
    progress("compared the candidates", STEPS - 3 - 2 * FOLDS * len(candidates))
    candidate = candidates[comparison.best]
    checkpoint = work.learned(candidate)
    progress(f"trained on all touches: {candidate.name}")
    learned = load_checkpoint(checkpoint)
    preprocess = learned.header.preprocess
    run = partial(features, learned.networks, preprocess)
    recording = join({path: read_log(path, preprocess, run) for path in sorted(work.logs, key=started_ns)})
    fit = _fit(recording.touches, comparison)
    config = config.with_values(vision={"checkpoint": str(checkpoint)})
    resolved = ResolvedConfig(config, read_model(checkpoint))
    profile, _ = make_profile(name, recording, fit, resolved, work.digests)
    origin = {"network": _NETWORK, "file": _object_file(config)}
    progress("calibrated")
    error_n = comparison.absolute_error_n
    taught = Taught(
        bundle=out,
        profile=profile.model_copy(update=origin),
        learned=candidate.name,
        candidates_mae_n={c.name: float(e) for c, e in zip(candidates, comparison.error_n, strict=True)},
        before_n=fit.before_n,
        mae_n=float(error_n.mean()),
        contact_mae_n=float(error_n[comparison.measured.force_n > CONTACT_N].mean()),
        fewer_mae_n=float(comparison.fewer_n[comparison.best]),
        more_touches_help=bool(
            comparison.error_n[comparison.best] < _HELPS * comparison.fewer_n[comparison.best]
        ),
        coverages=coverages(comparison.measured, comparison.within),
        without_contact=(),
        contact_starts=(),
    )
    assert fit.arrays.known is not None
    header = _header_with_errors(learned.header, candidate, fit.arrays.known, comparison.left)
    _write_bundle(taught, checkpoint, header, fit.arrays, comparison)
    progress("wrote the bundle")
    return taught


def _fit(touches: Touches, comparison: Comparison) -> ObjectFit:
    """Fits the correction to all touches; its errors, interval and limits are those of touches left out."""
    # The folds' networks have not seen the touches they score, but each network has its own scale of scores.
    shares, estimates_n = left_out_shares(touches)
    limits = object_limits(
        [one.share for one in comparison.left] + shares,
        [one.raw_n for one in comparison.left] + estimates_n,
        touches=len(shares),
    )
    fit = fit_correction(touches, COVERAGE)
    return replace(
        fit,
        arrays=replace(fit.arrays, known=KnownFrames(*object_subspace(touches), limits)),
        interval=touch_interval(comparison.estimate_n, *comparison.measured, COVERAGE),
        before_n=float(np.abs(comparison.before_n - comparison.measured.force_n).mean()),
        after_n=float(comparison.absolute_error_n.mean()),
    )


def _sorted_by_contact(
    paths: Sequence[Path], model: Model
) -> tuple[list[Path], tuple[Path, ...], tuple[Path, ...]]:
    """Returns the logs that can be used, those without contact, and those that start in contact."""
    logs_in_contact, without_contact, contact_starts = [], [], []
    for path in paths:
        clips = load_clips([path], model.header.preprocess)
        if starts_in_contact(clips[0].forces_n, model.header.preprocess):
            contact_starts.append(path)
        elif any((clip.forces_n > CONTACT_N).any() for clip in clips):
            logs_in_contact.append(path)
        else:
            without_contact.append(path)
    return logs_in_contact, tuple(without_contact), tuple(contact_starts)


def _starts_in_contact(path: Path, preprocess: Preprocess) -> bool:
    """Returns `starts_in_contact` of a log, of which only the first frames are read: a training reads all of it."""
    reader = LogReader(path)
    config = config_from_text(reader.config, str(path))
    stream = StreamedClip(reader, config, reader.records(Frame, LoadCellSample), preprocess)
    for _ in islice(stream.frames(), preprocess.reference_frames + _FRAMES_AFTER):
        pass
    try:
        clip = stream.clip(stream.no_images)
        is_whole = bool(clip.valid[: preprocess.reference_frames].all())
    except DataError:
        is_whole = False
    if not is_whole:  # the labels may come later in the log, or never
        clip = load_clips([path], preprocess)[0]
    return starts_in_contact(clip.forces_n, preprocess)


def _header_with_errors(
    header: Header, candidate: Candidate, known_frames: KnownFrames, left_out: Sequence[LeftOut]
) -> Header:
    """Returns a header with the errors, and the out-of-distribution score, that logs left out show."""
    raw_n, force_n = (np.concatenate([getattr(one, key) for one in left_out]) for key in ("raw_n", "force_n"))
    if candidate.recipe:
        values = {"residuals": residuals(raw_n, force_n), "metrics": errors(raw_n, force_n), "ood": None}
        header = header.model_copy(update=values)
    if header.ood is None:
        z = (raw_n - force_n) / claimed_std_n(header, raw_n[None])
        scores = [one.share for one in left_out], [one.raw_n for one in left_out]
        ood = model_of_scores(known_frames, *scores, z, force_n > CONTACT_N)
        header = header.model_copy(update={"ood": ood})
    return header


def _write_bundle(
    taught: Taught, checkpoint: Path, header: Header, arrays: ProfileArrays, comparison: Comparison
) -> None:
    """Writes the folder of a bundle. An earlier one is replaced once the new one is complete."""
    out = taught.bundle
    part, old = out.with_name(f".{out.name}.part"), out.with_name(f".{out.name}.old")
    try:
        if old.exists() and not out.exists():  # an earlier replacement was interrupted
            old.rename(out)
        for folder in (part, old):
            shutil.rmtree(folder, ignore_errors=True)
        part.mkdir(parents=True)
        replace_header(checkpoint, header, part / _NETWORK)
        write_object(part / BUNDLED, taught.profile, pack(arrays))
        draw(
            taught.profile,
            comparison.measured.force_n,
            comparison.before_n,
            comparison.estimate_n,
            taught.coverages,
            {
                name: errors_n
                for name, *errors_n in zip(
                    taught.candidates_mae_n, comparison.fewer_n, comparison.error_n, strict=True
                )
            },
            taught.learned,
            part / _FIGURE,
        )
        try:
            if out.exists():
                out.rename(old)
            part.rename(out)
        except BaseException:
            if old.exists() and not out.exists():
                old.rename(out)
            raise
        shutil.rmtree(old, ignore_errors=True)
    except OSError as error:
        raise ConfigError(f"can't write the bundle {out}: {error.strerror}; name another folder") from error
