"""A servo's calibration as a picture: force against current, what the fit leaves, friction against speed."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gripper_calibration.fits.servo_fit import Floats, ServoFit, ServoPress
from gripper_calibration.plots.style import DATA, FIT, GRAY, OTHER, name, picture, text_of


def draw(fit: ServoFit, presses: Sequence[ServoPress], path: Path) -> None:
    """All presses with the sliding branches of the fit, residuals by force, and free travel."""
    with picture(path, f"Servo: {text_of(fit.nm_per_a, 'N m for 1 A at the horn')}", 7.5) as figure:
        axes = figure.subplots(2, 2)
        pushed, residuals, travel, words = axes.ravel()
        for press in presses:
            pushed.plot(press.current_a, press.force_n, color=GRAY, lw=0.4)
        force, current, residual, side = fit.pressed.T
        ends = np.array(fit.force_n)
        for sign, colour, label in ((1.0, FIT, "up"), (-1.0, OTHER, "down")):
            rows = side == sign
            pushed.plot(current[rows], force[rows], ".", ms=1.5, color=DATA)
            taken = fit.friction_n.value + fit.friction_share.value * (ends - force.mean())
            line_a = fit.offset_a.value + (ends + sign * taken) / fit.n_per_a.value
            pushed.plot(line_a, ends, color=colour, label=f"{label}, fit")
            centres, means, spreads = _binned(force[rows], residual[rows])
            residuals.errorbar(centres, means, spreads, fmt="o", ms=4, capsize=2, color=colour, label=label)
            ahead = sign * fit.travelled[:, 0] > 0
            speed, push = fit.travelled[ahead].T
            travel.plot(
                100 * np.abs(speed),
                sign * push,
                ".",
                color=colour,
                label="closing" if sign > 0 else "opening",
            )
        name(pushed, "pressing and letting go", "motor current, A", "load cell, N")
        name(residuals, "what the fit leaves, by force (mean and spread)", "force, N", "N")
        residuals.axhline(0, color=GRAY, lw=0.8)
        speeds = np.array([0, fit.speed_m_s[1]])
        friction_n = fit.free_friction_n.value + fit.damping_n_s_m.value * speeds
        travel.plot(100 * speeds, friction_n, color=GRAY, label="fit")
        travel.set_ylim(bottom=0)
        name(travel, "free travel: friction against speed", "speed of a jaw, cm/s", "push at a jaw, N")
        residuals.margins(y=0.25)
        for one in (pushed, residuals, travel):
            one.legend(ncols=2, loc="upper left")
        words.axis("off")
        lines = (
            f"push  {text_of(fit.n_per_a, 'N for 1 A at each jaw')}",
            f"friction under load  {text_of(fit.friction_n, 'N')}",
            f"  its growth with force  {text_of(fit.friction_share, 'N for 1 N')}",
            f"friction in free travel  {text_of(fit.free_friction_n, 'N')}",
            f"viscous friction  {text_of(fit.damping_n_s_m, 'N s/m')}",
            f"pinion radius  {text_of(fit.pinion_radius_m, 'm')}",
            f"open at  {text_of(fit.open_position_rad, 'rad')}",
            f"hysteresis, up against down  {2 * fit.friction_n.value:.3f} N",
            f"the fit leaves  {fit.residual_n:.3f} N; {fit.outliers} readings left out",
            f"holds from {fit.force_n[0]:.2f} to {fit.force_n[1]:.2f} N",
        )
        words.text(0, 0.98, "\n\n".join(lines), va="top", linespacing=0.95)


def _binned(x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
    edges = np.linspace(x.min(), x.max() + 1e-9, 11)
    which = np.digitize(x, edges)
    filled = [y[which == i] for i in range(1, 11) if (which == i).any()]
    centres = [x[which == i].mean() for i in range(1, 11) if (which == i).any()]
    return np.array(centres), np.array([f.mean() for f in filled]), np.array([f.std() for f in filled])
