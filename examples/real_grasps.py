"""Force from a real finger camera, on objects that are not in the training data.

Imports a folder of recordings (`<date>_<object>_<trial>/video.avi` with `load_cell.csv`), splits the objects
into folds, trains on all folds but one and evaluates on that one, and compares with a ridge regression. Each
held-out object is then calibrated on one of its trials and tested on its other trials, for each trial in
turn: on all of them, and on those of the same day only, because the finger had another pad on some days.

All recordings are used, also those that start in contact, so that their reference frame is wrong: of the 48 real
ones six of foam_brick and three of green_ball_softer. `gripper-force train` and `evaluate` leave such logs out.

    python examples/real_grasps.py FOLDER [--folds 5] [--minutes 5]             # the default variant
    python examples/real_grasps.py FOLDER [--folds 5] [--minutes 5] --ladder    # all variants
    python examples/real_grasps.py FOLDER --as-recorded                         # keep the lag of the forces

Each result is written to OUT/results.json at once; the same command continues after an interruption.
"""

import argparse
import json
import multiprocessing
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from rich.console import Console
from rich.progress import track

from gripper_calibration.fits.object_fit import fit_correction
from gripper_calibration.fits.touches import Touches
from gripper_force.errors import DataError
from gripper_force.jobs.dataset import CONTACT_N, Clip, load_clips, starts_in_contact
from gripper_force.jobs.evaluate import Evaluation, compare, estimates, ridge_baseline
from gripper_force.jobs.imports.video import import_folder
from gripper_force.jobs.training.recipe import TrainConfig
from gripper_force.jobs.training.train import train
from gripper_force.vision.batch_inference import features, normalise
from gripper_force.vision.checkpoint import Checkpoint
from gripper_force.vision.preprocess import Preprocess

BASE: dict[str, Any] = {
    "preprocess": {"size": 64, "magnitude": True},
    "attentions": ["ssam"],
    "width": 0.5,
    "clips": 20,
    "clip_frames": 26,
    "short_share": 0.0,
    "shift_px": 0,
    "light": 0.0,
    "noise": 0.0,
}
AUGMENTED = {"shift_px": 2, "light": 0.2, "noise": 0.02}
VARIANTS: dict[str, dict[str, Any]] = {
    "no attention, no reference": {"attentions": ["none"], "preprocess": {"size": 64, "reference": False}},
    "+ reference frame": {"attentions": ["none"], "preprocess": {"size": 64}},
    "+ magnitude alone": {"attentions": ["none"]},
    "with augmentation": {"attentions": ["none"], **AUGMENTED},
    "spatial attention, with augmentation": AUGMENTED,
    "channel attention": {"attentions": ["scam"]},
    "spatial attention": {},
    "deeper: ResNet-18": {"backbone": "resnet18"},
}
"""Changes to `BASE` by variant."""

DEFAULT = "deeper: ResNet-18"
RIDGE = "ridge regression"
PROCESSES = {"Gaussian process, difference": False, "Gaussian process, magnitude": True}
"""Gaussian processes on single frames, and True for those on magnitudes. They fit within a second."""

COMPONENTS, LENGTH, LINEAR, NOISE = 60, 4.0, 0.3, 0.1
"""Principal components, length scale in standard deviations of the first one, linear part, noise."""

COLUMNS = {
    "mae_n": "MAE N",
    "calibrated_mae_n": "after one trial",
    "same_day_mae_n": "same day",
    "contact_mae_n": "in contact",
    "best_line_mae_n": "best line in hindsight",
    "best_trial_line_mae_n": "best line per trial",
    "gain": "gain",
    "correlation": "correlation",
}


