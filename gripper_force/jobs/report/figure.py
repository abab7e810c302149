"""The figure of a report: force, error, latency and frames."""

import re
from dataclasses import dataclass
from io import StringIO
from typing import Any, Final

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure, SubFigure
from matplotlib.transforms import Bbox

from gripper_force.control.force_loop import tolerance_n
from gripper_force.jobs.report.pictures import ATTENTION_MAP, Picture
from gripper_force.jobs.report.run import SOURCES, Floats, Run, Series
from gripper_force.runtime.log_codecs import INTERVAL_STD
from gripper_force.types import Phase

_SOFT: Final = "#59606a"
_LINE: Final = "#8a9099"
_GRID: Final = "#e3e6ea"
_BANDS: Final = ("#eef1f5", "#f8f9fb")
_LOST: Final = "#b3261e"
WIDTH_COLOURS: Final = {"light": "#7a5195", "dark": "#b794d6"}

STYLE: Final[dict[Any, Any]] = {
    "font.size": 9.0,
    "text.parse_math": False,  # an object's name may have two dollar signs
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
    _LOST: "var(--bad)",
    WIDTH_COLOURS["light"]: "var(--width)",
}
"""Colours of the figure as variables of the page's style sheet, which change in dark mode."""

_WIDTH_IN: Final = 10.0
_TITLE_IN: Final = 0.3
"""Height of the title, which a page with its own heading leaves out."""
_LINE_IN: Final = 0.18
"""Height of a line of text below the charts."""

_MAX_POINTS: Final = 2000
"""Points drawn per curve; more cannot be seen."""

_GAP_S: Final = 0.1
_GAP_PERIODS: Final = 4.0
"""Points further apart than both, the second in median periods, are not connected."""

_CAUSE_CHARACTERS: Final = 60
_NAMED_LOSSES: Final = 2
"""Longest text, and number, of the reasons written into the chart. All are below it."""

_SVG_TAG: Final = re.compile(r".*?<svg [^>]*>", re.DOTALL)
_FONT_FAMILY: Final = re.compile(r"font-family: [^;\"]*;? ?")
"""Left out, so that the page's font is used."""

_SVG_NAMES: Final = "report"
"""Salt of the names inside an SVG: the same log gives the same text."""

_CLIP_NAME: Final = re.compile(r'<clipPath id="(\w+)"')
"""Names of clip paths, which contain the last bits of the layout and are not the same each time."""


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
    """Draws forces, error, motor, latency and frames, one above the other, without those that the log lacks."""
    times = {
        "Estimator, per frame": (run.compute_ms, SOURCES["vision"].light),
        "Age of a frame on arrival": (run.camera_age_ms, _LINE),
    }
    times = {name: entry for name, entry in times.items() if len(entry[0])}
    with_attention = any(picture.overlay is not None for picture in pictures)
    heights_in = {
        "curves": 3.2 + (1.7 if run.errors else 0.0) + (1.6 if run.motor else 0.0),
        "latency": 1.6 if times else 0.0,
        "frames": (3.0 if with_attention else 1.9) if pictures else 0.0,
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
                row = part.subplots(1, 2, squeeze=False)[0]
                for axes in row[len(times) :]:
                    axes.set_axis_off()
                for axes, (title, (values_ms, colour)) in zip(row, times.items(), strict=False):
                    _histogram(axes, values_ms, title, colour)
            else:
                _frames(part, pictures, with_attention=with_attention)
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
    for i, name in enumerate(_CLIP_NAME.findall(text)):
        text = text.replace(name, f"clip{i}")
    for colour, variable in CSS_COLOURS.items():
        text = text.replace(colour, variable)
    return Svg(text, charts)


def thin(series: Series) -> Series:
    """Returns the series with as many points as can be seen."""
    if len(series.t_s) <= _MAX_POINTS:
        return series
    keep = np.linspace(0, len(series.t_s) - 1, _MAX_POINTS).astype(int)
    return Series(series.t_s[keep], series.value[keep])


def with_gaps(series: Series) -> Series:
    """Returns the series with a NaN in each gap, so that no line is drawn across it."""
    if len(series.t_s) < 3:
        return series
    steps_s = np.diff(series.t_s)
    after = np.flatnonzero(steps_s > max(_GAP_S, _GAP_PERIODS * float(np.median(steps_s)))) + 1
    between_s = (series.t_s[after - 1] + series.t_s[after]) / 2
    return Series(np.insert(series.t_s, after, between_s), np.insert(series.value, after, np.nan))


def _vision_lines(run: Run) -> list[str]:
    if run.vision is None:
        return []
    losses = [f"vision lost {loss}" for loss in run.vision.losses]
    return [f"vision used in {100 * run.vision.share:.0f} % of the hold", *losses]


def _curves(part: SubFigure, run: Run) -> None:
    heights = [3.0] + ([1.5] if run.errors else []) + ([1.3] if run.motor else [])
    rows = list(part.subplots(len(heights), sharex=True, height_ratios=heights, squeeze=False)[:, 0])
    _force(rows[0], run)
    if run.errors:
        _error(rows[1], run)
    if run.motor:
        _motor(rows[-1], run)
    rows[-1].set_xlabel("time, s")
    part.align_ylabels(rows)


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
    _estimate_bands(axes, run)
    spare = 0.22 if run.losses else 0.08
    axes.set_ylim(low, high + spare * (high - low))  # whatever an uncertain estimate's band is
    axes.set_ylabel("grip force, N")
    axes.set_title("Force")
    axes.set_gid("forces")
    _losses(axes, run)
    if axes.get_lines():
        axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=7, borderaxespad=0.2, fontsize=8)


