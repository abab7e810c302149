"""Figure of an object's calibration: errors before and after, residuals, and the learning curve."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from gripper_calibration.fits.cross_validation import Coverage
from gripper_calibration.fits.object_fit import LearningCurvePoint, ObjectFit
from gripper_calibration.fits.touches import Floats, Touches
from gripper_calibration.plots.style import DATA, FIT, GRAY
from gripper_force.jobs.report.plots import label_axes, saved_figure
from gripper_force.profiles.object_profile import Interval, ObjectProfile


def draw(
    profile: ObjectProfile,
    fit: ObjectFit,
    touches: Touches,
    curve: Sequence[LearningCurvePoint],
    path: Path,
) -> None:
    """Draws the estimates before and after the correction, the residuals with the interval, and the curve.

    Args:
        profile: The profile.
        fit: The fit it was made from.
        touches: The touches it was fitted to.
        curve: Points of `gripper_calibration.fits.object_fit.learning_curve`.
        path: File to write.

    Raises:
        DataError: The file can't be written.
    """
    validated = np.isfinite(fit.cross_validated_n).all()
    after_n = fit.cross_validated_n if validated else fit.predict(touches)
    method = "cross-validated" if validated else "fitted on the same touches"
    after_mae_n = float(np.abs(after_n - touches.force_n).mean())
    max_n = max(float(touches.force_n.max()), float(touches.estimate_n.max()))
    line_n = np.linspace(0, max_n, 100)
    count = "1 touch" if profile.touches == 1 else f"{profile.touches} touches"
    title = f"{profile.object}: {count}, MAE {profile.before_n:.3f} N before, {after_mae_n:.3f} N after ({method})"
    with saved_figure(path, title, 7.0) as figure:
        (before_plot, after_plot), (residual_plot, curve_plot) = figure.subplots(2, 2)
        before_plot.plot(touches.estimate_n, touches.force_n, ".", ms=2, color=DATA)
        before_plot.plot(line_n, line_n, color=GRAY, lw=0.8, label="equal")
        refitted = fit.arrays.head.any()
        label = "its line; the refitted last layer adds the rest" if refitted else fit.candidate
        before_plot.plot(line_n, profile.output.at(line_n), color=FIT, label=label)
        label_axes(before_plot, "before", "visual estimate, N", "load cell, N")
        before_plot.legend()
        after_plot.plot(after_n, touches.force_n, ".", ms=2, color=DATA)
        after_plot.plot(line_n, line_n, color=GRAY, lw=0.8)
        label_axes(after_plot, "after", "corrected estimate, N", "load cell, N")
        plot_errors(
            residual_plot, touches.force_n, touches.estimate_n, after_n, profile.interval, fit.coverages
        )
        _plot_learning_curve(curve_plot, profile, curve, after_mae_n if validated else None)


def plot_errors(
    axes: Axes,
    force_n: Floats,
    before_n: Floats,
    after_n: Floats,
    interval: Interval,
    coverages: Sequence[Coverage],
) -> None:
    """Plots errors against the force, (N,) each, with an interval and the coverage of each force level."""
    max_n = float(max(force_n.max(), before_n.max()))
    line_n = np.linspace(0, max_n, 100)
    half_n = interval.half_width_n(line_n)
    axes.plot(force_n, before_n - force_n, ".", ms=2, color=GRAY, label="before")
    axes.plot(force_n, after_n - force_n, ".", ms=2, color=DATA, label="after")
    label = f"{100 * interval.coverage:.0f} % interval"
    if coverages:
        label += f", contains {100 * coverages[0].covered:.0f} % in contact"
    axes.plot(line_n, half_n, color=FIT, label=label)
    axes.plot(line_n, -half_n, color=FIT)
    for level in coverages[1:]:
        end_n = max_n if level.to_n is None else min(level.to_n, max_n)
        middle_n = (level.from_n + max(level.from_n, end_n)) / 2
        at = (middle_n, float(interval.half_width_n(middle_n)))
        axes.annotate(f"{100 * level.covered:.0f} %", at, ha="center", va="bottom", fontsize=7)
    label_axes(axes, "errors", "load cell, N", "error, N")
    axes.legend(fontsize=8, markerscale=3)


def _plot_learning_curve(
    axes: Axes, profile: ObjectProfile, curve: Sequence[LearningCurvePoint], after_mae_n: float | None
) -> None:
    for point in curve:
        axes.plot(point.touches, point.mae_n, ".", color=DATA)
    counts = sorted({point.touches for point in curve})
    means_n = {n: float(np.mean([point.mae_n for point in curve if point.touches == n])) for n in counts}
    if after_mae_n is not None:  # cross-validation fits on all touches but one
        means_n[profile.touches - 1] = after_mae_n
    label_axes(axes, "learning curve", "touches in the fit", "MAE, N")
    axes.axhline(profile.before_n, color=GRAY, lw=0.8, label="before")
    if means_n:
        axes.plot(list(means_n), list(means_n.values()), ".-", color=FIT, label="after, on the other touches")
        axes.set_xscale("log", base=2)
        axes.set_xticks(list(means_n), [str(count) for count in means_n])
        axes.legend()
    else:  # a logarithmic axis without data is an error
        axes.set_xticks([])
        axes.text(0.5, 0.5, "too few touches", transform=axes.transAxes, ha="center")
    axes.set_ylim(0)