def run(variant: str, fold: list[str], clips: list[Clip], minutes: float, out: Path) -> list[dict[str, Any]]:
    """Trains without the objects of a fold and returns the results on each of them."""
    torch.set_num_threads(1)
    training = [clip for clip in clips if clip.object not in fold]
    test = [clip for clip in clips if clip.object in fold]
    if variant == RIDGE:
        return _rows(ridge_baseline(training, test))
    if variant in PROCESSES:
        preprocess = Preprocess(magnitude=PROCESSES[variant])
        return _rows(compare(test, gaussian_process(training, test, preprocess), preprocess.lead_in))
    recipe = TrainConfig(**{**BASE, **VARIANTS[variant], "minutes": minutes})
    checkpoint = train(recipe, training, out / f"{variant}-{fold[0]}.safetensors")
    forces_n = [members_n.mean(0) for members_n in estimates(checkpoint, test)]
    per_object = compare(test, forces_n, recipe.preprocess.lead_in).per_object
    process_n = gaussian_process(training, test, recipe.preprocess)
    means_n = [(network_n + n) / 2 for network_n, n in zip(forces_n, process_n, strict=True)]
    averaged = compare(test, means_n, recipe.preprocess.lead_in).per_object
    rows = []
    for name, result in per_object.items():
        pairs = [(c, f) for c, f in zip(test, forces_n, strict=True) if c.object == name]
        in_contact = [c.valid & (c.forces_n > CONTACT_N) for c, _ in pairs]
        measured_n = np.concatenate([c.forces_n[t] for (c, _), t in zip(pairs, in_contact, strict=True)])
        estimated_n = np.concatenate([f[t] for (_, f), t in zip(pairs, in_contact, strict=True)])
        gain = float(estimated_n @ measured_n / (measured_n @ measured_n))
        rows.append(
            {
                "object": name,
                **asdict(result),
                "with_process_mae_n": averaged[name].mae_n,
                "with_process_contact_mae_n": averaged[name].contact_mae_n,
                "gain": gain,
                "correlation": float(np.corrcoef(estimated_n, measured_n)[0, 1]),
                **calibrated(checkpoint, [c for c, _ in pairs]),
            }
        )
    return rows


def _rows(result: Evaluation) -> list[dict[str, Any]]:
    return [{"object": name, **asdict(errors)} for name, errors in result.per_object.items()]


