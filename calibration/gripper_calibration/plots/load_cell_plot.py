"""Figure of a load cell's calibration: its three rests and the Allan deviation."""

from pathlib import Path

from gripper_calibration.fits.load_cell_fit import LoadCellFit, allan_deviation
from gripper_calibration.plots.style import DATA, FIT, GRAY, OTHER, value_text
from gripper_force.jobs.report.plots import label_axes, saved_figure


def draw(fit: LoadCellFit, path: Path) -> None:
    """Draws the readings of each rest about their mean in N, rejected readings, and the Allan deviation.

    Args:
        fit: The result.
        path: File to write.

    Raises:
        DataError: The file can't be written.
    """
    scale = fit.n_per_raw.value
    title = f"Load cell: {value_text(fit.n_per_raw, 'N per unit of the reading')}"
    with saved_figure(path, title, 6.0) as figure:
        upper, lower = figure.subfigures(2, 1, squeeze=False, height_ratios=(1.2, 1))[:, 0]
        panels = upper.subplots(1, 3)
        titles = ("empty", "loaded", "empty again")
        for axes, rest, statistics, label in zip(panels, fit.rests, fit.statistics, titles, strict=True):
            t_s = rest.t_s - rest.t_s[0]
            force_n = (rest.raw - statistics.raw) * scale
            kept = statistics.kept
            axes.plot(t_s[kept], force_n[kept], ".", ms=2, color=DATA)
            trend_n = statistics.drift_raw_min / 60 * (t_s - t_s[kept].mean()) * scale
            axes.plot(t_s, trend_n, color=FIT, label=f"drift {statistics.drift_raw_min * scale:+.3f} N/min")
            limit_n = 6 * fit.noise_n + abs(trend_n).max() + 1e-3
            axes.set_ylim(-limit_n, limit_n)
            shown_n = force_n[~kept].clip(-limit_n, limit_n)
            axes.plot(t_s[~kept], shown_n, "x", ms=4, color=GRAY, label=f"{(~kept).sum()} rejected")
            label_axes(axes, f"{label}: mean {statistics.raw:.6g}", "time, s", "deviation from the mean, N")
            axes.legend(loc="upper right")
        left, right = lower.subplots(1, 2, width_ratios=(1.4, 1))
        for rest, statistics, label, colour in zip(
            fit.rests, fit.statistics, titles, (DATA, FIT, OTHER), strict=True
        ):
            tau_s, deviation = allan_deviation(rest, statistics.kept)
            left.loglog(tau_s, deviation * abs(scale), ".-", color=colour, label=label)
        label_axes(left, "noise after averaging (Allan deviation)", "averaging time, s", "N")
        left.legend()
        right.axis("off")
        lines = (
            f"tare  {value_text(fit.tare_raw, '')}",
            f"noise of one reading  {1e3 * fit.noise_n:.1f} mN",
            f"drift without load  {value_text(fit.drift_n_min, 'N/min')}",
            f"change of the empty reading  {fit.return_n:+.4f} N",
            f"rejected readings  {fit.rejected}",
        )
        right.text(0, 0.95, "\n\n".join(lines), va="top")