def _estimate_bands(axes: Axes, run: Run) -> None:
    """Draws the claimed 90 % interval of the fused estimate, and the tolerance about the target."""
    if "fused" in run.forces:
        force, std_n = thin(run.forces["fused"]), thin(run.std_n)
        half_n = INTERVAL_STD * np.interp(force.t_s, std_n.t_s, std_n.value)
        axes.fill_between(
            force.t_s,
            force.value - half_n,
            force.value + half_n,
            color=SOURCES["fused"].light,
            alpha=0.16,
            lw=0,
            label="90 % interval",
        )
    holds = [span for span in run.phases if span.phase == Phase.HOLD]
    for i, span in enumerate(holds):
        inside = (run.reference.t_s >= span.start_s) & (run.reference.t_s < span.end_s)
        if not inside.any():
            continue
        target_n = float(np.median(run.reference.value[inside]))
        band_n = tolerance_n(target_n)
        axes.fill_between(
            [span.start_s, span.end_s],
            target_n - band_n,
            target_n + band_n,
            color=_LINE,
            alpha=0.3,
            lw=0,
            label="tolerance" if i == 0 else None,
        )


def _losses(axes: Axes, run: Run) -> None:
    """Marks the times without vision at the top of the chart, and writes the reasons of the longest."""
    named = sorted(run.losses, key=lambda loss: loss.start_s - loss.end_s)[:_NAMED_LOSSES]
    for loss in run.losses:
        axes.axvspan(loss.start_s, loss.end_s, ymin=0.9, ymax=0.925, color=_LOST, lw=0)
    for i, loss in enumerate(named):
        reason = loss.reason
        if len(reason) > _CAUSE_CHARACTERS:
            reason = reason[: _CAUSE_CHARACTERS - 1].rsplit(" ", 1)[0] + " …"
        on_left = loss.start_s < (run.begin_s + run.end_s) / 2
        axes.text(
            loss.start_s if on_left else loss.end_s,
            0.885 - 0.06 * i,
            f"vision lost for {loss.end_s - loss.start_s:.1f} s: {reason}",
            transform=axes.get_xaxis_transform(),
            ha="left" if on_left else "right",
            va="top",
            color=_LOST,
            fontsize=8,
        )