def gaussian_process(training: list[Clip], test: list[Clip], preprocess: Preprocess) -> list[np.ndarray]:
    """Returns the forces of a Gaussian process on principal components of 32x32 images (RBF kernel)."""

    def images_of(clip: Clip) -> np.ndarray:
        frames = torch.from_numpy(clip.frames)[None]
        inputs = normalise(frames, frames[:, : preprocess.reference_frames], preprocess)[0]  # (T, 1, S, S)
        return F.avg_pool2d(inputs, inputs.shape[-1] // 32).flatten(1).double().numpy()

    def kernel(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        distance2 = np.square(a).sum(1)[:, None] + np.square(b).sum(1) - 2 * a @ b.T
        covariance: np.ndarray = np.exp(-distance2 / (2 * LENGTH**2)) + LINEAR / COMPONENTS * a @ b.T
        return covariance

    images = np.concatenate([images_of(clip)[clip.valid] for clip in training])
    forces_n = np.concatenate([clip.forces_n[clip.valid] for clip in training])
    centre, spread = images.mean(0), images.std(0) + 1e-3 * images.std()
    axes = np.linalg.svd((images[::5] - centre) / spread, full_matrices=False)[2][:COMPONENTS].T
    scores = (images - centre) / spread @ axes
    unit = scores[:, 0].std()
    in_contact = forces_n > CONTACT_N
    # Not all frames: neighbours are nearly equal, and the cost grows with the cube.
    selected_frames = np.concatenate([np.flatnonzero(in_contact)[::2], np.flatnonzero(~in_contact)[::8]])
    inputs = scores[selected_frames] / unit
    weights = np.linalg.solve(kernel(inputs, inputs) + NOISE * np.eye(len(inputs)), forces_n[selected_frames])
    return [kernel((images_of(clip) - centre) / spread @ axes / unit, inputs) @ weights for clip in test]


def calibrated(checkpoint: Checkpoint, clips: list[Clip]) -> dict[str, float]:
    """Returns the mean errors on an object's other trials after calibration on one, over all choices."""
    lead_in = checkpoint.header.preprocess.lead_in
    trials = []
    for number, clip in enumerate(clips):
        forces_n, read_out = features(checkpoint.networks, checkpoint.header.preprocess, clip.frames)
        used = clip.valid & (np.arange(len(clip.frames)) >= lead_in)
        trial_numbers = np.full(int(used.sum()), number)
        estimate_n = forces_n.mean(0)[used].astype(np.float64)
        trials.append(
            Touches(read_out[used], estimate_n, clip.forces_n[used].astype(np.float64), trial_numbers)
        )
    errors_n: dict[str, list[np.ndarray]] = {"calibrated_mae_n": [], "same_day_mae_n": []}
    errors_n["best_line_mae_n"] = [_best_line_errors(trials)]
    errors_n["best_trial_line_mae_n"] = [_best_line_errors([trial]) for trial in trials]
    for one, trial in zip(clips, trials, strict=True):
        try:
            correct = fit_correction(trial).predict
        except DataError:  # unusable for calibration: the network stays uncorrected
            correct = _uncorrected
        for other, t in zip(clips, trials, strict=True):
            if other is not one:
                error_n = np.abs(correct(t) - t.force_n)
                errors_n["calibrated_mae_n"].append(error_n)
                if other.set == one.set:
                    errors_n["same_day_mae_n"].append(error_n)
    return {name: float(np.concatenate(parts).mean()) for name, parts in errors_n.items()}


def _best_line_errors(trials: list[Touches]) -> np.ndarray:
    """Returns the absolute errors of the best gain and offset in hindsight."""
    estimate_n, force_n = (
        np.concatenate([getattr(t, of) for t in trials]) for of in ("estimate_n", "force_n")
    )
    design = np.stack([estimate_n, np.ones_like(estimate_n)], 1)
    error_n: np.ndarray = np.abs(design @ np.linalg.lstsq(design, force_n)[0] - force_n)
    return error_n


def _uncorrected(touches: Touches) -> np.ndarray:
    return touches.estimate_n


def summary(results: dict[str, list[dict[str, Any]]], variant: str, estimate: str = "") -> str:
    """Returns a table row: MAE over all frames and over frames in contact, mean and s.d. over folds."""
    parts = [rows for key, rows in results.items() if key.startswith(f"{variant}: ")]
    cells = []
    for figure in ("mae_n", "contact_mae_n"):
        folds = [
            np.average([r[estimate + figure] for r in rows], weights=[r["frames"] for r in rows])
            for rows in parts
        ]
        cells.append(f"{np.mean(folds):.2f} ± {np.std(folds):.2f}")
    name = f"{variant}, averaged with the process" if estimate else variant
    return f"| {name} | " + " | ".join(cells) + f" | {len(parts)} |"


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("recordings", type=Path)
    parser.add_argument("--folds", type=int, default=5)
    parser.add_argument("--minutes", type=float, default=5.0, help="training time of one fold, on one thread")
    parser.add_argument("--ladder", action="store_true", help="all variants, not only the default")
    parser.add_argument("--as-recorded", action="store_true", help="do not compensate the lag of the forces")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, help="default: data/real or data/as_recorded")
    options = parser.parse_args()
    options.out = options.out or Path("data/as_recorded" if options.as_recorded else "data/real")

    if not any(options.out.glob("*.mcap")):
        import_folder(options.recordings, options.out, align=not options.as_recorded)
    results_path = options.out / "results.json"
    results = json.loads(results_path.read_text()) if results_path.exists() else {}
    clips = load_clips(options.out, TrainConfig(**BASE).preprocess, workers=options.jobs)
    loaded = [
        c for c in clips if starts_in_contact(c.forces_n, TrainConfig(**BASE).preprocess.reference_frames)
    ]
    print(f"{len(clips)} recordings, of which {len(loaded)} start in contact and are used too\n")
    objects = np.random.default_rng(0).permutation(sorted({clip.object for clip in clips}))
    folds = [[str(name) for name in fold] for fold in np.array_split(objects, options.folds)]
    variants = [RIDGE, *PROCESSES, *(VARIANTS if options.ladder else [DEFAULT])]
    planned = {f"{r}: {options.minutes:g} min, {', '.join(f)}": (r, f) for f in folds for r in variants}
    with ProcessPoolExecutor(options.jobs, multiprocessing.get_context("spawn")) as pool:
        missing = {
            pool.submit(run, variant, fold, clips, options.minutes, options.out): key
            for key, (variant, fold) in planned.items()
            if key not in results
        }
        done = track(as_completed(missing), "folds", len(missing), console=Console(stderr=True))
        for future in done:
            results[missing[future]] = future.result()
            results_path.write_text(json.dumps(results, indent=1))

    print("| | MAE N | in contact | folds |\n|---|---|---|---|")
    selected = {key: results[key] for key in planned}
    for variant in variants:
        print(summary(selected, variant))
    print(summary(selected, DEFAULT, "with_process_"))
    print(
        "\n| held-out object | " + " | ".join(COLUMNS.values()) + " |\n" + "|---" * (len(COLUMNS) + 1) + "|"
    )
    held_out = [row for key, rows in selected.items() if key.startswith(f"{DEFAULT}: ") for row in rows]
    held_out.append(
        {"object": "mean", **{name: np.mean([row[name] for row in held_out]) for name in COLUMNS}}
    )
    for row in held_out:
        print(f"| {row['object']} | " + " | ".join(f"{row[name]:.2f}" for name in COLUMNS) + " |")


if __name__ == "__main__":
    main()
