"""Maps of the force loop over stiffness and delay."""

from typing import Final

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from gripper_force.jobs.report.figure import STYLE
from gripper_force.qualification.loop_margin.grid import Field, Grid, Margins, Trials, Verdict

_COLOURS: Final = {
    Verdict.HOLDS: "#4d9a6a",
    Verdict.CURRENT: "#a9d3b6",
    Verdict.LOSES: "#9aa0a8",
    Verdict.RINGS: "#e8a33d",
    Verdict.CRUSHES: "#c1443c",
}
_INK: Final = "#222222"
_TITLES: Final = {"fused": "current and vision", "vision": "vision alone"}


def draw_verdicts(
    grid: Grid, verdicts: dict[tuple[str, float], Trials], margins: Margins, crushing_n_m: float
) -> Figure:
    """Draws the verdict of each grasp by loop and loop gain, with the predicted stability boundaries."""
    delay_ms = 1e3 * np.array(grid.delay_s)
    loops = list(dict.fromkeys(feedback for feedback, _ in verdicts))
    with rc_context({**STYLE, "axes.grid": False, "hatch.linewidth": 0.5, "hatch.color": _INK}):
        figure = Figure(figsize=(10, 2.9 * len(loops) + 0.6), layout="constrained")
        axes = figure.subplots(len(loops), len(grid.factors), sharex=True, sharey=True, squeeze=False)
        for (feedback, factor), trials in verdicts.items():
            panel = axes[loops.index(feedback), grid.factors.index(factor)]
            codes = [
                [list(Verdict).index(trials[stiffness, delay_s].verdict) for stiffness in grid.stiffness_n_m]
                for delay_s in grid.delay_s
            ]
            panel.pcolormesh(
                grid.stiffness_n_m,
                delay_ms,
                codes,
                cmap=ListedColormap(list(_COLOURS.values())),
                norm=Normalize(-0.5, len(Verdict) - 0.5),
                shading="nearest",
            )
            predicted = margins.inertia if feedback == "vision" else margins.rule
            _hatch(panel, grid, predicted, factor)
            panel.axvline(crushing_n_m, color=_INK, ls=":", lw=1.2)
            panel.set_xscale("log")
            panel.set_title(f"{_TITLES[feedback]}, loop gain × {factor:g}")
        for panel in axes[-1]:
            panel.set_xlabel("stiffness at a jaw, N/m")
        for panel in axes[:, 0]:
            panel.set_ylabel("delay of vision, ms")
        patches = [Patch(color=colour, label=verdict.value) for verdict, colour in _COLOURS.items()]
        patches.append(Patch(fill=False, hatch="///", lw=0, label="predicted to ring"))
        figure.legend(handles=patches, loc="outside lower center", ncols=len(patches))
    return figure


def _hatch(panel: Axes, grid: Grid, predicted: Field, factor: float) -> None:
    """Hatches the area where the predicted margin is below ``factor``."""
    if min(predicted.shape) > 1 and predicted.min() < factor:
        position = (grid.margin_stiffness_n_m, 1e3 * np.array(grid.margin_delay_s))
        panel.contourf(*position, predicted, [0.0, factor], hatches=["///"], colors="none")
        if factor < predicted.max():
            panel.contour(*position, predicted, [factor], colors=_INK, linewidths=1.2)


def draw_margins(grid: Grid, margins: Margins) -> Figure:
    """Draws observed and predicted margins, and their ratio, for both loops."""
    rows: tuple[tuple[str, Field, str, Field], ...] = (
        ("vision alone: observed", margins.vision, "predicted: gain, inertia, friction", margins.inertia),
        ("vision alone: observed", margins.vision, "predicted: gain and lag", margins.identified),
        ("current and vision: observed", margins.fused, "predicted by its tuning", margins.rule),
    )
    with rc_context({**STYLE, "axes.grid": False}):
        figure = Figure(figsize=(11, 8.4), layout="constrained")
        for row, (observed_title, observed, predicted_title, predicted) in zip(
            figure.subplots(len(rows), 3, sharex=True, sharey=True), rows, strict=True
        ):
            _draw_numbers(row[0], grid, observed, observed_title, "viridis", LogNorm(0.5, 12))
            _draw_numbers(row[1], grid, predicted, predicted_title, "viridis", LogNorm(0.5, 12))
            _draw_numbers(row[2], grid, observed / predicted, "ratio", "RdBu", LogNorm(0.4, 2.5))
            row[0].set_ylabel("delay of vision, ms")
        for panel in row:
            panel.set_xlabel("stiffness at a jaw, N/m")
    return figure


def _draw_numbers(
    panel: Axes, grid: Grid, values: Field, title: str, colour_map: str, scale: LogNorm
) -> None:
    panel.imshow(values, cmap=colour_map, norm=scale, aspect="auto", origin="lower")
    panel.set_xticks(
        range(values.shape[1]), [f"{k:.0e}".replace("e+0", "e") for k in grid.margin_stiffness_n_m]
    )
    panel.set_yticks(range(values.shape[0]), [f"{1e3 * d:.0f}" for d in grid.margin_delay_s])
    panel.set_title(title)
    for (y, x), value in np.ndenumerate(values):
        shade = float(scale(value))
        dark = shade < 0.55 if colour_map == "viridis" else not 0.2 < shade < 0.8
        panel.text(
            x, y, f"{value:.2g}", ha="center", va="center", fontsize=7,
            color="white" if dark else "black",
        )  # fmt: skip
