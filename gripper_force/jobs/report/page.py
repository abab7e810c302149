"""The report as one HTML page that needs no other file and no network."""

import json
from html import escape
from pathlib import Path
from string import Template
from typing import Final

import numpy as np

from gripper_force.jobs.report.figure import WIDTH_COLOURS, Svg, thin
from gripper_force.jobs.report.run import SOURCES, Run

_MAX_EVENT_ROWS: Final = 300


def render(run: Run, drawing: Svg, note: str) -> str:
    """Returns the page.

    Args:
        run: The run.
        drawing: Its figure.
        note: Note on the frames' overlay; may be empty.
    """
    template = Template(Path(__file__).with_name("page.html").read_text(encoding="utf-8"))
    sections = [_touches(run), _drawing(run, drawing, note), _events(run)]
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


def _palette(scheme: str) -> str:
    colours = {source: getattr(style, scheme) for source, style in SOURCES.items()}
    colours["width"] = WIDTH_COLOURS[scheme]
    return "".join(f"--{name}:{colour};" for name, colour in colours.items())


def _headline(run: Run) -> str:
    badge = f'<span class="badge {escape(run.outcome)}">{escape(run.outcome.replace("_", " "))}</span>'
    origins = {"simulated": run.simulated, "replayed with changes, open loop": run.replayed}
    origin = "".join(f'<span class="badge origin">{text}</span>' for text, shown in origins.items() if shown)
    heading = f"<h1>{escape(run.object)} {badge if run.outcome else ''}{origin}</h1>"
    return heading + _shown(_cards(run))


def _shown(cards: list[tuple[str, str, str]]) -> str:
    shown = "".join(
        f'<div class="card"><div class="what">{what}</div>'
        f'<div class="value">{value}<small> {unit}</small></div></div>'
        for what, value, unit in cards
    )
    return f'<div class="cards">{shown}</div>'


def _touches(run: Run) -> str:
    """One card for each touch, if there are several."""
    if len(run.touches) < 2:
        return ""
    cards = []
    for i, touch in enumerate(run.touches, 1):
        errors = ", ".join(f"{SOURCES[source].label} {mae_n:.2f} N" for source, mae_n in touch.mae_n.items())
        text = f"peak; mean error: {errors}" if errors else "peak"
        name = f"Touch {i}, {touch.start_s:.1f} to {touch.end_s:.1f} s"
        cards.append((name, f"{touch.peak_n:.2f}", f"N {text}"))
    return _shown(cards)


def _cards(run: Run) -> list[tuple[str, str, str]]:
    """Name, value and unit of each value under the heading."""
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
            mean_n = np.abs(run.errors[source].value).mean()
            cards.append((f"Mean error, {SOURCES[source].label}", f"{mean_n:.2f}", "N"))
    if run.object_gain is not None:
        gain, std = run.object_gain
        cards.append(("Object's gain", f"{gain:.2f}", f"&plusmn; {100 * std:.0f} %"))
    if len(run.latency_ms):
        p50, p99 = np.percentile(run.latency_ms, [50, 99])
        cards.append(("Latency p50 / p99", f"{p50:.1f} / {p99:.1f}", "ms"))
    return cards


def _drawing(run: Run, drawing: Svg, note: str) -> str:
    charts = "".join(
        f'<div class="chart" data-series="{name}" data-from="{run.begin_s:.6g}" data-to="{run.end_s:.6g}" '
        f'style="left:{chart.left:.3f}%;top:{chart.top:.3f}%;'
        f'width:{chart.width:.3f}%;height:{chart.height:.3f}%"></div>'
        for name, chart in drawing.charts.items()
    )
    text = f'<p class="note">{escape(note)}</p>' if note else ""
    figure = f'<div class="scroll"><div class="drawing">{drawing.text}{charts}</div></div>'
    return f"<section>{figure}{text}</section>"


def _events(run: Run) -> str:
    if not run.event_rows:
        return ""
    rows = "".join(
        f"<tr><td>{row.t_s:.3f}</td><td>{escape(row.unit)}</td><td>{escape(row.text)}</td></tr>"
        for row in run.event_rows[:_MAX_EVENT_ROWS]
    )
    more = len(run.event_rows) - _MAX_EVENT_ROWS
    rest = f'<p class="note">{more} more rows are in the log.</p>' if more > 0 else ""
    head = "<thead><tr><th>s</th><th>unit</th><th>text</th></tr></thead>"
    return f"<section><h2>Phases and events</h2><table>{head}<tbody>{rows}</tbody></table>{rest}</section>"


def _facts(run: Run) -> str:
    rows = "".join(
        f"<tr><td>{escape(key)}</td><td>{escape(value)}</td></tr>" for key, value in run.metadata.items()
    )
    return f"<details><summary>Versions and metadata</summary><table>{rows}</table></details>" if rows else ""


def _series_json(run: Run) -> str:
    """Values that the page's script shows at the pointer: label, source, times in ms and forces in mN."""
    groups = {"forces": run.forces, "errors": run.errors}
    tree = {
        group: [
            {
                "label": SOURCES[source].label,
                "source": source,
                "t": (1000 * thin(curves[source]).t_s).round().astype(int).tolist(),
                "v": (1000 * thin(curves[source]).value).round().astype(int).tolist(),
            }
            for source in reversed(SOURCES)
            if source in curves
        ]
        for group, curves in groups.items()
    }
    return json.dumps(tree, separators=(",", ":"))
