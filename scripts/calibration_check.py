"""Benefit of object calibration, measured on simulated objects that are not in the training data.

The objects differ from those in training in stiffness (up to 50 %, training 5 %), size (up to 10 %, training
4 %) and texture; a fifth one, a ball, is of another kind. Each object is touched many times on one rig, and
placed again each time. The last touches are used for testing only.

    python scripts/calibration_check.py                # error and interval by number of touches
    python scripts/calibration_check.py --grasps 40    # grasps with a profile of 8 touches, and without

Results of the same network that exist in OUT are reused.
"""

import argparse
import json
import multiprocessing
import os
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track

from gripper_calibration import touch_logs
from gripper_calibration.fits.object_fit import fit_correction
from gripper_calibration.fits.touches import Touches
from gripper_calibration.procedures.calibrate_object import calibrate_object, record_touches
from gripper_force.config import Config, load_config
from gripper_force.errors import DataError
from gripper_force.jobs.dataset import CONTACT_N
from gripper_force.jobs.grasp import grasp
from gripper_force.profiles.object_profile import read_object
from gripper_force.vision.engines import open_engine
from gripper_force.vision.model_files import read_model
from gripper_force.vision.ood import OodScore
from gripper_force.vision.stream_inference import features

KINDS = ("sponge", "paper_cup", "tube", "stapler", "ball")
COUNTS = (1, 2, 4, 8, 16)
DRAWS = 4
PROFILE = 8
TARGETS_N = (1.0, 8.0)


def configure(kind: str, number: int, out: Path, *more: str) -> Config:
    """Returns the configuration of a rig with one of the objects."""
    object_seed = 970_000 + number
    keys = [f"object={kind}", "sim.stiffness_spread=0.5", "sim.size_spread=0.1", f"seed={100 * object_seed}"]
    return load_config(
        None,
        [
            *keys,
            f"sim.object_seed={object_seed}",
            f"sim.rig_seed={object_seed}",
            f"log.directory={out}",
            *more,
        ],
    )


def kept_file(out: Path, *parts: object, suffix: str = ".json") -> Path:
    """Returns the file of a result, which belongs to the shipped network."""
    digest = read_model("default").digest
    return out / f"{'-'.join(map(str, parts))}-{digest[:8]}{suffix}"


def errors(kind: str, number: int, out: Path, touched: int, tested: int) -> list[dict[str, Any]]:
    """Touches an object and calibrates on increasing numbers of touches. Returns a row for each draw."""
    kept = kept_file(out, kind, number, touched, tested)
    if kept.exists():
        rows: list[dict[str, Any]] = json.loads(kept.read_text())
        return rows
    paths = list(record_touches(configure(kind, number, out), touched, None, out / f"{kind}-{number}"))
    engine = open_engine(read_model("default"))
    ood = engine.header.ood
    assert ood is not None  # the shipped network has one
    run = partial(features, engine)
    read = {path: touch_logs.read_log(path, engine.header.preprocess, run) for path in paths}
    touches = touch_logs.join(read).touches
    test = touches.only(touches.numbers[-tested:])
    rng = np.random.default_rng(number)
    before_n = float(np.abs(test.estimate_n - test.force_n).mean())
    rows = []
    for count in (count for count in COUNTS if count <= touched - tested):
        for _ in range(DRAWS):
            drawn = rng.choice(touches.numbers[:-tested], count, replace=False)
            row: dict[str, Any] = {"object": kind, "touches": count, "before_n": before_n}
            try:
                fitted = fit_correction(touches.only([int(n) for n in drawn]), ood=ood)
            except DataError:  # a light touch may be unusable: the network stays uncorrected
                rows.append({**row, "after_n": before_n, "refused": 1.0})
                continue
            after_n = fitted.predict(test)
            error_n = np.abs(after_n - test.force_n)
            within = (error_n <= fitted.interval.half_width_n(after_n))[test.force_n > CONTACT_N]
            rows.append(
                {
                    **row,
                    "after_n": float(error_n.mean()),
                    "within": float(within.mean()),
                    "half_width_n": float(fitted.interval.half_width_n(5.0)),
                    "rejected": rejected_share(test, OodScore(ood, fitted.arrays.known)),
                }
            )
    kept.write_text(json.dumps(rows))
    return rows


def rejected_share(touches: Touches, score: OodScore) -> float:
    """Returns the share of frames over the limit; each touch is a stream."""
    rejected = []
    for number in touches.numbers:
        one = touches.only([number])
        score.reset()
        rejected.append(score.score(one.features, one.estimate_n) > 1)
    return float(np.concatenate(rejected).mean())


def one_grasp(
    kind: str, number: int, trial: int, target_n: float, profile: str, feedback: str, out: Path
) -> Any:
    """Runs one grasp with a profile of the object, or without one, and returns its summary."""
    kept = kept_file(out, "grasp", kind, number, trial, "profile" if profile else "none", feedback)
    if not kept.exists():
        known = [f"calibration.object={profile}"] if profile else []
        keys = [f"target_n={target_n}", f"control.feedback={feedback}", "log.report=false", *known]
        config = configure(kind, number, kept.with_suffix(""), *keys)
        result = grasp(config.with_values(seed=config.seed + 50 + trial))
        kept.write_text(json.dumps(result))
    return json.loads(kept.read_text())