def _motor(axes: Axes, run: Run) -> None:
    """Draws the motor current on the left scale, and the width on the right; the title states the temperature."""
    _bands(axes, run, named=False)
    if "goal_a" in run.motor:
        _curve(axes, run.motor["goal_a"], color=_LINE, lw=1.0, ls="--", label="goal current")
    if "current_a" in run.motor:
        _curve(axes, run.motor["current_a"], color=SOURCES["current"].light, lw=1.0, label="motor current")
    axes.set_ylabel("current, A")
    axes.set_ylim(0)
    title = "Motor"
    if "temperature_c" in run.motor:
        values_c = run.motor["temperature_c"].value
        low_c, high_c = f"{values_c.min():.0f}", f"{values_c.max():.0f}"
        title += f", {low_c} °C" if low_c == high_c else f", {low_c} to {high_c} °C"
    axes.set_title(title)
    lines, labels = axes.get_legend_handles_labels()
    if "width_mm" in run.motor:
        right = axes.twinx()
        right.grid(visible=False)
        right.spines["right"].set_visible(True)
        _curve(right, run.motor["width_mm"], color=WIDTH_COLOURS["light"], lw=1.0, label="width")
        right.set_ylabel("width, mm")
        right.set_ylim(0)
        more_lines, more_labels = right.get_legend_handles_labels()
        lines, labels = lines + more_lines, labels + more_labels
    if lines:
        axes.legend(
            lines, labels, loc="lower right", bbox_to_anchor=(1, 1), ncols=3, borderaxespad=0.2, fontsize=8
        )


def _error(axes: Axes, run: Run) -> None:
    _bands(axes, run, named=False)
    axes.axhline(0, color=_LINE, lw=0.8)
    for source, series in run.errors.items():
        _curve(axes, series, color=SOURCES[source].light, lw=1.0)
    axes.set_title("Error against the load cell")
    axes.set_ylabel("error, N")
    axes.set_gid("errors")


def _curve(axes: Axes, series: Series, **style: Any) -> None:
    drawn = with_gaps(thin(series))
    axes.plot(drawn.t_s, drawn.value, **style)


def histogram(values: Floats) -> tuple[Floats, Floats]:
    """Histogram up to just above the 99.5th percentile; the last bin also counts all larger values.

    Returns:
        Counts, (30,), and edges, (31,).
    """
    top = max(float(np.percentile(values, 99.5)) * 1.15, 1e-3)
    counts, edges = np.histogram(np.clip(values, 0, top), bins=30, range=(0, top))
    return counts.astype(np.float64), edges


def _histogram(axes: Axes, values_ms: Floats, name: str, colour: str) -> None:
    counts, edges = histogram(values_ms)
    axes.stairs(counts, edges, fill=True, color=colour)
    p50, p99 = np.percentile(values_ms, [50, 99])
    figures = f"p50 {p50:.1f}, p99 {p99:.1f}, largest {values_ms.max():.1f} ms"
    axes.set_title(f"{name}: {figures}", fontweight="normal", fontsize=9)
    axes.set_xlabel("ms")
    axes.set_ylabel("frames")
    axes.set_xlim(edges[0], edges[-1])


def _frames(part: SubFigure, pictures: list[Picture], *, with_attention: bool) -> None:
    """Draws the frames, and below them the same with the network's attention and its colour bar."""
    rows = part.subplots(2 if with_attention else 1, len(pictures), squeeze=False)
    for axes, picture in zip(rows[0], pictures, strict=True):
        axes.imshow(picture.image)
        axes.set_axis_off()
        axes.set_title(picture.caption, fontsize=8, fontweight="normal", loc="center")
    if not with_attention:
        return
    for axes, picture in zip(rows[1], pictures, strict=True):
        axes.set_axis_off()
        axes.imshow(picture.image if picture.overlay is None else picture.overlay)
    scale = ScalarMappable(Normalize(0, 1), ATTENTION_MAP)
    bar = part.colorbar(scale, ax=list(rows.ravel()), fraction=0.012, pad=0.01, ticks=[0, 1])
    bar.set_label("attention, least to most", fontsize=8)
