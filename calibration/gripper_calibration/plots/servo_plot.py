"""Figure of a servo's calibration: force against current, residuals, and friction against speed."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gripper_calibration.fits.servo_fit import Floats, ServoFit, ServoPress
from gripper_calibration.plots.style import DATA, FIT, GRAY, OTHER, value_text
from gripper_force.jobs.report.plots import label_axes, saved_figure


def draw(fit: ServoFit, presses: Sequence[ServoPress], path: Path) -> None:
    """Draws the presses with both branches of the fit, residuals against force, and free travel.

    Args:
        fit: The result.
        presses: The presses it was fitted to.
        path: File to write.

    Raises:
        DataError: The file can't be written.
    """
    with saved_figure(path, f"Servo: {value_text(fit.nm_per_a, 'N m/A at the horn')}", 7.5) as figure:
        axes = figure.subplots(2, 2)
        force_plot, residual_plot, travel_plot, text_plot = axes.ravel()
        for press in presses:
            force_plot.plot(press.current_a, press.force_n, color=GRAY, lw=0.4)
        force, current, residual, side = fit.pressed.T
        ends = np.array(fit.force_n)
        for sign, colour, label in ((1.0, FIT, "rising"), (-1.0, OTHER, "falling")):
            rows = side == sign
            force_plot.plot(current[rows], force[rows], ".", ms=1.5, color=DATA)
            friction_n = fit.friction_n.value + fit.friction_share.value * (ends - force.mean())
            line_a = fit.offset_a.value + (ends + sign * friction_n) / fit.n_per_a.value
            force_plot.plot(line_a, ends, color=colour, label=f"{label}, fit")
            centres, means, spreads = _binned(force[rows], residual[rows])
            residual_plot.errorbar(
                centres, means, spreads, fmt="o", ms=4, capsize=2, color=colour, label=label
            )
            ahead = sign * fit.travelled[:, 0] > 0
            speed, motor_force_n = fit.travelled[ahead].T
            travel_plot.plot(
                100 * np.abs(speed),
                sign * motor_force_n,
                ".",
                color=colour,
                label="closing" if sign > 0 else "opening",
            )
        label_axes(force_plot, "presses", "motor current, A", "load cell, N")
        label_axes(residual_plot, "residuals (mean and standard deviation)", "force, N", "residual, N")
        residual_plot.axhline(0, color=GRAY, lw=0.8)
        speeds = np.array([0, fit.speed_m_s[1]])
        friction_n = fit.free_friction_n.value + fit.damping_n_s_m.value * speeds
        travel_plot.plot(100 * speeds, friction_n, color=GRAY, label="fit")
        travel_plot.set_ylim(bottom=0)
        label_axes(
            travel_plot,
            "free travel: friction against speed",
            "speed of a jaw, cm/s",
            "motor force at a jaw, N",
        )
        residual_plot.margins(y=0.25)
        for one in (force_plot, residual_plot, travel_plot):
            one.legend(ncols=2, loc="upper left")
        text_plot.axis("off")
        lines = (
            f"motor force  {value_text(fit.n_per_a, 'N/A at each jaw')}",
            f"friction under load  {value_text(fit.friction_n, 'N')}",
            f"  its growth with force  {value_text(fit.friction_share, 'N/N')}",
            f"friction in free travel  {value_text(fit.free_friction_n, 'N')}",
            f"viscous friction  {value_text(fit.damping_n_s_m, 'N s/m')}",
            f"pinion radius  {value_text(fit.pinion_radius_m, 'm')}",
            f"open at  {value_text(fit.open_position_rad, 'rad')}",
            f"hysteresis, rising against falling  {2 * fit.friction_n.value:.3f} N",
            f"residual  {fit.residual_n:.3f} N; {fit.outliers} outliers",
            f"valid from {fit.force_n[0]:.2f} to {fit.force_n[1]:.2f} N",
        )
        text_plot.text(0, 0.98, "\n\n".join(lines), va="top", linespacing=0.95)


def _binned(x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
    """Mean of x, and mean and standard deviation of y, in up to ten bins of x."""
    edges = np.linspace(x.min(), x.max() + 1e-9, 11)
    index = np.digitize(x, edges)
    filled = [index == i for i in range(1, 11) if (index == i).any()]
    centres, means, stds = zip(
        *((x[bin_].mean(), y[bin_].mean(), y[bin_].std()) for bin_ in filled), strict=True
    )
    return np.array(centres), np.array(means), np.array(stds)