def profile_of(kind: str, number: int, out: Path) -> str:
    """Makes a profile of the first touches of an object, and returns its path."""
    path = kept_file(out, kind, number, suffix=".yaml")
    if not path.exists():
        config = configure(kind, number, out)
        calibrate_object(config, kind, touches=PROFILE, folder=out / f"{kind}-{number}", out=path)
    return str(path)


def errors_table(rows: list[dict[str, Any]]) -> None:
    """Prints errors and intervals by number of touches."""
    print(
        "| touches | MAE N before | after | ratio | in contact in 90 % interval | below 80 % | half-width | rejected | "
        "refused |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    counts = sorted({row["touches"] for row in rows})
    for count in counts:
        part = [row for row in rows if row["touches"] == count]
        keys = ("before_n", "after_n", "within", "half_width_n", "rejected", "refused")
        known = {key: [row[key] for row in part if key in row] for key in keys}
        mean = {key: float(np.mean(values)) if values else 0.0 for key, values in known.items()}
        refused = len(known["refused"])
        below = float(np.mean(np.array(known["within"]) < 0.8)) if known["within"] else 0.0
        print(
            f"| {count} | {mean['before_n']:.3f} | {mean['after_n']:.3f} | "
            f"{mean['before_n'] / mean['after_n']:.1f} | {100 * mean['within']:.0f} % | {100 * below:.0f} % | "
            f"{mean['half_width_n']:.2f} N | {100 * mean['rejected']:.1f} % | {refused} of {len(part)} |"
        )
    print("\n| object | before | " + " | ".join(f"{count} touches" for count in counts) + " |")
    print("|---|---|" + "---|" * len(counts))
    for kind in KINDS:
        own = [row for row in rows if row["object"] == kind]
        cells = [np.mean([r["after_n"] for r in own if r["touches"] == count]) for count in counts]
        print(
            f"| {kind} | {np.mean([r['before_n'] for r in own]):.3f} | "
            + " | ".join(f"{cell:.3f}" for cell in cells)
            + " |"
        )


def grasps_table(results: dict[tuple[str, str], list[dict[str, Any]]]) -> None:
    """Prints the results of the grasps."""
    limit_n = load_config().control.force_limit_n
    print(
        "| feedback | profile | median error | within 8 % or 0.25 N | MAE of estimate | held | over limit |"
    )
    print("|---|---|---|---|---|---|---|")
    for (feedback, known), grasps in results.items():
        scored = [g for g in grasps if g["steady_error_n"] is not None]
        error_n = np.array([abs(g["steady_error_n"]) for g in scored])
        share = error_n / np.array([g["target_n"] for g in scored])
        good = (share <= 0.08) | (error_n <= 0.25)
        source = "fused" if feedback == "fused" else "visual"
        mae_n = np.mean([v for g in grasps if (v := g["estimate_mae_n"][source]) is not None])
        held = sum(g["result"] == "held" for g in grasps)
        over = sum(g["peak_n"] > limit_n for g in grasps)
        print(
            f"| {feedback} | {known} | {100 * np.median(share):.1f} % | "
            f"{100 * good.sum() / len(grasps):.0f} % | {mae_n:.3f} N | {held} of {len(grasps)} | {over} |"
        )


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--each", type=int, default=3, help="objects of each kind")
    parser.add_argument("--touches", type=int, default=24, help="touches of each object")
    parser.add_argument("--tested", type=int, default=8, help="the last touches, which are for testing only")
    parser.add_argument("--grasps", type=int, default=0, help="number of grasps with and without a profile")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--out", type=Path, default=Path("data/calibration"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    objects = [(kind, 10 * k + n) for n in range(options.each) for k, kind in enumerate(KINDS)]
    console = Console(stderr=True)
    with ProcessPoolExecutor(options.jobs, multiprocessing.get_context("spawn")) as pool:
        if not options.grasps:
            done = [
                pool.submit(errors, *which, options.out, options.touches, options.tested) for which in objects
            ]
            errors_table([r for f in track(done, "objects", console=console) for r in f.result()])
            return
        made = [pool.submit(profile_of, *which, options.out) for which in objects]
        profiles = [future.result() for future in track(made, "profiles", console=console)]
        rng = np.random.default_rng(20)
        max_n = [read_object(Path(profile)).force_n - 0.001 for profile in profiles]
        plan = [
            (i % len(objects), i, round(min(float(rng.uniform(*TARGETS_N)), max_n[i % len(objects)]), 3))
            for i in range(options.grasps)
        ]
        pending = {
            (feedback, known): [
                pool.submit(
                    one_grasp,
                    *objects[i],
                    trial,
                    target_n,
                    profiles[i] if known == "yes" else "",
                    feedback,
                    options.out,
                )
                for i, trial, target_n in plan
            ]
            for feedback in ("fused", "vision")
            for known in ("no", "yes")
        }
        results = defaultdict(list)
        for key, futures in pending.items():
            results[key] = [f.result() for f in track(futures, " ".join(key), console=console)]
        grasps_table(results)


if __name__ == "__main__":
    main()
