"""The figure of a report: force, error, latency and frames."""

import re
from dataclasses import dataclass
from io import StringIO
from typing import Any, Final

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.transforms import Bbox

from gripper_force.jobs.report.data import SOURCES, Floats, Run, Series, histogram
from gripper_force.jobs.report.pictures import Picture

_SOFT: Final = "#59606a"
_LINE: Final = "#8a9099"
_GRID: Final = "#e3e6ea"
_BANDS: Final = ("#eef1f5", "#f8f9fb")

STYLE: Final[dict[Any, Any]] = {
    "font.size": 9.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": _LINE,
    "axes.grid": True,
    "grid.color": _GRID,
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "axes.titlesize": 10.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "xtick.color": _SOFT,
    "ytick.color": _SOFT,
    "figure.dpi": 150.0,
    "legend.frameon": False,
}

CSS_COLOURS: Final = {
    **{style.light: f"var(--{source})" for source, style in SOURCES.items()},
    _SOFT: "var(--soft)",
    _LINE: "var(--axis)",
    _GRID: "var(--line)",
    _BANDS[0]: "var(--band0)",
    _BANDS[1]: "var(--band1)",
}
"""Colours of the figure as variables of the page's style sheet, which change in dark mode."""

_WIDTH_IN: Final = 10.0
_TITLE_IN: Final = 0.3
"""Height of the title, which a page with its own heading leaves out."""
_LINE_IN: Final = 0.18
"""Height of a line of text below the charts."""

_MAX_POINTS: Final = 2000
"""Points drawn per curve; more cannot be seen."""

_SVG_TAG: Final = re.compile(r".*?<svg [^>]*>", re.DOTALL)
_FONT_FAMILY: Final = re.compile(r"font-family: [^;\"]*;? ?")
"""Left out, so that the page's font is used."""

_SVG_NAMES: Final = "report"
"""Salt of the names inside an SVG: the same log gives the same text."""


@dataclass(frozen=True, slots=True)
class Chart:
    """Place of a chart with a time axis inside the SVG, in percent of its width and height."""

    left: float
    top: float
    width: float
    height: float


@dataclass(frozen=True, slots=True)
class Svg:
    """A figure without its title, for a page.

    Attributes:
        text: The ``<svg>`` element. Its colours are `CSS_COLOURS`.
        charts: Places of the charts ``forces`` and ``errors``, as far as they are drawn.
    """

    text: str
    charts: dict[str, Chart]


def draw(run: Run, pictures: list[Picture]) -> Figure:
    """Draws force, error, latency and frames, one above the other, without those that the log lacks."""
    heights_in = {
        "curves": 4.9 if run.errors else 3.2,
        "latency": 1.6 if len(run.latency_ms) and len(run.camera_age_ms) else 0.0,
        "frames": 1.9 if pictures else 0.0,
    }
    heights_in = {name: height for name, height in heights_in.items() if height}
    with rc_context(STYLE):
        lines = _vision_lines(run)
        height_in = 0.5 + _LINE_IN * len(lines) + sum(heights_in.values())
        figure = Figure(figsize=(_WIDTH_IN, height_in), layout="constrained")
        figure.suptitle(run.title, x=0.008, ha="left", fontsize=13, fontweight="bold")
        parts = figure.subfigures(len(heights_in), height_ratios=list(heights_in.values()), squeeze=False)
        for name, part in zip(heights_in, parts[:, 0], strict=True):
            if name == "curves":
                _curves(part, run)
            elif name == "latency":
                left, right = part.subplots(1, 2)
                _histogram(left, run.compute_ms, "Estimator, per frame", SOURCES["vision"].light)
                _histogram(right, run.camera_age_ms, "Age of a frame on arrival", _LINE)
            else:
                for axes, picture in zip(part.subplots(1, len(pictures)), pictures, strict=True):
                    _frame(axes, picture)
        figure.supxlabel("\n".join(lines), x=0.008, ha="left", fontsize=9, color=_SOFT)
    return figure


