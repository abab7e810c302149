"""Animates a simulated grasp: the camera's frames beside the growing force curve.

    python scripts/readme_animation.py docs/grasp.webp

The file's suffix selects the format: .webp or .gif. Takes about 40 s.
"""

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from gripper_force.config import load_config
from gripper_force.jobs.grasp import run_grasp
from gripper_force.runtime.log_reader import LogReader
from gripper_force.types import Frame, FusedForce, GraspStatus, LoadCellSample, Phase

RATE_HZ: Final = 12.5
"""Frames per second of the animation, which plays in real time."""

SIZE_IN, DPI = (8.6, 3.6), 100
VISION, CELL, TARGET = "#111827", "#009e73", "#8a9099"


def animate(log: Path, target_n: float) -> list[Image.Image]:
    """Returns the images of the animation, in order."""
    reader = LogReader(log)
    records = list(reader.records(Frame, FusedForce, LoadCellSample, GraspStatus))
    frames = [r for r in records if isinstance(r, Frame)]
    fused = np.array([(r.t_ns, r.force_n) for r in records if isinstance(r, FusedForce)])
    cell = np.array([(r.t_ns, r.force_n) for r in records if isinstance(r, LoadCellSample) and r.valid])
    status = [r for r in records if isinstance(r, GraspStatus)]
    start_ns = next(r.t_ns for r in status if r.phase == Phase.APPROACH)
    end_ns = status[-1].t_ns
    fused[:, 0], cell[:, 0] = 1e-9 * (fused[:, 0] - start_ns), 1e-9 * (cell[:, 0] - start_ns)

    figure = Figure(figsize=SIZE_IN, dpi=DPI)
    canvas = FigureCanvasAgg(figure)
    view = figure.add_axes((0.015, 0.12, 0.36, 0.86))
    view.axis("off")
    image = view.imshow(frames[0].gray, cmap="gray", vmin=0, vmax=255, interpolation="bicubic")
    caption = figure.text(0.195, 0.05, "", ha="center", va="center", size=11, color=VISION)
    curve = figure.add_axes((0.45, 0.15, 0.535, 0.8))
    curve.axhline(target_n, color=TARGET, lw=1, ls="--", label=f"target {target_n:g} N")
    (measured,) = curve.plot([], [], color=CELL, lw=2.4, label="load cell, only to check")
    (estimated,) = curve.plot([], [], color=VISION, lw=1.5, label="estimate from camera and motor")
    curve.set_xlim(0, 1e-9 * (end_ns - start_ns))
    curve.set_ylim(-0.3, 1.35 * target_n)
    curve.set_xlabel("time, s")
    curve.set_ylabel("grip force, N")
    curve.legend(frameon=False, loc="upper left", fontsize=9)
    curve.spines[["top", "right"]].set_visible(False)

    images = []
    for t_s in np.arange(0, 1e-9 * (end_ns - start_ns), 1 / RATE_HZ):
        now_ns = start_ns + 1e9 * t_s
        image.set_data(next((f for f in reversed(frames) if f.received_ns <= now_ns), frames[0]).gray)
        phase = next(r.phase for r in reversed(status) if r.t_ns <= now_ns)
        for line, table in ((estimated, fused), (measured, cell)):
            shown = table[(table[:, 0] >= 0) & (table[:, 0] <= t_s)]
            line.set_data(shown[:, 0], shown[:, 1])
        force_n = float(np.interp(t_s, fused[:, 0], fused[:, 1]))
        caption.set_text(f"{phase}: {force_n:.1f} N")
        canvas.draw()
        images.append(Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB"))
    return images


def main() -> None:
    """Grasps and writes the animation."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("file", type=Path)
    parser.add_argument("--object", default="sponge")
    parser.add_argument("--target-n", type=float, default=5.0)
    parser.add_argument("--seed", type=int, default=7)
    options = parser.parse_args()
    keys = [f"object={options.object}", f"target_n={options.target_n}", f"seed={options.seed}"]
    with TemporaryDirectory() as folder:
        log = Path(folder) / "grasp.mcap"
        run_grasp(load_config(None, [*keys, "control.hold_s=2"]), log)
        first, *others = animate(log, options.target_n)
    pause_ms = round(1000 / RATE_HZ)
    durations = [pause_ms] * len(others) + [1500]
    first.save(
        options.file, save_all=True, append_images=others, duration=durations, loop=0, quality=75, method=6
    )
    print(f"{options.file}: {1 + len(others)} images, {options.file.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
