"""Figures over several logs: estimates against the load cell, errors of grasps, and a training."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backend_bases import FigureCanvasBase
from matplotlib.figure import Figure

from gripper_force.errors import DataError
from gripper_force.jobs.report.figure import STYLE

if TYPE_CHECKING:
    from gripper_force.jobs.grasp import GraspSummary

_COLOURS: Final = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7a5195", "#59606a")
"""Colours of objects in turn. Hues of Okabe and Ito, which colour-blind readers can distinguish."""

_GRAY: Final = "#8a9099"
_POINTS: Final = 4000
"""Points drawn of each object; more cannot be seen."""

Floats = npt.NDArray[np.floating]


def check_figure_path(path: Path) -> None:
    """Makes the folder of a figure. Raises `DataError` if it can't be made, or figures can't have the path's suffix."""
    known = FigureCanvasBase.get_supported_filetypes()
    if path.suffix and path.suffix[1:].lower() not in known:
        raise DataError(f"a figure can't be a {path.suffix} file, as of {path}; name a .png, .svg or .pdf")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise DataError(f"can't write the figure {path}: {error.strerror}; choose another path") from error


@contextmanager
def saved_figure(path: Path, title: str, height_in: float, width_in: float = 10.0) -> Iterator[Figure]:
    """Yields an empty figure, and saves it to ``path`` at the end.

    Raises:
        DataError: The file can't be written.
    """
    check_figure_path(path)
    with rc_context(STYLE):
        figure = Figure(figsize=(width_in, height_in), layout="constrained")
        figure.suptitle(title, x=0.008, ha="left", fontsize=13, fontweight="bold")
        yield figure
        try:
            figure.savefig(path)
        except OSError as error:
            raise DataError(f"can't write the figure {path}: {error.strerror}; check its folder") from error


def label_axes(axes: Axes, title: str, x: str, y: str) -> None:
    """Sets the title and the axis labels of a plot."""
    axes.set_title(title)
    axes.set_xlabel(x)
    axes.set_ylabel(y)


def draw_estimates(
    measured_n: Floats, estimated_n: Floats, objects: npt.NDArray[np.str_], title: str, path: Path
) -> None:
    """Draws estimates against the load cell, and their errors against the force.

    Args:
        measured_n: Forces of the load cell, (N,).
        estimated_n: Estimates, (N,).
        objects: Name of the object of each frame, (N,).
        title: Heading.
        path: File to write.

    Raises:
        DataError: The file can't be written.
    """
    with saved_figure(path, title, 4.6) as figure:
        estimates, errors = figure.subplots(1, 2)
        _estimates(estimates, measured_n, estimated_n, objects)
        for name, colour, index in _by_object(objects):
            errors.plot(
                measured_n[index], (estimated_n - measured_n)[index], ".", ms=1.5, color=colour, label=name
            )
        errors.axhline(0, color=_GRAY, lw=0.8)
        label_axes(errors, "Errors", "load cell, N", "error, N")


def draw_grasps(results: "Sequence[GraspSummary]", title: str, path: Path) -> None:
    """Draws the steady error of each grasp against its target, with the tolerance of the summary.

    Args:
        results: The grasps.
        title: Heading.
        path: File to write.

    Raises:
        DataError: The file can't be written.
    """
    from gripper_force.jobs.trials import WITHIN_N, WITHIN_SHARE

    names = np.array([result["object"] for result in results])
    targets_n = np.array([result["target_n"] for result in results])
    errors_n = np.array([np.nan if (e := r["steady_error_n"]) is None else e for r in results])
    fell_back = np.array([result["fell_back"] for result in results])
    held = np.array([result["result"] == "held" for result in results])
    with saved_figure(path, title, 4.6) as figure:
        axes = figure.subplots()
        line_n = np.linspace(max(float(targets_n.min()) - 0.5, 0.1), float(targets_n.max()) + 0.5, 100)
        band = 100 * np.maximum(WITHIN_SHARE, WITHIN_N / line_n)
        text = f"{100 * WITHIN_SHARE:g} % or {WITHIN_N:g} N"
        axes.fill_between(line_n, -band, band, color=_GRAY, alpha=0.16, lw=0, label=text)
        axes.axhline(0, color=_GRAY, lw=0.8)
        percent = 100 * errors_n / targets_n
        for name, colour, index in _by_object(names):
            for part, label, marker, face in (
                (held & ~fell_back, name, "o", colour),
                (held & fell_back, f"{name}, fell back", "o", "none"),
                (~held, f"{name}, not held", "x", colour),
            ):
                chosen = index[part[index]]
                if np.isfinite(percent[chosen]).any():
                    axes.scatter(
                        targets_n[chosen], percent[chosen], 30, marker=marker, color=colour, facecolor=face,
                        label=label,
                    )  # fmt: skip
        unscored = int((~np.isfinite(errors_n)).sum())
        note = f"; {unscored} without a steady force are not shown" if unscored else ""
        label_axes(axes, "Steady error against the load cell" + note, "target, N", "error, % of the target")
        axes.legend(ncols=3, fontsize=8)


def draw_training(
    losses: Mapping[str, Floats],
    measured_n: Floats,
    estimated_n: Floats,
    objects: npt.NDArray[np.str_],
    constant_rmse_n: float,
    title: str,
    path: Path,
) -> None:
    """Draws the training error against steps, beside the estimates on the validation data.

    Args:
        losses: Steps and root mean squared error in N of each network, (N, 2).
        measured_n: Forces of the validation data, (N,).
        estimated_n: Estimates on it, (N,).
        objects: Name of the object of each frame, (N,).
        constant_rmse_n: Root mean squared error of the mean force of the training data, on that data.
        title: Heading.
        path: File to write.

    Raises:
        DataError: The file can't be written.
    """
    with saved_figure(path, title, 4.6) as figure:
        loss, estimates = figure.subplots(1, 2)
        for (name, values), colour in zip(losses.items(), _COLOURS, strict=False):
            marker = "o" if len(values) == 1 else None  # a line of one point would not show
            loss.plot(values[:, 0], values[:, 1], color=colour, lw=1.0, marker=marker, label=name)
        loss.axhline(constant_rmse_n, color=_GRAY, lw=1.0, ls="--", label="constant: the mean force")
        loss.set_ylim(0)
        label_axes(loss, "Training error", "steps", "RMSE of the clips of a step, smoothed, N")
        loss.legend(fontsize=8)
        _estimates(estimates, measured_n, estimated_n, objects)


def _estimates(axes: Axes, measured_n: Floats, estimated_n: Floats, objects: npt.NDArray[np.str_]) -> None:
    max_n = float(max(measured_n.max(), estimated_n.max(), 0.1))
    axes.plot([0, max_n], [0, max_n], color=_GRAY, lw=0.8)
    for name, colour, index in _by_object(objects):
        axes.plot(measured_n[index], estimated_n[index], ".", ms=1.5, color=colour, label=name)
    label_axes(axes, "Estimates", "load cell, N", "estimate, N")
    axes.legend(fontsize=8, markerscale=5, ncols=2 if len(np.unique(objects)) > 6 else 1)


def _by_object(objects: npt.NDArray[np.str_]) -> Iterator[tuple[str, str, npt.NDArray[np.intp]]]:
    """Yields name, colour and indices of each object, thinned to what can be seen."""
    for i, name in enumerate(np.unique(objects)):
        index = np.flatnonzero(objects == name)
        step = -(-len(index) // _POINTS)
        yield str(name), _COLOURS[i % len(_COLOURS)], index[::step]
