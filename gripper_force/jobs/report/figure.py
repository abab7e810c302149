"""A run as one picture, for a document or a terminal that shows images."""

from typing import Any, Final

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from gripper_force.jobs.report.data import SOURCES, Floats, Run, bins
from gripper_force.jobs.report.pictures import Picture

STYLE: Final[dict[Any, Any]] = {
    "font.size": 9.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#8a9099",
    "axes.grid": True,
    "grid.color": "#e3e6ea",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "axes.titlesize": 10.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "xtick.color": "#59606a",
    "ytick.color": "#59606a",
    "figure.dpi": 150.0,
    "legend.frameon": False,
}
_BANDS: Final = ("#eef1f5", "#f8f9fb")


def draw(run: Run, pictures: list[Picture]) -> Figure:
    """Force, error, latency and frames, one above the other; what the log lacks is left out."""
    heights_in = {
        "curves": 4.9 if run.errors else 3.2,
        "latency": 1.6 if len(run.latency_ms) else 0.0,
        "frames": 1.9 if pictures else 0.0,
    }
    heights_in = {name: height for name, height in heights_in.items() if height}
    with rc_context(STYLE):
        figure = Figure(figsize=(10, 0.5 + sum(heights_in.values())), layout="constrained")
        figure.suptitle(run.title, x=0.008, ha="left", fontsize=13, fontweight="bold")
        parts = figure.subfigures(len(heights_in), height_ratios=list(heights_in.values()), squeeze=False)
        for name, part in zip(heights_in, parts[:, 0], strict=True):
            if name == "curves":
                _curves(part, run)
            elif name == "latency":
                left, right = part.subplots(1, 2)
                _histogram(left, run.compute_ms, "estimator, ms per frame", SOURCES["vision"].light)
                _histogram(right, run.camera_age_ms, "age of a frame on arrival, ms", "#8a9099")
            else:
                for axes, picture in zip(part.subplots(1, len(pictures)), pictures, strict=True):
                    _frame(axes, picture)
    return figure


def _curves(part: SubFigure, run: Run) -> None:
    if run.errors:
        force, error = part.subplots(2, sharex=True, height_ratios=(2, 1))
        _error(error, run)
    else:
        force = error = part.subplots()
    _force(force, run)
    error.set_xlabel("time, s")
    part.align_ylabels()


def _bands(axes: Axes, run: Run, *, named: bool) -> None:
    width_s = max(run.end_s - run.begin_s, 1e-9)
    for i, span in enumerate(run.phases):
        axes.axvspan(span.start_s, span.end_s, color=_BANDS[i % 2], lw=0, zorder=0)
        if named and (span.end_s - span.start_s) / width_s > 0.045:
            axes.text(
                (span.start_s + span.end_s) / 2,
                0.985,
                span.phase,
                transform=axes.get_xaxis_transform(),
                ha="center",
                va="top",
                color="#59606a",
                fontsize=8,
            )
    axes.set_xlim(run.begin_s, run.end_s)


def _force(axes: Axes, run: Run) -> None:
    _bands(axes, run, named=True)
    for source, style in SOURCES.items():
        if source in run.forces:
            series = run.forces[source]
            width = 1.8 if source == "load_cell" else 1.1
            axes.plot(series.t_s, series.value_n, color=style.light, lw=width, label=style.label)
    if len(run.reference.t_s):
        axes.plot(run.reference.t_s, run.reference.value_n, color="#8a9099", lw=1.2, ls="--", label="target")
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.08 * (high - low))
    axes.set_ylabel("grip force, N")
    axes.set_title("Force")
    if axes.get_lines():
        axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=5, borderaxespad=0.2)


def _error(axes: Axes, run: Run) -> None:
    _bands(axes, run, named=False)
    axes.axhline(0, color="#8a9099", lw=0.8)
    for source, series in run.errors.items():
        axes.plot(series.t_s, series.value_n, color=SOURCES[source].light, lw=1.0)
    axes.set_title("Error against the load cell")
    axes.set_ylabel("error, N")


def _histogram(axes: Axes, values_ms: Floats, name: str, colour: str) -> None:
    counts, edges = bins(values_ms)
    axes.stairs(counts, edges, fill=True, color=colour)
    p50, p99 = np.percentile(values_ms, [50, 99])
    axes.set_title(f"p50 {p50:.1f} ms, p99 {p99:.1f} ms", fontweight="normal", fontsize=9)
    axes.set_xlabel(name)
    axes.set_ylabel("frames")
    axes.set_xlim(edges[0], edges[-1])


def _frame(axes: Axes, picture: Picture) -> None:
    axes.imshow(picture.image)
    axes.set_axis_off()
    axes.set_title(picture.caption, fontsize=8, fontweight="normal", loc="center")