def to_svg(figure: Figure) -> Svg:
    """Writes a figure of `draw` as an SVG element for a page."""
    width_in, height_in = _WIDTH_IN, figure.get_figheight() - _TITLE_IN
    file = StringIO()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": _SVG_NAMES}):
        figure.savefig(
            file,
            format="svg",
            transparent=True,
            bbox_inches=Bbox.from_bounds(0, 0, width_in, height_in),
            metadata=dict.fromkeys(("Creator", "Date", "Format", "Type")),
        )
    charts = {}
    for axes in figure.axes:
        if name := axes.get_gid():
            box = axes.get_window_extent().transformed(figure.dpi_scale_trans.inverted())  # inches
            charts[name] = Chart(
                left=float(100 * box.x0 / width_in),
                top=float(100 * (1 - box.y1 / height_in)),
                width=float(100 * box.width / width_in),
                height=float(100 * box.height / height_in),
            )
    text = _SVG_TAG.sub(f'<svg viewBox="0 0 {72 * width_in:g} {72 * height_in:g}">', file.getvalue(), count=1)
    text = _FONT_FAMILY.sub("", text)
    for colour, variable in CSS_COLOURS.items():
        text = text.replace(colour, variable)
    return Svg(text, charts)


def thin(series: Series) -> Series:
    """Returns the series with as many points as can be seen."""
    if len(series.t_s) <= _MAX_POINTS:
        return series
    keep = np.linspace(0, len(series.t_s) - 1, _MAX_POINTS).astype(int)
    return Series(series.t_s[keep], series.value_n[keep])


def _vision_lines(run: Run) -> list[str]:
    if run.vision is None:
        return []
    losses = [f"vision lost for {loss.time_s:.1f} s: {loss.reason}" for loss in run.vision.losses]
    return [f"vision used in {100 * run.vision.share:.0f} % of the hold", *losses]


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
                color=_SOFT,
                fontsize=8,
            )
    axes.set_xlim(run.begin_s, run.end_s)


def _force(axes: Axes, run: Run) -> None:
    _bands(axes, run, named=True)
    for source, style in SOURCES.items():
        if source in run.forces:
            width = 1.8 if source == "load_cell" else 1.1
            _curve(axes, run.forces[source], color=style.light, lw=width, label=style.label)
    if len(run.reference.t_s):
        _curve(axes, run.reference, color=_LINE, lw=1.2, ls="--", label="target")
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.08 * (high - low))
    axes.set_ylabel("grip force, N")
    axes.set_title("Force")
    axes.set_gid("forces")
    if axes.get_lines():
        axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=5, borderaxespad=0.2)


def _error(axes: Axes, run: Run) -> None:
    _bands(axes, run, named=False)
    axes.axhline(0, color=_LINE, lw=0.8)
    for source, series in run.errors.items():
        _curve(axes, series, color=SOURCES[source].light, lw=1.0)
    axes.set_title("Error against the load cell")
    axes.set_ylabel("error, N")
    axes.set_gid("errors")


def _curve(axes: Axes, series: Series, **style: Any) -> None:
    drawn = thin(series)
    axes.plot(drawn.t_s, drawn.value_n, **style)


def _histogram(axes: Axes, values_ms: Floats, name: str, colour: str) -> None:
    counts, edges = histogram(values_ms)
    axes.stairs(counts, edges, fill=True, color=colour)
    p50, p99 = np.percentile(values_ms, [50, 99])
    figures = f"p50 {p50:.1f}, p99 {p99:.1f}, largest {values_ms.max():.1f} ms"
    axes.set_title(f"{name}: {figures}", fontweight="normal", fontsize=9)
    axes.set_xlabel("ms")
    axes.set_ylabel("frames")
    axes.set_xlim(edges[0], edges[-1])


def _frame(axes: Axes, picture: Picture) -> None:
    axes.imshow(picture.image)
    axes.set_axis_off()
    axes.set_title(picture.caption, fontsize=8, fontweight="normal", loc="center")
