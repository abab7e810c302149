"""An object's profile from touches: with the load cell in place once, and without it from then on."""

import time
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from hashlib import sha256
from pathlib import Path
from typing import Any, Final

import numpy as np

from gripper_calibration import touch_logs
from gripper_calibration.fits.object_fit import COVERAGE, fit_correction, learning_curve
from gripper_calibration.fits.plant_fit import crushed_by, fit_plant, stiffness_n_m
from gripper_calibration.plots.object_plot import draw
from gripper_force.config import Config
from gripper_force.errors import DataError
from gripper_force.jobs.recording.record import Progress, RecordingPlan, record
from gripper_force.profiles.correction import pack
from gripper_force.profiles.object_profile import ObjectProfile, check_place, write_object
from gripper_force.runtime.assembly import settled
from gripper_force.types import NS_PER_MS
from gripper_force.vision.checkpoint import Checkpoint, load_checkpoint
from gripper_force.vision.estimator import open_estimator
from gripper_force.vision.model_files import read_model

Advance = Callable[[str], None]
"""Told of each log that was read, and of each step of the fit."""

_TIMED: Final = 30


def touch(
    config: Config,
    touches: int,
    peak_n: float | None,
    folder: Path,
    *,
    ask: Callable[[int], None] = lambda _: None,
    progress: Progress = lambda _set, _touch, _force_n: None,
) -> Iterator[Path]:
    """Touches the object with random peaks, a log each; those that are there already are not done again.

    A simulated object stays the same one on the same rig, and is put down anew each time.

    Args:
        config: The run; its object is the one that lies there.
        touches: How many there are to be in all.
        peak_n: The most to press with; None for what the force limit leaves, but no more than 12 N.
        folder: Where the logs are.
        ask: Told of the number of a touch before it is done; returns once it may be.
        progress: Told of the touch and the force, a few times a second.

    Raises:
        GripperError: As `gripper_force.jobs.recording.record.record` does. Touches that are done stay.
    """
    sim = config.sim
    same = {
        name: config.seed if getattr(sim, name) is None else getattr(sim, name)
        for name in ("object_seed", "rig_seed")
    }
    config = config.model_copy(update={"sim": sim.model_copy(update=same)})
    yield from record(config, RecordingPlan(touches, 1, peak_n, test_every=None), folder, progress, ask)


def calibrate(
    config: Config, name: str, paths: Sequence[Path], out: Path, advance: Advance
) -> dict[str, Any]:
    """Makes an object's profile from logs, with a picture beside it.

    Args:
        config: Names the network, and its threads.
        name: What the object is to be called.
        paths: Logs of touches.
        out: The profile to write, ``*.yaml``.
        advance: Told of what was done.

    Returns:
        The profile, the errors of all candidates, how many touches are enough, and the paths.

    Raises:
        DataError: The logs can't be used, or nothing can be learnt from them.
        ConfigError: The profile can't be written.
    """
    check_place(out)
    config, _ = settled(config)
    checkpoint = load_checkpoint(config.vision.checkpoint)
    if not paths:
        raise DataError(f"there is no log of {name!r} to calibrate from; touch it first")
    parts = {}
    for path in paths:
        parts[path] = touch_logs.read_one(path, checkpoint)
        advance(path.name)
    felt = {path: part for path, part in parts.items() if part.has_contact}
    recorded = touch_logs.join(felt or parts)  # without any, the fit says what was felt
    touches = recorded.touches
    fitted = fit_correction(touches, COVERAGE)
    advance("fitted")
    curve = list(learning_curve(touches, COVERAGE))
    advance("how many touches are enough")
    forces_n = [press.force_n for press in recorded.presses]
    stiffness = stiffness_n_m(recorded.width_m, forces_n)
    peaks_n = np.array([force_n.max() for force_n in forces_n])
    crushed = crushed_by(np.array([width_m[0] for width_m in recorded.width_m]), peaks_n)
    weights = pack(fitted.arrays)
    bore_n = float(touches.force_n.max() if crushed is None else peaks_n[:crushed].max())
    profile = ObjectProfile(
        object=name,
        date=datetime.now(UTC).date(),
        checkpoint=checkpoint.digest,
        camera=recorded.camera,
        touches=len(touches.numbers),
        frames=len(touches.touch),
        force_n=bore_n,
        output=fitted.output,
        interval=fitted.interval,
        ood_limit=fitted.ood_limit,
        stiffness_n_m=float(np.median(stiffness)) if len(stiffness) else None,
        plant=fit_plant(recorded.presses, recorded.delay_s + _compute_s(config, checkpoint)),
        before_n=fitted.before_n,
        after_n=fitted.after_n,
        weights=sha256(weights).hexdigest(),
    )
    write_object(out, profile, weights)
    picture = out.with_suffix(".png")
    draw(profile, fitted, touches, curve, picture)
    return {
        **profile.model_dump(mode="json"),
        "correction": fitted.candidate,
        "candidates_mae_n": fitted.errors_n,
        "crushed_at_n": None if crushed is None else float(peaks_n[crushed]),
        "stiffness_std_n_m": float(stiffness.std(ddof=1)) if len(stiffness) > 1 else None,
        "touches_needed": _table(curve),
        "without_contact": [path for path in parts if path not in felt],
        "profile": out,
        "report": picture,
    }


def _compute_s(config: Config, checkpoint: Checkpoint) -> float:
    """How long an estimate takes: on the simulated clock what is set, else measured."""
    if config.clock == "lockstep":
        return config.vision.lockstep_compute_ms * NS_PER_MS / 1e9
    estimator = open_estimator(read_model(config.vision.checkpoint), config.vision)
    size = checkpoint.header.preprocess.size
    rng = np.random.default_rng(0)
    taken_s = []
    for frame in rng.integers(60, 180, (_TIMED, size, size), np.uint8):
        begin_s = time.perf_counter()
        estimator.update(frame)
        taken_s.append(time.perf_counter() - begin_s)
    return float(np.median(taken_s))


def _table(curve: list[tuple[int, float, float]]) -> list[dict[str, Any]]:
    rows = []
    for count in sorted({count for count, _, _ in curve}):
        draws = [(mae_n, share) for number, mae_n, share in curve if number == count]
        mae_n, covered = np.array(draws).T
        rows.append({"touches": count, "mae_n": float(mae_n.mean()), "covered": float(covered.mean())})
    return rows
