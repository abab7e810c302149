"""Force from a real finger camera, on objects or days that are not in the training data.

Imports a folder of recordings (`<date>_<object>_<trial>/video.avi` with `load_cell.csv`), leaves out each object (or
day) in turn, fits the Gaussian process of `gripper-force train --recipe few` to the others, and tests it on what was
left out. Every setting is chosen by leaving out objects once more, among the training recordings only (nested
cross-validation). Beside it: a ridge regression with fixed settings, and with `--minutes` a network.

Each object is then tested again after one trial, for each of its trials in turn, on its other trials: *calibrated*
corrects the process as `calibrate object` does, *taught* adds the trial to the training data.

Recordings that start in contact are left out, as in `train` and `evaluate`: their reference frame is wrong.

    python scripts/real_grasps.py FOLDER                              # each object left out
    python scripts/real_grasps.py FOLDER --by day                     # each day left out
    python scripts/real_grasps.py FOLDER --test OTHERS --minutes 5    # other recordings, looked at once

Each result is written to OUT/results.json at once; the same command continues after an interruption.
"""

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt
import torch
from rich.console import Console
from rich.progress import track

from gripper_calibration.fits.object_fit import fit_correction
from gripper_calibration.fits.touches import Touches
from gripper_force.errors import DataError
from gripper_force.jobs.dataset import Clip, load_clips, without_contact_starts
from gripper_force.jobs.estimates import estimate_clips
from gripper_force.jobs.evaluate import errors_on
from gripper_force.jobs.training import few
from gripper_force.jobs.training.recipe import TrainConfig, recipe
from gripper_force.jobs.training.train import train
from gripper_force.qualification.bench.teach_bench import digest_of_recordings, import_missing
from gripper_force.vision.batch_inference import features
from gripper_force.vision.gaussian_process import GaussianProcess

Floats = npt.NDArray[np.floating]

RIDGE_SIZE_PX: Final = 32
RIDGE_COMPONENTS: Final = 20
RIDGE_PENALTY: Final = 0.2
"""Penalty per frame; values from 0.02 to 0.2 transfer best between objects."""

PREPROCESS = recipe("few").preprocess

NETWORK: dict[str, Any] = {
    "preprocess": PREPROCESS,
    "attentions": ["ssam"],
    "backbone": "resnet18",
    "width": 0.5,
    "clips": 20,
    "clip_frames": 26,
    "short_share": 0.0,
    "shift_px": 0,
    "light": 0.0,
    "noise": 0.0,
}
"""The network that did best on the 48 recordings of nine objects in several runs: it was chosen on them."""


def run(training: list[Clip], test: list[Clip], minutes: float | None, out: Path) -> dict[str, Any]:
    """Returns the errors of each method on the test recordings, by object."""
    fit = few.fit(training, PREPROCESS)
    forces_n = {"Gaussian process": [_force_n(fit.model, clip) for clip in test]}
    if minutes is not None:
        config = TrainConfig(**NETWORK, minutes=minutes)
        network = train(config, training, out / "network.safetensors")
        forces_n["network"] = [members_n.mean(0) for members_n in estimate_clips(network, test)]
        pairs = zip(forces_n["Gaussian process"], forces_n["network"], strict=True)
        forces_n["mean of both"] = [(a + b) / 2 for a, b in pairs]
    rows = {name: _errors(test, parts) for name, parts in forces_n.items()}
    rows["ridge regression"] = _errors(test, _ridge_n(training, test), lead_in=0)
    for name, correct in (
        ("process, calibrated on one trial", _calibrated),
        ("process, taught one trial", _taught),
    ):
        rows[name] = {}
        for chosen in sorted({clip.object for clip in test}):
            found = _after_one_trial([c for c in test if c.object == chosen], training, fit, correct)
            if found is not None:
                rows[name][chosen] = found
    return {"setting": fit.setting._asdict(), "errors": rows}


Correct = Callable[[few.Fit, list[Clip], Clip], GaussianProcess | Callable[[Clip], Floats]]


def _after_one_trial(
    clips: list[Clip], training: list[Clip], fit: few.Fit, correct: Correct
) -> list[float] | None:
    """Returns the errors on an object's other trials, over all choices of the first; None if it has only one."""
    others, forces_n = [], []
    for one in clips if len(clips) > 1 else []:
        corrected = correct(fit, training, one)
        for other in clips:
            if other is not one:
                others.append(other)
                forces_n.append(
                    _force_n(corrected, other) if isinstance(corrected, GaussianProcess) else corrected(other)
                )
    return _errors(others, forces_n)[clips[0].object] if others else None


def _taught(fit: few.Fit, training: list[Clip], one: Clip) -> GaussianProcess:
    return few.fitted([*training, one], PREPROCESS, fit.setting)


def _calibrated(fit: few.Fit, _: list[Clip], one: Clip) -> Callable[[Clip], Floats]:
    try:
        correction = fit_correction(_touches(fit.model, one))
    except DataError:  # unusable for calibration: the process stays uncorrected
        return lambda clip: _force_n(fit.model, clip)

    def predict(clip: Clip) -> Floats:
        every = Clip(clip.frames, clip.forces_n, np.ones_like(clip.valid), clip.name, clip.object, clip.set)
        corrected: Floats = correction.predict(_touches(fit.model, every, lead_in=0))
        return corrected

    return predict


def _touches(process: GaussianProcess, clip: Clip, lead_in: int = PREPROCESS.lead_in) -> Touches:
    forces_n, read_out = features([process], PREPROCESS, clip.frames)
    used = clip.labelled(lead_in)
    measured_n = clip.forces_n[used].astype(np.float64)
    return Touches(
        read_out[used], forces_n[0][used].astype(np.float64), measured_n, np.zeros(used.sum(), int)
    )


