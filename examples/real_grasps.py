"""Force from a real finger camera, on objects that training has not seen.

Imports a folder of recordings (`<date>_<object>_<trial>/video.avi` with `load_cell.csv`), splits the objects
into folds, trains on all folds but one and evaluates on that one, with a ridge regression beside it.

    python examples/real_grasps.py FOLDER [--folds 3] [--minutes 5]
"""

import argparse
import sys
from pathlib import Path

import numpy as np

from gripper_force.dataset import Clip, load_clips
from gripper_force.evaluate import Result, evaluate, ridge_baseline
from gripper_force.recipe import TrainConfig
from gripper_force.train import train
from gripper_force.video_import import import_folder
from gripper_force.vision.preprocess import Preprocess


def contact_mae_n(result: Result) -> float:
    """Error on frames in contact, over all objects."""
    parts = result["per_object"].values()
    return float(np.average([p["contact_mae_n"] for p in parts], weights=[p["frames"] for p in parts]))


def run_fold(clips: list[Clip], held_out: list[str], recipe: TrainConfig, out: Path) -> tuple[Result, Result]:
    """Trains without these objects and evaluates on them: the network's result, and the ridge's."""
    training = [clip for clip in clips if clip.object not in held_out]
    test = [clip for clip in clips if clip.object in held_out]
    return evaluate(train(recipe, training, out), test), ridge_baseline(training, test)


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("recordings", type=Path)
    parser.add_argument("--folds", type=int, default=3)
    parser.add_argument("--minutes", type=float, default=5.0, help="training time of one fold")
    parser.add_argument("--out", type=Path, default=Path("data/real"))
    options = parser.parse_args()

    if not any(options.out.glob("*.mcap")):
        import_folder(options.recordings, options.out)
    recipe = TrainConfig(
        preprocess=Preprocess(size=64),
        attentions=("ssam",),
        width=0.5,
        clips=20,
        clip_frames=26,
        short_share=0.0,
        minutes=options.minutes,
    )
    clips = load_clips(options.out, recipe.preprocess, workers=2)
    objects = np.random.default_rng(0).permutation(sorted({clip.object for clip in clips}))
    rows = []
    print("| held out | network, MAE N | in contact | ridge, MAE N | in contact |\n|---|---|---|---|---|")
    for fold in np.array_split(objects, options.folds):
        held_out = [str(name) for name in fold]
        ours, ridge = run_fold(clips, held_out, recipe, options.out / "fold.safetensors")
        row = (ours["mae_n"], contact_mae_n(ours), ridge["mae_n"], contact_mae_n(ridge))
        rows.append(row)
        print(f"| {', '.join(held_out)} | " + " | ".join(f"{v:.2f}" for v in row) + " |")
        sys.stdout.flush()
    mean, spread = np.mean(rows, axis=0), np.std(rows, axis=0)
    print(
        "| mean ± s.d. | "
        + " | ".join(f"{m:.2f} ± {s:.2f}" for m, s in zip(mean, spread, strict=True))
        + " |"
    )


if __name__ == "__main__":
    main()
