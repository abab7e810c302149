"""What a picture can tell of a stapler that is pressed against its stop, and what that costs an eye.

    gripper-force simulate --out data/test --presses 48 --grasps 0 --first-seed 900000
    python examples/stapler_stop.py data/test

How far the jaws still travel for a newton, by force, from the logs alone; and the network's error in the same
bins, beside that of somebody who sees nothing and says one number to all frames of a bin, the best one in
hindsight. Where the jaws don't move any more, nothing moves that a camera could see.
"""

import argparse
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt

from gripper_force.jobs.dataset import load_clips
from gripper_force.jobs.evaluate import estimates
from gripper_force.runtime.log import LogReader
from gripper_force.types import GraspStatus, LoadCellSample
from gripper_force.vision.checkpoint import load_checkpoint

OBJECT = "stapler"
EDGES_N = (1.0, 4.0, 8.0, 14.0)
"""Soft, stiffer, and past the stop."""

_RISE_N = 0.05
"""What the force must rise by in 20 ms: on the way back friction holds the jaws where they were."""

Floats = npt.NDArray[np.float64]


def travel(paths: list[Path], least_n: float, most_n: float) -> Floats:
    """Slope of the jaws' distance over the rising force of each log that has one there, mm/N, (K,)."""
    slopes = []
    for path in paths:
        reader = LogReader(path)
        table = np.array([(s.t_ns, s.width_m) for s in reader.records(GraspStatus)])
        cells = np.array([(c.t_ns, c.force_n) for c in reader.records(LoadCellSample) if c.valid])
        force_n = np.interp(table[:, 0], cells[:, 0], cells[:, 1])
        rising = np.concatenate([np.zeros(4), force_n[4:] - force_n[:-4]]) > _RISE_N
        there = rising & (force_n > least_n) & (force_n < most_n)
        if there.sum() >= 20 and np.ptp(force_n[there]) > 1:
            slopes.append(1e3 * np.polyfit(force_n[there], table[there, 1], 1)[0])
    return np.array(slopes)


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("--checkpoint", default="default")
    options = parser.parse_args()
    checkpoint = load_checkpoint(options.checkpoint)
    preprocess = checkpoint.header.preprocess
    paths = sorted(options.data.rglob("*.mcap"))
    clips = load_clips(paths, preprocess)
    forces_n = [members_n.mean(0) for members_n in estimates(checkpoint, clips)]
    told = [clip.valid & (np.arange(len(clip.frames)) >= preprocess.lead_in) for clip in clips]
    measured_n = np.concatenate([clip.forces_n[t] for clip, t in zip(clips, told, strict=True)])
    error_n = np.abs(np.concatenate([f[t] for f, t in zip(forces_n, told, strict=True)]) - measured_n)
    its_own = np.concatenate(
        [np.full(t.sum(), clip.object == OBJECT) for clip, t in zip(clips, told, strict=True)]
    )

    pressed = [path for path, clip in zip(paths, clips, strict=True) if clip.object == OBJECT]
    print(f"| {OBJECT}, N | travel mm/N | frames | network MAE N | one number for all, MAE N |")
    print("|---|---|---|---|---|")
    for low, high in pairwise(EDGES_N):
        there = its_own & (measured_n >= low) & (measured_n < high)
        blind_n = np.abs(measured_n[there] - np.median(measured_n[there])).mean()
        slope = np.median(travel(pressed, low, high))
        figures = f"{there.sum()} | {error_n[there].mean():.2f} | {blind_n:.2f}"
        print(f"| {low:g} to {high:g} | {slope:.2f} | {figures} |")
    past = its_own & (measured_n >= EDGES_N[-2])
    rest_n = error_n[~past]
    known_n = (rest_n.sum() + past.sum() * blind_n) / len(error_n)
    print(
        f"\nMAE over all frames {error_n.mean():.3f} N; over all but the {OBJECT}'s from {EDGES_N[-2]:g} N "
        f"on {rest_n.mean():.3f} N; with the one number there {known_n:.3f} N"
    )


if __name__ == "__main__":
    main()
