"""Force from a real finger camera, on objects that training has not seen.

Imports a folder of recordings (`<date>_<object>_<trial>/video.avi` with `load_cell.csv`), splits the objects
into folds, trains on all folds but one and evaluates on that one, with a ridge regression beside it. Each
object that was held out is then calibrated on one of its trials and tested on its others, each trial in turn:
on all of them, and on those of the same day alone, as the finger's pad was another on some days.

    python examples/real_grasps.py FOLDER [--folds 5] [--minutes 5]             # the last rung alone
    python examples/real_grasps.py FOLDER [--folds 5] [--minutes 5] --ladder    # what each thing brings
    python examples/real_grasps.py FOLDER --as-recorded                         # late forces left as they are

Each result is kept in OUT/results.json as it comes; the same command goes on where it was broken off.
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
from gripper_force.jobs.dataset import CONTACT_N, Clip, load_clips
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
RUNGS: dict[str, dict[str, Any]] = {
    "no attention, no reference": {"attentions": ["none"], "preprocess": {"size": 64, "reference": False}},
    "+ reference frame": {"attentions": ["none"], "preprocess": {"size": 64}},
    "+ magnitude alone": {"attentions": ["none"]},
    "with augmentation": {"attentions": ["none"], **AUGMENTED},
    "spatial attention, with augmentation": AUGMENTED,
    "channel attention": {"attentions": ["scam"]},
    "spatial attention": {},
    "deeper: ResNet-18": {"backbone": "resnet18"},
}
"""What each changes in `BASE`."""

DEFAULT = "deeper: ResNet-18"
RIDGE = "ridge regression"
PROCESSES = {"Gaussian process, difference": False, "Gaussian process, magnitude": True}
"""See one moment and no window; take a second where a network takes minutes. Which of them see magnitudes."""

COMPONENTS, LENGTH, LINEAR, NOISE = 60, 4.0, 0.3, 0.1
"""Of the processes: principal components, length scale in deviations of the first, linear part, noise."""

COLUMNS = {
    "mae_n": "MAE N",
    "calibrated_mae_n": "after one trial",
    "same_day_mae_n": "of the same day",
    "contact_mae_n": "in contact",
    "best_line_mae_n": "its best line known",
    "best_trial_line_mae_n": "each trial's",
    "gain": "gain",
    "correlation": "correlation",
}


def run(rung: str, fold: list[str], clips: list[Clip], minutes: float, out: Path) -> list[dict[str, Any]]:
    """Trains without the fold's objects, and tells of each of them how well the network does there."""
    torch.set_num_threads(1)
    training = [clip for clip in clips if clip.object not in fold]
    test = [clip for clip in clips if clip.object in fold]
    if rung == RIDGE:
        return _rows(ridge_baseline(training, test))
    if rung in PROCESSES:
        preprocess = Preprocess(magnitude=PROCESSES[rung])
        return _rows(compare(test, gaussian_process(training, test, preprocess), preprocess.lead_in))
    recipe = TrainConfig(**{**BASE, **RUNGS[rung], "minutes": minutes})
    checkpoint = train(recipe, training, out / f"{rung}-{fold[0]}.safetensors")
    forces_n = [members_n.mean(0) for members_n in estimates(checkpoint, test)]
    per_object = compare(test, forces_n, recipe.preprocess.lead_in).per_object
    process_n = gaussian_process(training, test, recipe.preprocess)
    means_n = [(network_n + n) / 2 for network_n, n in zip(forces_n, process_n, strict=True)]
    together = compare(test, means_n, recipe.preprocess.lead_in).per_object
    rows = []
    for name, result in per_object.items():
        pairs = [(c, f) for c, f in zip(test, forces_n, strict=True) if c.object == name]
        touched = [c.valid & (c.forces_n > CONTACT_N) for c, _ in pairs]
        measured_n = np.concatenate([c.forces_n[t] for (c, _), t in zip(pairs, touched, strict=True)])
        estimated_n = np.concatenate([f[t] for (_, f), t in zip(pairs, touched, strict=True)])
        gain = float(estimated_n @ measured_n / (measured_n @ measured_n))
        rows.append(
            {
                "object": name,
                **asdict(result),
                "with_process_mae_n": together[name].mae_n,
                "with_process_contact_mae_n": together[name].contact_mae_n,
                "gain": gain,
                "correlation": float(np.corrcoef(estimated_n, measured_n)[0, 1]),
                **calibrated(checkpoint, [c for c, _ in pairs]),
            }
        )
    return rows


