"""Shared style of the calibration figures."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gripper_force.errors import DataError
from gripper_force.jobs.report.figure import STYLE
from gripper_force.profiles.rig_profile import CalibratedValue

DATA: Final = "#7f9cc0"
FIT: Final = "#c2410c"
OTHER: Final = "#4d7c0f"
GRAY: Final = "#8a9099"


@contextmanager
def saved_figure(path: Path, title: str, height_in: float) -> Iterator[Figure]:
    """Yields an empty figure, 10 inches wide, and saves it to ``path`` at the end.

    Raises:
        DataError: The file can't be written.
    """
    with rc_context(STYLE):
        figure = Figure(figsize=(10, height_in), layout="constrained")
        figure.suptitle(title, x=0.008, ha="left", fontsize=13, fontweight="bold")
        yield figure
        try:
            figure.savefig(path)
        except OSError as error:
            raise DataError(f"can't write the figure {path}: {error}; check its folder") from error


def label_axes(axes: Axes, title: str, x: str, y: str) -> None:
    """Sets the title and the axis labels of a plot."""
    axes.set_title(title)
    axes.set_xlabel(x)
    axes.set_ylabel(y)


def value_text(value: CalibratedValue, unit: str) -> str:
    """Returns a value with its unit and interval, for a person."""
    if value.low is None or value.high is None:
        return f"{value.value:.5g} {unit} (given)"
    return f"{value.value:.5g} {unit} ({value.low:.5g} to {value.high:.5g})"
