"""Draws the figures of the documentation into a folder.

    python scripts/docs_figures.py docs/figures

``loop``, ``calibration``, ``safety`` and ``wiring`` are diagrams. ``fusion`` and ``terminal`` show simulated grasps,
which the script runs first (about 30 s).
"""

import argparse
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

INK, MUTED = "#1f2933", "#66707c"
BLUE, ORANGE, GREEN, RED, GRAY = "#e3edf9", "#fdeedb", "#e1f3e8", "#fbe4e2", "#eef0f3"
EDGES: Final = {BLUE: "#3b6fb5", ORANGE: "#c77700", GREEN: "#2f8a57", RED: "#c0392b", GRAY: "#8a9099"}
VISION, CURRENT, FUSED, CELL = "#0072b2", "#e69f00", "#111827", "#009e73"
"""Colours of the curves, as in the reports."""

Point = tuple[float, float]


class Diagram:
    """Boxes and arrows; one unit is 1/10 inch, and y points up."""

    def __init__(self, width: float, height: float) -> None:
        self.figure = Figure(figsize=(width / 10, height / 10))
        self.axes: Axes = self.figure.add_axes((0, 0, 1, 1))
        self.axes.set_xlim(0, width)
        self.axes.set_ylim(0, height)
        self.axes.axis("off")

    def box(self, x: float, y: float, width: float, height: float, text: str, colour: str) -> None:
        """Draws a box by its lower left corner; the first line of its text is its name."""
        shape = FancyBboxPatch(
            (x, y), width, height, boxstyle="round,pad=0,rounding_size=1", fc=colour, ec=EDGES[colour], lw=1.2
        )
        self.axes.add_patch(shape)
        name, *rest = text.split("\n")
        middle = x + width / 2
        lines = len(rest)
        top = y + height / 2 + 0.9 * lines
        self.text(middle, top, name, weight="bold")
        for number, line in enumerate(rest, 1):
            self.text(middle, top - 1.9 * number, line, size=8.5, color=MUTED)

    def text(self, x: float, y: float, text: str, **style: Any) -> None:
        """Writes a centred text."""
        self.axes.text(x, y, text, **{"size": 9.5, "color": INK, "ha": "center", "va": "center", **style})

    def arrow(
        self, points: Sequence[Point], text: str = "", at: Point | None = None, dashed: bool = False
    ) -> None:
        """Draws an arrow along points, with a text at ``at``, else beside the middle of its first part."""
        style: dict[str, Any] = {"color": INK, "lw": 1.2, "ls": (0, (3, 2)) if dashed else "-"}
        xs, ys = zip(*points, strict=True)
        self.axes.plot(xs[:-1] if len(points) > 2 else [], ys[:-1] if len(points) > 2 else [], **style)
        arrow = {"arrowstyle": "-|>", "shrinkA": 0, "shrinkB": 0, "mutation_scale": 11, **style}
        self.axes.annotate("", points[-1], points[-2], arrowprops=arrow)
        (x0, y0), (x1, y1) = points[:2]
        place = at or ((x0 + x1) / 2, (y0 + y1) / 2 + 1.3)
        if text:
            self.text(*place, text, size=8.5, color=MUTED)


def loop() -> Figure:
    """Returns the parts of the force loop and what they exchange."""
    d = Diagram(96, 40)
    d.box(1, 26, 15, 9, "Camera\ngray frames\n60 per second", BLUE)
    d.box(23, 26, 17, 9, "Estimator\nattention network\nlast 20 frames", BLUE)
    d.box(47, 26, 15, 9, "Fusion\nKalman filter", GREEN)
    d.box(70, 26, 11, 9, "Force loop\nPI", GREEN)
    d.box(86, 22, 9, 13, "Limits\nforce\ncurrent\nspeed", RED)
    d.box(70, 3, 25, 9, "Servo\ncurrent-based position mode", ORANGE)
    d.box(23, 3, 17, 9, "Jaws and object", ORANGE)
    d.box(1, 3, 15, 9, "Load cell\noptional", GRAY)
    d.arrow([(16, 30.5), (23, 30.5)], "image")
    d.arrow([(40, 30.5), (47, 30.5)], "N ± N")
    d.arrow([(62, 30.5), (70, 30.5)], "N ± N")
    d.arrow([(81, 30.5), (86, 30.5)])
    d.arrow([(90.5, 22), (90.5, 12)], "goal current\ngoal position", (84, 17))
    d.arrow([(70, 7.5), (40, 7.5)], "torque")
    d.arrow([(72.5, 12), (72.5, 19), (54.5, 19), (54.5, 26)], "motor current, angle", (64, 20.3))
    d.arrow([(27, 12), (27, 19), (8.5, 19), (8.5, 26)], "view of the contact", (17.5, 20.3))
    d.arrow([(23, 7.5), (16, 7.5)], dashed=True)
    d.text(8.5, 1.2, "to calibrate and to check", size=8.5, color=MUTED)
    d.arrow([(75.5, 39), (75.5, 35)], "target force", (68.5, 37.6))
    d.text(54.5, 37.6, "200 times per second", size=8.5, color=MUTED)
    return d.figure


