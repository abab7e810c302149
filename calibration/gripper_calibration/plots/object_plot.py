"""An object's calibration as a picture: before and after, what is left, and how many touches are enough."""

from pathlib import Path

import numpy as np

from gripper_calibration.fits.object_fit import Fitted
from gripper_calibration.fits.touches import Touches
from gripper_calibration.plots.style import DATA, FIT, GRAY, name, picture
from gripper_force.profiles.correction import curve_n
from gripper_force.profiles.object_profile import ObjectProfile


def draw(
    profile: ObjectProfile,
    fitted: Fitted,
    touches: Touches,
    curve: list[tuple[int, float, float]],
    path: Path,
) -> None:
    """Draws it; ``curve`` is what `fits.correction.learning_curve` gives."""
    left_out = np.isfinite(fitted.left_out_n).all()
    after_n = fitted.left_out_n if left_out else fitted.predict(touches)
    how = "each touch by all others" if left_out else "fitted on the same touches"
    error_n = after_n - touches.force_n
    reach_n = max(float(touches.force_n.max()), float(touches.estimate_n.max()))
    line = np.linspace(0, reach_n, 100)
    half_n = profile.interval.half_width_n(line)
    share = np.abs(error_n) <= profile.interval.half_width_n(after_n)
    title = (
        f"{profile.object}: {profile.touches} touches, MAE {profile.before_n:.3f} N before, "
        f"{np.abs(error_n).mean():.3f} N after ({how})"
    )
    with picture(path, title, 7.0) as figure:
        (before, after), (left, enough) = figure.subplots(2, 2)
        before.plot(touches.estimate_n, touches.force_n, ".", ms=2, color=DATA)
        before.plot(line, line, color=GRAY, lw=0.8, label="equal")
        knots = np.array(profile.output.estimate_n), np.array(profile.output.force_n)
        alone = not fitted.arrays.head.any()
        label = fitted.candidate if alone else "its line; the last layer, refitted, adds the rest"
        before.plot(line, curve_n(*knots, line), color=FIT, label=label)
        name(before, "before", "the network's estimate, N", "load cell, N")
        before.legend()
        after.plot(after_n, touches.force_n, ".", ms=2, color=DATA)
        after.plot(line, line, color=GRAY, lw=0.8)
        name(after, "after", "corrected estimate, N", "load cell, N")
        left.plot(
            touches.force_n, touches.estimate_n - touches.force_n, ".", ms=2, color=GRAY, label="before"
        )
        left.plot(touches.force_n, error_n, ".", ms=2, color=DATA, label="after")
        label = (
            f"interval, promised {100 * profile.interval.coverage:.0f} %, holds {100 * share.mean():.0f} %"
        )
        left.plot(line, half_n, color=FIT, label=label)
        left.plot(line, -half_n, color=FIT)
        name(left, "what is left, by force", "load cell, N", "error, N")
        left.legend()
        for count, mae_n, _ in curve:
            enough.plot(count, mae_n, ".", color=DATA)
        drawn = sorted({count for count, _, _ in curve})
        means_n = {c: np.mean([mae_n for count, mae_n, _ in curve if count == c]) for c in drawn}
        if left_out:  # the same experiment, with every choice of all but one
            means_n[profile.touches - 1] = np.abs(error_n).mean()
        counts = list(means_n)
        enough.plot(counts, list(means_n.values()), ".-", color=FIT, label="after, on those left out")
        enough.axhline(profile.before_n, color=GRAY, lw=0.8, label="before")
        enough.set_xscale("log", base=2)
        enough.set_xticks(counts, [str(count) for count in counts])
        enough.set_ylim(0)
        name(enough, "how many touches are enough", "touches calibrated on", "MAE, N")
        if counts:
            enough.legend()
        else:
            enough.text(0.5, 0.5, "one touch can't tell", transform=enough.transAxes, ha="center")
