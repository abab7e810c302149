"""What the pictures of all calibrations share: size, style, and a file beside the profile."""

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
def picture(path: Path, title: str, height_in: float) -> Iterator[Figure]:
    """A figure 10 inches wide to draw on, which is written to ``path`` at the end.

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
            raise DataError(f"can't write the picture {path}: {error}") from error


def name(axes: Axes, title: str, x: str, y: str) -> None:
    """Writes what a plot shows, and the units of its axes."""
    axes.set_title(title)
    axes.set_xlabel(x)
    axes.set_ylabel(y)


def text_of(estimate: CalibratedValue, unit: str) -> str:
    """A value and its interval."""
    if estimate.low is None or estimate.high is None:
        return f"{estimate.value:.5g} {unit} (given)"
    return f"{estimate.value:.5g} {unit} ({estimate.low:.5g} to {estimate.high:.5g})"