def calibration() -> Figure:
    """Returns the order of the calibrations, and the files that they write."""
    d = Diagram(96, 34)
    names = (
        ("Known mass\n0.2 to 1 kg", GRAY),
        ("Load cell\ntare, N per count", BLUE),
        ("Servo\nN m per A\nfriction", BLUE),
        ("Camera\nregion, exposure\nlag", BLUE),
        ("Object\ncorrection\ninterval", GREEN),
    )
    for place, (text, colour) in enumerate(names):
        d.box(1 + 20 * place, 20, 14, 10, text, colour)
        if place:
            d.arrow([(20 * place - 5, 25), (20 * place + 1, 25)])
    for place, command in ((1, "calibrate load-cell"), (2, "calibrate servo"), (3, "calibrate camera")):
        d.text(8 + 20 * place, 31.8, command, size=8.5, color=MUTED, family="monospace")
    d.text(88, 31.8, "calibrate object", size=8.5, color=MUTED, family="monospace")
    d.box(21, 3, 54, 7, "rig.yaml\nrig profile: one rig, every object", ORANGE)
    d.box(79, 3, 16, 7, "mug.yaml\nobject profile", ORANGE)
    for x in (28, 48, 68, 87):
        d.arrow([(x, 20), (x, 10)])
    d.text(8, 6.5, "Every newton goes back\nto the known mass.", size=9, color=MUTED)
    return d.figure


def safety() -> Figure:
    """Returns the layers of protection, and what each one bounds whatever the layers above do."""
    d = Diagram(96, 47)
    d.text(26, 45, "layer", size=8.5, color=MUTED)
    d.text(70, 45, "bounds, whatever the layers above do", size=8.5, color=MUTED)
    rows = (
        ("Request check\ncontrol cycle", "target within force limit and calibrated range", GRAY),
        (
            "Latch\ncontrol/safety",
            "ends the run: hardware error, temperature, voltage,\nposition jump, too much current, stop request",
            GREEN,
        ),
        (
            "Limits\ncontrol/limits",
            "force by motor current alone, whatever the camera shows;\ngoal current and goal position",
            GREEN,
        ),
        (
            "Speed limit\ncontrol/speed_limit",
            "lead of the goal position, and so the speed of the jaws",
            GREEN,
        ),
        (
            "Servo\nfirmware",
            "Current Limit; Bus Watchdog: stops 40 ms after the last\npacket, also if the process is killed",
            ORANGE,
        ),
    )
    for place, (name, text, colour) in enumerate(rows):
        y = 36 - 8.6 * place
        d.box(8 + 2 * place, y, 36 - 4 * place, 7, name, colour)
        d.text(49, y + 3.5, text, ha="left", size=9)
        if place:
            d.arrow([(26, y + 8.6), (26, y + 7)])
    return d.figure


def wiring() -> Figure:
    """Returns the cables of a rig."""
    d = Diagram(96, 32)
    d.box(1, 12, 13, 8, "Computer", GRAY)
    d.box(30, 23, 14, 7, "U2D2", BLUE)
    d.box(30, 12, 14, 7, "OAK or webcam", BLUE)
    d.box(30, 1, 14, 7, "Microcontroller", BLUE)
    d.box(58, 23, 14, 7, "Power hub", ORANGE)
    d.box(58, 12, 14, 7, "Supply, 12 V", ORANGE)
    d.box(58, 1, 12, 7, "HX711", BLUE)
    d.box(83, 23, 12, 7, "XM430", ORANGE)
    d.box(83, 1, 12, 7, "Load cell", GREEN)
    d.arrow([(7.5, 20), (7.5, 26.5), (30, 26.5)], "USB", (19, 27.8))
    d.arrow([(14, 15.5), (30, 15.5)], "USB 3")
    d.arrow([(7.5, 12), (7.5, 4.5), (30, 4.5)], "USB", (19, 5.8))
    d.arrow([(44, 26.5), (58, 26.5)], "data")
    d.arrow([(65, 19), (65, 23)])
    d.arrow([(72, 26.5), (83, 26.5)], "TTL or RS-485")
    d.arrow([(44, 4.5), (58, 4.5)], "DOUT, SCK")
    d.arrow([(70, 4.5), (83, 4.5)], "E+ E- A+ A-")
    return d.figure


