"""Visual information on a stapler pressed against its stop, and the resulting error of the network.

    gripper-force simulate --out data/test --presses 48 --grasps 0 --first-seed 900000
    python scripts/stapler_stop.py data/test

Prints the travel of the jaws per newton by force, from the logs, and in the same bins the error of the
network, of its output on the line that fits best within the bin (least squares), and of the best constant. Past the
stop it also prints the correlation of the network's output with the force, within each log and over all: a positive
correlation shows that the image still changes with the force there.
"""

import argparse
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt

from gripper_force.jobs.dataset import load_clips
from gripper_force.jobs.estimates import estimate_clips
from gripper_force.runtime.log_reader import LogReader
from gripper_force.types import GraspStatus, LoadCellSample
from gripper_force.vision.checkpoint import load_checkpoint

OBJECT = "stapler"
EDGES_N = (1.0, 4.0, 8.0, 14.0)
"""Bins: soft, stiffer, and past the stop."""

MIN_FRAMES = 20
"""Least number of frames or cycles of a log for a figure of that log."""

_RISE_N = 0.05
"""Least rise of the force in 20 ms. While the force falls, friction keeps the jaws in place."""

Floats = npt.NDArray[np.float64]


def travel(paths: list[Path], low_n: float, high_n: float) -> Floats:
    """Returns the slope of jaw distance over rising force within a force range, mm/N, for each log, (K,)."""
    slopes = []
    for path in paths:
        reader = LogReader(path)
        table = np.array([(s.t_ns, s.width_m) for s in reader.records(GraspStatus)])
        cells = np.array([(c.t_ns, c.force_n) for c in reader.records(LoadCellSample) if c.valid])
        force_n = np.interp(table[:, 0], cells[:, 0], cells[:, 1])
        rising = np.concatenate([np.zeros(4), force_n[4:] - force_n[:-4]]) > _RISE_N
        in_bin = rising & (force_n > low_n) & (force_n < high_n)
        if in_bin.sum() >= MIN_FRAMES and np.ptp(force_n[in_bin]) > 1:
            slopes.append(1e3 * np.polyfit(force_n[in_bin], table[in_bin, 1], 1)[0])
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
    forces_n = [members_n.mean(0) for members_n in estimate_clips(checkpoint, clips)]
    used = [clip.labelled(preprocess.lead_in) for clip in clips]
    measured_n = np.concatenate([clip.forces_n[t] for clip, t in zip(clips, used, strict=True)])
    estimated_n = np.concatenate([f[t] for f, t in zip(forces_n, used, strict=True)])
    error_n = np.abs(estimated_n - measured_n)
    log = np.concatenate([np.full(t.sum(), i) for i, t in enumerate(used)])
    is_stapler = np.array([clip.object == OBJECT for clip in clips])[log]

    pressed = [path for path, clip in zip(paths, clips, strict=True) if clip.object == OBJECT]
    print(
        f"| {OBJECT}, N | travel mm/N | frames | network MAE N | on its best line, MAE N | constant, MAE N |"
    )
    print("|---|---|---|---|---|---|")
    for low, high in pairwise(EDGES_N):
        in_bin = is_stapler & (measured_n >= low) & (measured_n < high)
        constant_n = np.abs(measured_n[in_bin] - np.median(measured_n[in_bin])).mean()
        slope = np.median(travel(pressed, low, high))
        line = np.polyfit(estimated_n[in_bin], measured_n[in_bin], 1)
        line_n = np.abs(np.polyval(line, estimated_n[in_bin]) - measured_n[in_bin]).mean()
        figures = f"{in_bin.sum()} | {error_n[in_bin].mean():.2f} | {line_n:.2f} | {constant_n:.2f}"
        print(f"| {low:g} to {high:g} | {slope:.2f} | {figures} |")
    past = is_stapler & (measured_n >= EDGES_N[-2])
    by_log = [
        np.corrcoef(estimated_n[frames], measured_n[frames])[0, 1]
        for i in np.unique(log[past])
        if (frames := past & (log == i)).sum() >= MIN_FRAMES and np.ptp(measured_n[frames]) > 1
    ]
    print(
        f"\nCorrelation of output and force from {EDGES_N[-2]:g} N on: {min(by_log):.2f} to {max(by_log):.2f} within "
        f"{len(by_log)} logs with a range above 1 N, {np.corrcoef(estimated_n[past], measured_n[past])[0, 1]:.2f} "
        "over all"
    )
    rest_n = error_n[~past]
    replaced_n = (rest_n.sum() + past.sum() * constant_n) / len(error_n)
    print(
        f"\nMAE over all frames {error_n.mean():.3f} N; over all but the {OBJECT}'s from {EDGES_N[-2]:g} N "
        f"on {rest_n.mean():.3f} N; with the best constant there {replaced_n:.3f} N"
    )


if __name__ == "__main__":
    main()