def _force_n(process: GaussianProcess, clip: Clip) -> Floats:
    force_n: Floats = features([process], PREPROCESS, clip.frames)[0][0]
    return force_n


def _errors(
    clips: list[Clip], forces_n: list[Floats], lead_in: int = PREPROCESS.lead_in
) -> dict[str, list[float]]:
    per_object = errors_on(clips, forces_n, lead_in).per_object
    return {name: [errors.mae_n, errors.contact_mae_n] for name, errors in per_object.items()}


def _ridge_n(training: list[Clip], test: list[Clip]) -> list[Floats]:
    """Estimates the force by ridge regression on products of 20 principal components.

    The components are of 32x32 frames minus each recording's first frame.

    Returns:
        Forces in N of each test recording, (T,).
    """
    labels_n = np.concatenate([clip.forces_n for clip in training])
    valid = np.concatenate([clip.valid for clip in training])
    images = np.concatenate([_first_frame_difference(clip) for clip in training])[valid]
    centre = images.mean(0)
    _, axes = np.linalg.eigh((images - centre).T @ (images - centre))
    axes = axes[:, -RIDGE_COMPONENTS:]  # (pixels, components)
    scale = ((images - centre) @ axes).std(0) + 1e-6

    def products(pixels: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
        scores = ((pixels - centre) @ axes / scale).astype(np.float64)  # (N, components)
        first, second = np.triu_indices(scores.shape[1])
        return np.column_stack([scores, scores[:, first] * scores[:, second]])

    x, y = products(images), labels_n[valid].astype(np.float64)
    x_mean, y_mean = x.mean(0), y.mean()
    covariance = (x - x_mean).T @ (x - x_mean) / len(x)
    weights = np.linalg.solve(
        covariance + RIDGE_PENALTY * np.eye(x.shape[1]), (x - x_mean).T @ (y - y_mean) / len(x)
    )
    return [(products(_first_frame_difference(clip)) - x_mean) @ weights + y_mean for clip in test]


def _first_frame_difference(clip: Clip) -> npt.NDArray[np.float32]:
    """Returns frames minus the first one, (T, 32 * 32), as fractions of full scale."""
    size = (RIDGE_SIZE_PX, RIDGE_SIZE_PX)
    small = [cv2.resize(frame, size, interpolation=cv2.INTER_AREA) for frame in clip.frames]
    pixels = np.asarray(small, np.float32).reshape(len(small), -1) / 255
    difference: npt.NDArray[np.float32] = pixels - pixels[0]
    return difference


def positive_minutes(text: str) -> float:
    """Parses the training time. Its name is part of the message for a text that is no number."""
    minutes = float(text)
    if not 0 < minutes < float("inf"):
        raise argparse.ArgumentTypeError(f"the time must be above 0, got {text}")
    return minutes


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("recordings", type=Path)
    parser.add_argument("--by", choices=("object", "day"), default="object")
    parser.add_argument("--test", type=Path, help="recordings to test on, instead of leaving some out")
    parser.add_argument(
        "--minutes", type=positive_minutes, help="also train a network, for each part that is left out"
    )
    parser.add_argument("--jobs", type=int, default=2, help="processes that read the logs")
    parser.add_argument("--out", type=Path, default=Path("data/real"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    clips = _read(options.recordings, options.out, options.jobs)
    if options.test:
        test = _read(options.test, options.out, options.jobs)
        seen = {clip.object for clip in clips}
        parts = {"all others": (clips, [clip for clip in test if clip.object not in seen])}
    else:
        names = [clip.object if options.by == "object" else clip.name[:10] for clip in clips]
        parts = {
            name: (
                [clip for clip, other in zip(clips, names, strict=True) if other != name],
                [clip for clip, other in zip(clips, names, strict=True) if other == name],
            )
            for name in sorted(set(names))
        }
    path = options.out / "results.json"
    results = json.loads(path.read_text()) if path.exists() else {}
    done = {}
    for name, (training, test) in track(parts.items(), "left out", console=Console(stderr=True)):
        # With other recordings, such as one more, the result is another one.
        used = f"{digest_of_recordings(training)}, {digest_of_recordings(test)}"
        key = f"{name}, network {options.minutes}, {used}"
        if key not in results:
            results[key] = run(training, test, options.minutes, options.out)
            path.write_text(json.dumps(results, indent=1))
        done[name] = results[key]
        print(f"{name}: settings {done[name]['setting']}")
    methods = list(next(iter(done.values()))["errors"])
    # Each column is an object, or an object on one day.
    columns = [(part, name) for part in done for name in done[part]["errors"][methods[0]]]
    print(
        f"\n| MAE N / in contact | mean | s.d. | {' | '.join(' '.join(dict.fromkeys(c)) for c in columns)} |"
    )
    print("|---" * (3 + len(columns)) + "|")
    for method in methods:
        found = [done[part]["errors"][method].get(name, [np.nan] * 2) for part, name in columns]
        pairs = [np.nanmean(found, 0), np.nanstd(found, 0, ddof=1), *found]
        print(f"| {method} | {' | '.join(f'{a:.2f} / {b:.2f}' for a, b in pairs)} |")


def _read(folder: Path, out: Path, workers: int) -> list[Clip]:
    clips = load_clips(import_missing(folder, out), PREPROCESS, workers=workers)
    used = without_contact_starts(clips, PREPROCESS)
    print(f"{folder}: {len(used)} of {len(clips)} recordings are used; the others start in contact")
    return used


if __name__ == "__main__":
    main()
