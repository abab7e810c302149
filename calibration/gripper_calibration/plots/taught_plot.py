"""Figure of a taught object: estimates and errors on touches left out, and errors against the number of touches."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from gripper_calibration.fits.cross_validation import Coverage
from gripper_calibration.fits.touches import Floats
from gripper_calibration.plots.object_plot import plot_errors
from gripper_calibration.plots.style import DATA, FIT, GRAY
from gripper_force.jobs.report.plots import label_axes, saved_figure
from gripper_force.profiles.object_profile import ObjectProfile


def draw(
    profile: ObjectProfile,
    force_n: Floats,
    before_n: Floats,
    estimate_n: Floats,
    coverages: Sequence[Coverage],
    candidates_mae_n: Mapping[str, Sequence[float]],
    learned: str,
    path: Path,
) -> None:
    """Draws the estimates against the load cell, their errors with the interval, and the candidates' errors.

    Args:
        profile: The profile.
        force_n: Load-cell forces, (N,).
        before_n: Estimates of the configured network, not corrected, (N,).
        estimate_n: Estimates by what was made without the touch, (N,).
        coverages: Coverage in contact, and by force level.
        candidates_mae_n: MAE of each candidate on touches left out, after one and after two thirds of the touches.
        learned: Name of the selected candidate.
        path: File to write.

    Raises:
        DataError: The file can't be written.
    """
    max_n = float(max(force_n.max(), estimate_n.max()))
    title = f"{profile.object}: {profile.touches} touches, MAE {profile.before_n:.3f} N before, "
    title += f"{profile.after_n:.3f} N after, on touches left out"
    with saved_figure(path, title, 4.6, 14.0) as figure:
        estimates, errors, candidates = figure.subplots(1, 3)
        estimates.plot([0, max_n], [0, max_n], color=GRAY, lw=0.8)
        estimates.plot(force_n, before_n, ".", ms=2, color=GRAY, label="before")
        estimates.plot(force_n, estimate_n, ".", ms=2, color=DATA, label="after")
        label_axes(estimates, "estimates", "load cell, N", "estimate, N")
        estimates.legend(markerscale=5)
        plot_errors(errors, force_n, before_n, estimate_n, profile.interval, coverages)
        counts = [round(profile.touches * share) for share in (1 / 3, 2 / 3)]
        candidates.axhline(profile.before_n, color=GRAY, lw=0.8, label="before, not calibrated")
        for name, mae_n in candidates_mae_n.items():
            taken = name == learned
            label = f"{name} (taken)" if taken else name
            width, style, colour = (2.0, "-", FIT) if taken else (1.0, "--", None)
            candidates.plot(counts, mae_n, marker=".", lw=width, ls=style, color=colour, label=label)
        label_axes(candidates, "candidates, calibrated", "touches learned from", "MAE on touches left out, N")
        candidates.set_xticks(counts)
        candidates.set_ylim(0, 1.1 * max(profile.before_n, *np.ravel(list(candidates_mae_n.values()))))
        candidates.legend(fontsize=8)