def _rows(result: Evaluation) -> list[dict[str, Any]]:
    return [{"object": name, **asdict(errors)} for name, errors in result.per_object.items()]


def gaussian_process(training: list[Clip], test: list[Clip], preprocess: Preprocess) -> list[np.ndarray]:
    """Regression on principal components of pictures of 32x32, with a squared exponential kernel."""

    def look(clip: Clip) -> np.ndarray:
        frames = torch.from_numpy(clip.frames)[None]
        inputs = normalise(frames, frames[:, : preprocess.reference_frames], preprocess)[0]  # (T, 1, S, S)
        return F.avg_pool2d(inputs, inputs.shape[-1] // 32).flatten(1).double().numpy()

    def kernel(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        apart = np.square(a).sum(1)[:, None] + np.square(b).sum(1) - 2 * a @ b.T
        similar: np.ndarray = np.exp(-apart / (2 * LENGTH**2)) + LINEAR / COMPONENTS * a @ b.T
        return similar

    pictures = np.concatenate([look(clip)[clip.valid] for clip in training])
    forces_n = np.concatenate([clip.forces_n[clip.valid] for clip in training])
    centre, spread = pictures.mean(0), pictures.std(0) + 1e-3 * pictures.std()
    axes = np.linalg.svd((pictures[::5] - centre) / spread, full_matrices=False)[2][:COMPONENTS].T
    scores = (pictures - centre) / spread @ axes
    unit = scores[:, 0].std()
    touched = forces_n > CONTACT_N
    # Not all frames: neighbours tell nearly the same, and the cost goes with the cube.
    chosen = np.concatenate([np.flatnonzero(touched)[::2], np.flatnonzero(~touched)[::8]])
    known = scores[chosen] / unit
    weights = np.linalg.solve(kernel(known, known) + NOISE * np.eye(len(known)), forces_n[chosen])
    return [kernel((look(clip) - centre) / spread @ axes / unit, known) @ weights for clip in test]


def calibrated(checkpoint: Checkpoint, clips: list[Clip]) -> dict[str, float]:
    """Mean errors on an object's other trials after a calibration on one, over all choices of that one."""
    lead_in = checkpoint.header.preprocess.lead_in
    trials = []
    for number, clip in enumerate(clips):
        forces_n, read_out = features(checkpoint.networks, checkpoint.header.preprocess, clip.frames)
        seen = clip.valid & (np.arange(len(clip.frames)) >= lead_in)
        whose = np.full(int(seen.sum()), number)
        estimate_n = forces_n.mean(0)[seen].astype(np.float64)
        trials.append(Touches(read_out[seen], estimate_n, clip.forces_n[seen].astype(np.float64), whose))
    errors_n: dict[str, list[np.ndarray]] = {"calibrated_mae_n": [], "same_day_mae_n": []}
    errors_n["best_line_mae_n"] = [_beside_best_line(trials)]
    errors_n["best_trial_line_mae_n"] = [_beside_best_line([trial]) for trial in trials]
    for one, trial in zip(clips, trials, strict=True):
        try:
            correct = fit_correction(trial).predict
        except DataError:  # what it tells is no calibration: the network stays as it is
            correct = _as_it_is
        for other, t in zip(clips, trials, strict=True):
            if other is not one:
                error_n = np.abs(correct(t) - t.force_n)
                errors_n["calibrated_mae_n"].append(error_n)
                if other.set == one.set:
                    errors_n["same_day_mae_n"].append(error_n)
    return {name: float(np.concatenate(parts).mean()) for name, parts in errors_n.items()}


def _beside_best_line(trials: list[Touches]) -> np.ndarray:
    """Absolute errors of the line that hindsight draws: no gain and offset do better."""
    estimate_n, force_n = (
        np.concatenate([getattr(t, of) for t in trials]) for of in ("estimate_n", "force_n")
    )
    sides = np.stack([estimate_n, np.ones_like(estimate_n)], 1)
    error_n: np.ndarray = np.abs(sides @ np.linalg.lstsq(sides, force_n)[0] - force_n)
    return error_n


def _as_it_is(touches: Touches) -> np.ndarray:
    return touches.estimate_n


def summary(results: dict[str, list[dict[str, Any]]], rung: str, estimate: str = "") -> str:
    """A row: MAE over all frames and over frames in contact, mean and s.d. over folds."""
    parts = [rows for key, rows in results.items() if key.startswith(f"{rung}: ")]
    cells = []
    for figure in ("mae_n", "contact_mae_n"):
        folds = [
            np.average([r[estimate + figure] for r in rows], weights=[r["frames"] for r in rows])
            for rows in parts
        ]
        cells.append(f"{np.mean(folds):.2f} ± {np.std(folds):.2f}")
    name = f"{rung}, averaged with the process" if estimate else rung
    return f"| {name} | " + " | ".join(cells) + f" | {len(parts)} |"


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("recordings", type=Path)
    parser.add_argument("--folds", type=int, default=5)
    parser.add_argument("--minutes", type=float, default=5.0, help="training time of one fold, on one thread")
    parser.add_argument("--ladder", action="store_true", help="all rungs, not only the last")
    parser.add_argument("--as-recorded", action="store_true", help="leave forces that come late as they are")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, help="by default data/real or data/as_recorded")
    options = parser.parse_args()
    options.out = options.out or Path("data/as_recorded" if options.as_recorded else "data/real")

    if not any(options.out.glob("*.mcap")):
        import_folder(options.recordings, options.out, align=not options.as_recorded)
    kept = options.out / "results.json"
    results = json.loads(kept.read_text()) if kept.exists() else {}
    clips = load_clips(options.out, TrainConfig(**BASE).preprocess, workers=options.jobs)
    objects = np.random.default_rng(0).permutation(sorted({clip.object for clip in clips}))
    folds = [[str(name) for name in fold] for fold in np.array_split(objects, options.folds)]
    rungs = [RIDGE, *PROCESSES, *(RUNGS if options.ladder else [DEFAULT])]
    wanted = {f"{r}: {options.minutes:g} min, {', '.join(f)}": (r, f) for f in folds for r in rungs}
    with ProcessPoolExecutor(options.jobs, multiprocessing.get_context("spawn")) as pool:
        missing = {
            pool.submit(run, rung, fold, clips, options.minutes, options.out): key
            for key, (rung, fold) in wanted.items()
            if key not in results
        }
        done = track(as_completed(missing), "folds", len(missing), console=Console(stderr=True))
        for future in done:
            results[missing[future]] = future.result()
            kept.write_text(json.dumps(results, indent=1))

    print("| | MAE N | in contact | folds |\n|---|---|---|---|")
    mine = {key: results[key] for key in wanted}
    for rung in rungs:
        print(summary(mine, rung))
    print(summary(mine, DEFAULT, "with_process_"))
    print("\n| held out | " + " | ".join(COLUMNS.values()) + " |\n" + "|---" * (len(COLUMNS) + 1) + "|")
    held_out = [row for key, rows in mine.items() if key.startswith(f"{DEFAULT}: ") for row in rows]
    held_out.append(
        {"object": "mean", **{name: np.mean([row[name] for row in held_out]) for name in COLUMNS}}
    )
    for row in held_out:
        print(f"| {row['object']} | " + " | ".join(f"{row[name]:.2f}" for name in COLUMNS) + " |")


if __name__ == "__main__":
    main()