def fusion() -> Figure:
    """Returns the forces of a simulated grasp: motor current, vision, their fusion, and the load cell."""
    from gripper_force.config import load_config
    from gripper_force.jobs.grasp import run_grasp
    from gripper_force.runtime.log_reader import LogReader
    from gripper_force.types import FusedForce, LoadCellSample, VisualForce

    overrides = ["object=paper_cup", "target_n=6", "seed=29", "control.hold_s=1.5"]
    with TemporaryDirectory() as folder:
        log = Path(folder) / "grasp.mcap"
        run_grasp(load_config(None, overrides), log)
        reader = LogReader(log)
        fused = np.array(
            [(r.t_ns, r.force_n, r.std_n, r.current_n, r.bias_n) for r in reader.records(FusedForce)]
        )
        seen = np.array([(r.ready_ns, r.force_n) for r in reader.records(VisualForce)])
        cell = np.array([(r.t_ns, r.force_n) for r in reader.records(LoadCellSample) if r.valid])
    begin_ns = cell[np.argmax(cell[:, 1] > 0.1), 0]
    t, seen_t, cell_t = (1e-9 * (table[:, 0] - begin_ns) for table in (fused, seen, cell))
    figure = Figure(figsize=(9.6, 5.2), layout="constrained")
    forces, bias = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    half_n = 1.645 * fused[:, 2]
    forces.fill_between(t, fused[:, 1] - half_n, fused[:, 1] + half_n, color=FUSED, alpha=0.12, lw=0)
    forces.plot(cell_t, cell[:, 1], color=CELL, lw=2.2, label="load cell")
    forces.plot(t, fused[:, 3], color=CURRENT, lw=1.2, label="motor current alone")
    forces.plot(seen_t, seen[:, 1], ".", ms=4, color=VISION, label="vision, when it is ready")
    forces.plot(t, fused[:, 1], color=FUSED, lw=1.4, label="fused, with its 90 % interval")
    forces.set_xlim(-0.1, 2.2)
    forces.set_ylim(0, 7.2)
    forces.set_ylabel("force, N")
    forces.legend(frameon=False, loc="lower right")
    bias.axhline(0, color="#8a9099", lw=0.8)
    bias.plot(t, fused[:, 4], color=FUSED, lw=1.4)
    bias.set_ylim(-0.2, 0.6)
    bias.set_ylabel("correction\nof the current, N")
    bias.set_xlabel("time since contact, s")
    for axes in (forces, bias):
        axes.spines[["top", "right"]].set_visible(False)
    return figure


def terminal(file: Path) -> None:
    """Writes what `gripper-force grasp` prints in a terminal, as SVG."""
    from rich.console import Console
    from rich.text import Text

    command = [sys.executable, "-m", "gripper_force", "grasp"]
    env = {**os.environ, "FORCE_COLOR": "1", "COLUMNS": "90"}
    with TemporaryDirectory() as folder:
        done = subprocess.run(
            command,
            cwd=folder,
            env=env,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=True,
        )
    shown = Console(record=True, width=90, file=StringIO(), force_terminal=True)
    shown.print("[bold]$ gripper-force grasp[/]")
    shown.print(Text.from_ansi(done.stdout.rstrip()))
    shown.save_svg(str(file), title="gripper-force", unique_id="terminal")


FIGURES: Final[dict[str, Callable[[], Figure]]] = {
    "loop": loop,
    "fusion": fusion,
    "calibration": calibration,
    "safety": safety,
    "wiring": wiring,
}


def main() -> None:
    """Draws all figures, or those that are named."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", choices=[*FIGURES, "terminal"], action="append")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    mpl.rcParams["svg.hashsalt"] = "gripper-force"  # the same file each time
    for name in options.only or [*FIGURES, "terminal"]:
        file = options.folder / f"{name}.svg"
        if name == "terminal":
            terminal(file.absolute())
        else:
            FIGURES[name]().savefig(file, metadata={"Date": None})
        print(file)


if __name__ == "__main__":
    main()
