"""A run as one HTML page that holds all it needs."""

import base64
import json
from collections.abc import Iterable
from dataclasses import dataclass
from html import escape
from io import BytesIO
from pathlib import Path
from string import Template
from typing import Final

import matplotlib.image
import numpy as np
from matplotlib.ticker import MaxNLocator

from gripper_force.jobs.report.data import SOURCES, Floats, Run, Series, bins
from gripper_force.jobs.report.pictures import Picture

_POINTS: Final = 2000
"""Points a curve is drawn with at most; more can't be seen."""
_LINES: Final = 300


@dataclass(frozen=True, slots=True)
class _Axes:
    """The ranges of a chart; a point's place in percent of its box."""

    x: tuple[float, float]
    y: tuple[float, float]

    def left(self, x: float) -> float:
        return 100 * (x - self.x[0]) / (self.x[1] - self.x[0])

    def top(self, y: float) -> float:
        return 100 * (self.y[1] - y) / (self.y[1] - self.y[0])


def render(run: Run, pictures: list[Picture], note: str) -> str:
    """The page as text.

    Args:
        run: What was logged.
        pictures: Frames over the grasp.
        note: What is laid over them.
    """
    template = Template(Path(__file__).with_name("page.html").read_text(encoding="utf-8"))
    sections = [_force(run), _error(run), _latency(run), _frames(pictures, note), _events(run)]
    return template.substitute(
        title=escape(run.title),
        name=escape(run.name),
        light=_palette("light"),
        dark=_palette("dark"),
        headline=_headline(run),
        sections="\n".join(section for section in sections if section),
        facts=_facts(run),
        config=escape(run.config_text),
        series=_series_json(run),
    )


def _palette(ground: str) -> str:
    return "".join(f"--{source}:{getattr(style, ground)};" for source, style in SOURCES.items())


def _headline(run: Run) -> str:
    badge = f'<span class="badge {escape(run.outcome)}">{escape(run.outcome.replace("_", " "))}</span>'
    heading = f"<h1>{escape(run.object)} {badge if run.outcome else ''}</h1>"
    shown = "".join(
        f'<div class="card"><div class="what">{what}</div>'
        f'<div class="value">{value}<small> {unit}</small></div></div>'
        for what, value, unit in _cards(run)
    )
    return f'{heading}<div class="cards">{shown}</div>'


def _cards(run: Run) -> list[tuple[str, str, str]]:
    """Name, value and unit of each figure of the headline."""
    cards = [] if run.target_n is None else [("Target", f"{run.target_n:g}", "N")]
    if run.score is not None:
        settle = f"{run.score.settle_s:.2f}" if np.isfinite(run.score.settle_s) else "never"
        cards += [
            ("Load cell, steady", f"{run.score.steady_n:.2f}", "N"),
            ("Error, steady", f"{run.score.steady_error_n:+.2f}", "N"),
            ("Overshoot", f"{run.score.overshoot_n:.2f}", "N"),
            ("Settling time", settle, "s" if settle != "never" else ""),
        ]
    for source in ("fused", "vision"):
        if source in run.errors:
            mean_n = np.abs(run.errors[source].value_n).mean()
            cards.append((f"Mean error, {SOURCES[source].label}", f"{mean_n:.2f}", "N"))
    if len(run.latency_ms):
        p50, p99 = np.percentile(run.latency_ms, [50, 99])
        cards.append(("Latency p50 / p99", f"{p50:.1f} / {p99:.1f}", "ms"))
    return cards


def _force(run: Run) -> str:
    curves = dict(run.forces)
    if not curves:
        return ""
    values = np.concatenate([series.value_n for series in [*curves.values(), run.reference]])
    axes = _axes(run, values, headroom=0.1)
    drawn = [_path("target", run.reference, axes)] if len(run.reference.t_s) else []
    drawn += [_path(source, curves[source], axes) for source in SOURCES if source in curves]
    legend = [(source, SOURCES[source].label) for source in SOURCES if source in curves]
    legend += [("target", "target")] if len(run.reference.t_s) else []
    bands = _bands(run, axes, named=True)
    chart = _chart(axes, "".join(drawn), "tall", "grip force, N", bands=bands, data="forces")
    return f"<section><h2>Force</h2>{_legend(legend)}{chart}</section>"


def _error(run: Run) -> str:
    if not run.errors:
        return ""
    values = np.concatenate([series.value_n for series in run.errors.values()])
    axes = _axes(run, np.append(values, 0.0))
    zero = f'<path class="zero" d="M0 {axes.top(0):.2f}H100"/>'
    curves = "".join(_path(source, series, axes) for source, series in run.errors.items())
    bands = _bands(run, axes, named=False)
    chart = _chart(axes, zero + curves, "short", "error, N", bands=bands, data="errors")
    legend = _legend([(source, SOURCES[source].label) for source in run.errors])
    return f"<section><h2>Error against the load cell</h2>{legend}{chart}</section>"


def _latency(run: Run) -> str:
    rows = [
        ("Estimator, per frame", run.compute_ms, "vision"),
        ("Frame's age on arrival", run.camera_age_ms, "plain"),
    ]
    shown = "".join(_histogram(name, values, style) for name, values, style in rows if len(values))
    if not shown or not len(run.latency_ms):
        return ""
    return f'<section><h2>Latency</h2><div class="pair">{shown}</div></section>'


