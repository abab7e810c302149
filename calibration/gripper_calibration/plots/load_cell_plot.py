"""A load cell's calibration as a picture: its three rests, and how long it pays to average."""

from pathlib import Path

from gripper_calibration.fits.load_cell_fit import Weighing, allan_deviation
from gripper_calibration.plots.style import DATA, FIT, GRAY, OTHER, name, picture, text_of


def draw(weighing: Weighing, path: Path) -> None:
    """Readings in newtons about each rest's mean with what was rejected, and the Allan deviation."""
    scale = weighing.n_per_raw.value
    title = f"Load cell: {text_of(weighing.n_per_raw, 'N for one unit of the reading')}"
    with picture(path, title, 6.0) as figure:
        upper, lower = figure.subfigures(2, 1, squeeze=False, height_ratios=(1.2, 1))[:, 0]
        panels = upper.subplots(1, 3)
        titles = ("empty", "loaded", "empty again")
        for axes, rest, level, label in zip(panels, weighing.rests, weighing.levels, titles, strict=True):
            t_s = rest.t_s - rest.t_s[0]
            force_n = (rest.raw - level.raw) * scale
            kept = level.kept
            axes.plot(t_s[kept], force_n[kept], ".", ms=2, color=DATA)
            trend_n = level.drift_raw_min / 60 * (t_s - t_s[kept].mean()) * scale
            axes.plot(t_s, trend_n, color=FIT, label=f"drift {level.drift_raw_min * scale:+.3f} N a minute")
            reach_n = 6 * weighing.noise_n + abs(trend_n).max() + 1e-3
            axes.set_ylim(-reach_n, reach_n)
            shown_n = force_n[~kept].clip(-reach_n, reach_n)
            axes.plot(t_s[~kept], shown_n, "x", ms=4, color=GRAY, label=f"{(~kept).sum()} rejected")
            name(axes, f"{label}: mean {level.raw:.6g}", "time, s", "about the mean, N")
            axes.legend(loc="upper right")
        left, right = lower.subplots(1, 2, width_ratios=(1.4, 1))
        for rest, level, label, colour in zip(
            weighing.rests, weighing.levels, titles, (DATA, FIT, OTHER), strict=True
        ):
            tau_s, deviation = allan_deviation(rest, level.kept)
            left.loglog(tau_s, deviation * abs(scale), ".-", color=colour, label=label)
        name(left, "what averaging leaves (Allan deviation)", "averaging time, s", "N")
        left.legend()
        right.axis("off")
        lines = (
            f"tare  {text_of(weighing.tare_raw, '')}",
            f"noise of one reading  {1e3 * weighing.noise_n:.1f} mN",
            f"drift without load  {text_of(weighing.drift_n_min, 'N a minute')}",
            f"after unloading  {weighing.return_n:+.4f} N",
            f"readings rejected  {weighing.rejected}",
        )
        right.text(0, 0.95, "\n\n".join(lines), va="top")