def _histogram(name: str, values_ms: Floats, style: str) -> str:
    counts, edges = bins(values_ms)
    axes = _Axes((0.0, float(edges[-1])), (0.0, 1.05 * float(counts.max())))
    bars = "".join(
        f'<rect class="bar {style}" x="{axes.left(left):.2f}" width="{95 / len(counts):.2f}" '
        f'y="{axes.top(count):.2f}" height="{100 - axes.top(count):.2f}"/>'
        for left, count in zip(edges, counts, strict=False)
    )
    p50, p99 = np.percentile(values_ms, [50, 99])
    figures = f"p50 {p50:.1f} · p99 {p99:.1f} · largest {values_ms.max():.1f} ms"
    chart = _chart(axes, bars, "small", "frames", x_name="ms")
    return f"<figure><figcaption><b>{name}</b> {figures}</figcaption>{chart}</figure>"


def _frames(pictures: list[Picture], note: str) -> str:
    if not pictures:
        return ""
    shown = "".join(
        f'<figure><img alt="camera frame" src="data:image/png;base64,{_png(picture)}">'
        f"<figcaption>{escape(picture.caption)}</figcaption></figure>"
        for picture in pictures
    )
    text = f'<p class="note">{escape(note)}</p>' if note else ""
    return f'<section><h2>Frames</h2><div class="frames">{shown}</div>{text}</section>'


def _events(run: Run) -> str:
    if not run.event_rows:
        return ""
    rows = "".join(
        f"<tr><td>{line.t_s:.3f}</td><td>{escape(line.unit)}</td><td>{escape(line.text)}</td></tr>"
        for line in run.event_rows[:_LINES]
    )
    more = len(run.event_rows) - _LINES
    rest = f'<p class="note">{more} more are in the log.</p>' if more > 0 else ""
    head = "<thead><tr><th>s</th><th>unit</th><th>what</th></tr></thead>"
    return f"<section><h2>Phases and events</h2><table>{head}<tbody>{rows}</tbody></table>{rest}</section>"


def _facts(run: Run) -> str:
    rows = "".join(
        f"<tr><td>{escape(key)}</td><td>{escape(value)}</td></tr>" for key, value in run.metadata.items()
    )
    return f"<details><summary>Versions and facts</summary><table>{rows}</table></details>" if rows else ""


def _axes(run: Run, values: Floats, headroom: float = 0.0) -> _Axes:
    low, high = min(float(values.min()), 0.0), float(values.max())
    span = max(high - low, 0.1)
    return _Axes((run.begin_s, run.end_s), (low - 0.04 * span, high + (0.04 + headroom) * span))


def _chart(
    axes: _Axes, drawn: str, size: str, y_name: str, *, x_name: str = "s", bands: str = "", data: str = ""
) -> str:
    """A box of 100 by 100 that stretches to its place; words are HTML over it, so they keep their size."""
    y_ticks, x_ticks = _ticks(axes.y, 6), _ticks(axes.x, 8)
    grid = "".join(f"M0 {axes.top(y):.2f}H100" for y in y_ticks)
    words = "".join(f'<i class="y" style="top:{axes.top(y):.2f}%">{y:g}</i>' for y in y_ticks)
    words += "".join(f'<i class="x" style="left:{axes.left(x):.2f}%">{x:g}</i>' for x in x_ticks)
    words += f'<i class="yname">{y_name}</i><i class="xname">{x_name}</i>'
    limits = f'data-from="{axes.x[0]:.6g}" data-to="{axes.x[1]:.6g}"'
    return (
        f'<div class="chart {size}" data-series="{data}" {limits}>{bands}'
        '<svg viewBox="0 0 100 100" preserveAspectRatio="none" aria-hidden="true">'
        f'<path class="grid" d="{grid}"/>{drawn}</svg>{words}</div>'
    )


def _ticks(limits: tuple[float, float], count: int) -> list[float]:
    inside = (
        tick
        for tick in MaxNLocator(count, steps=[1, 2, 5, 10]).tick_values(*limits)
        if limits[0] <= tick <= limits[1]
    )
    return [round(float(tick), 9) for tick in inside]


def _bands(run: Run, axes: _Axes, *, named: bool) -> str:
    bands = ""
    for i, span in enumerate(run.phases):
        left, width = axes.left(span.start_s), axes.left(span.end_s) - axes.left(span.start_s)
        name = f"<span>{span.phase}</span>" if named else ""
        bands += f'<b class="band{i % 2}" style="left:{left:.2f}%;width:{width:.2f}%">{name}</b>'
    return bands


def _path(style: str, series: Series, axes: _Axes) -> str:
    thin = _thin(series)
    points = zip(thin.t_s, thin.value_n, strict=True)
    d = "L".join(f"{axes.left(t):.3f} {axes.top(v):.2f}" for t, v in points)
    return f'<path class="curve {style}" d="M{d}"/>'


def _thin(series: Series) -> Series:
    if len(series.t_s) <= _POINTS:
        return series
    keep = np.linspace(0, len(series.t_s) - 1, _POINTS).astype(int)
    return Series(series.t_s[keep], series.value_n[keep])


def _legend(entries: Iterable[tuple[str, str]]) -> str:
    return (
        '<div class="legend">'
        + "".join(f'<span class="{s}">{label}</span>' for s, label in entries)
        + "</div>"
    )


def _series_json(run: Run) -> str:
    """What the page's script reads out under the pointer: name, colour, times in ms and values in mN."""
    groups = {"forces": run.forces, "errors": run.errors}
    tree = {
        group: [
            {
                "label": SOURCES[source].label,
                "source": source,
                "t": (1000 * _thin(curves[source]).t_s).round().astype(int).tolist(),
                "v": (1000 * _thin(curves[source]).value_n).round().astype(int).tolist(),
            }
            for source in reversed(SOURCES)
            if source in curves
        ]
        for group, curves in groups.items()
    }
    return json.dumps(tree, separators=(",", ":"))


def _png(picture: Picture) -> str:
    file = BytesIO()
    matplotlib.image.imsave(file, picture.image, format="png")
    return base64.b64encode(file.getvalue()).decode()
