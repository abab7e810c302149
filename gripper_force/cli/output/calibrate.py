"""Tables of calibrations of a rig and of an object."""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Final

from rich.table import Table

from gripper_force.cli.console import number, out, pairs

if TYPE_CHECKING:
    from gripper_calibration.fits.cross_validation import Coverage
    from gripper_calibration.procedures.calibrate_jaws import JawsResult
    from gripper_calibration.procedures.calibrate_object import ObjectCalibration
    from gripper_calibration.procedures.calibrate_weight import WeightResult
    from gripper_calibration.procedures.teach import Taught
    from gripper_force.jobs.object_gain import SavedGain
    from gripper_force.profiles.object_profile import Interval
    from gripper_force.vision.header import KnownViews, OodModel


LOAD_CELL: Final = {
    "date": "date",
    "sensor": "sensor",
    "tare_raw": "reading without load",
    "n_per_raw": "newtons per unit of the reading",
    "force_n": "calibrated forces, N",
    "noise_n": "noise, N",
    "drift_n_min": "drift, N/min",
    "return_n": "change of the empty reading, N",
    "rejected": "readings not used",
    "rig": "rig profile",
    "report": "figure",
}
SERVO: Final = {
    "date": "date",
    "model": "servo",
    "nm_per_a": "torque constant, Nm/A",
    "friction_n": "friction, N",
    "damping_n_s_m": "damping, N s/m",
    "pinion_radius_m": "radius of the pinion, m",
    "open_position_rad": "angle of the open jaws, rad",
    "open_width_m": "width between the open jaws, m",
    "force_n": "calibrated forces, N",
    "speed_m_s": "calibrated speeds, m/s",
    "residual_n": "residual of the fit, N",
    "n_per_a": "force per current, N/A",
    "friction_share": "growth of friction with the force",
    "free_friction_n": "friction in free travel, N",
    "lag_s": "lag from current to force, s",
    "offset_a": "offset of the current, A",
    "presses": "presses",
    "passes": "passes of free travel",
    "width_shift_m": "change of all widths, m",
    "rig": "rig profile",
    "report": "figure",
}
CAMERA: Final = {
    "date": "date",
    "backend": "camera",
    "side_px": "side of the frames, px",
    "rate_hz": "frame rate, Hz",
    "gain": "gain",
    "image": "other settings",
    "exposure_us": "exposure, us",
    "mean": "mean gray value",
    "clipped": "share of clipped pixels",
    "region": "region: left, top, width, height, px",
    "markers": "region by markers",
    "lag_ms": "lag behind the load cell, ms",
    "delay_ms": "delay from force to estimate, ms",
    "reference": "image of the open jaws",
    "correlation_lag_ms": "lag by correlation, ms",
    "use_ms": "time from frame to control, ms",
    "compute_ms": "time of an estimate, ms",
    "touches": "touches",
    "touches_that_tell": "touches that show the lag",
    "rig": "rig profile",
    "report": "figure",
}
"""Plain words for each key of the commands' JSON, with the unit."""


def rig_table(r: Mapping[str, object], names: Mapping[str, str]) -> None:
    """Prints the calibrated values of a rig that have a name, each with its 95 % interval."""
    pairs({name: _value_text(r[key]) for key, name in names.items()})


def jaws_table(r: "JawsResult") -> None:
    """Prints the ends and the friction of the jaws, and the proposed configuration."""
    pairs(
        {
            "ends": f"{r.open_end_rad:.3f} rad open, {r.closed_end_rad:.3f} rad closed, "
            f"repeated within {r.repeat_rad:.3f} rad",
            "breakaway friction": f"{r.breakaway_n[0]:.2f} N closing, {r.breakaway_n[1]:.2f} N opening",
            "running friction": f"{r.running_n[0]:.2f} N closing, {r.running_n[1]:.2f} N opening",
        }
    )
    out.print(f"\nput this into your configuration:\n{r.yaml}", end="")


def weight_table(r: "WeightResult") -> None:
    """Prints what a weight measured, and the proposed configuration."""
    pairs(
        {
            "torque constant, Nm/A": _value_text(r.nm_per_a.model_dump()),
            "breakaway friction": f"{r.breakaway_n:.2f} N",
        }
    )
    keys = "".join(f"  {key}: {value:.4g}\n" for key, value in r.settings.items())
    out.print(f"\nput this into your configuration:\ngripper:\n{keys}", end="")


def _value_text(value: object) -> object:
    if isinstance(value, list):
        return (" to " if len(value) == 2 else ", ").join(f"{item:.5g}" for item in value)
    if not isinstance(value, dict):
        return value
    if "low" not in value:  # settings
        settings = {name: setting for name, setting in value.items() if setting is not None}
        return ", ".join(f"{name} {setting}" for name, setting in settings.items()) or None
    if value["low"] is None:
        return f"{value['value']:.6g} (given)"
    return f"{value['value']:.6g} ({value['low']:.6g} to {value['high']:.6g})"


def network_table(checkpoint: str, model: "OodModel", views: "KnownViews | None") -> None:
    """Prints the out-of-distribution score and the limit of the known views that a network has got."""
    claimed = [model.std_base, math.hypot(model.std_base, model.std_growth)]
    pairs(
        {
            "checkpoint": checkpoint,
            "limits of the score": ", ".join(
                f"{limit.limit:.2f} at {limit.force_n:.1f} N" for limit in model.limits
            ),
            "limit of the known views": "as before: there are too few sets"
            if views is None
            else number(views.limit),
            "factor of the claimed error": f"{claimed[0]:.2f} for known frames, {claimed[1]:.2f} at the limit",
        }
    )


def gain_table(r: "SavedGain") -> None:
    """Prints the gain of an object that was saved."""
    pairs(
        {
            "object": r.object,
            "gain": f"{r.object_gain:.2f} +- {100 * r.object_gain_std:.0f} %",
            "motor current over vision": f"{r.ratio:.2f} +- {100 * r.ratio_std:.0f} %",
            "profile": str(r.profile),
        }
    )


def _interval(interval: "Interval") -> str:
    at_5_n = math.hypot(interval.base_n, 5 * interval.share)
    return f"{100 * interval.coverage:.0f} % within {interval.base_n:.2f} N at 0 N, {at_5_n:.2f} N at 5 N"


def _coverage(levels: "Sequence[Coverage]") -> str:
    if not levels:
        return "unknown with so few touches"
    contact, *forces = levels
    ends = ["N and more" if level.to_n is None else f"to {level.to_n:g} N" for level in forces]
    parts = [
        f"{level.from_n:g} {end}: {100 * level.covered:.0f} %"
        for level, end in zip(forces, ends, strict=True)
    ]
    return f"{100 * contact.covered:.0f} % in contact of the touches left out ({', '.join(parts)})"


def object_table(r: "ObjectCalibration") -> None:
    """Prints an object's profile."""
    profile, after_n = r.profile, r.mae_after_n
    plant = profile.plant
    pairs(
        {
            "object": profile.object,
            "touches": f"{profile.touches} with {profile.frames} frames, up to {profile.force_n:.1f} N",
            **(
                {}
                if (at := r.crushed_at_n) is None
                else {"crushed": f"the object stayed narrower after {at:.1f} N"}
            ),
            "error before": number(r.mae_before_n, " N"),
            "error after": "unknown with so few touches" if after_n is None else number(after_n, " N"),
            "correction": r.correction,
            "interval": _interval(profile.interval),
            "coverage": _coverage(r.coverages),
            "stiffness": number(profile.stiffness_n_m, " N/m", 0),
            "loop": "unknown: these logs hold no servo"
            if plant is None
            else f"gain {plant.gain:.2f}, lag {plant.lag_ms:.0f} ms, delay {plant.delay_ms:.0f} ms, "
            f"phase margin {plant.phase_margin_deg:.0f} degrees",
            "profile": str(r.profile_path),
            "figure": str(r.report_path),
        }
    )


def taught_table(r: "Taught", minutes: float) -> None:
    """Prints the candidates' errors, the expected error and the bundle."""
    table = Table("candidate", "error on touches left out", "", box=None, pad_edge=False)
    for name, mae_n in r.candidates_mae_n.items():
        table.add_row(name, number(mae_n, " N"), "taken" if name == r.learned else "")
    out.print(table)
    profile = r.profile
    pairs(
        {
            "error before": number(r.before_n, " N"),
            "expected error": f"{r.mae_n:.3f} N, in contact {r.contact_mae_n:.3f} N",
            "with half as many touches": number(r.fewer_mae_n, " N"),
            "interval": _interval(profile.interval),
            "coverage": _coverage(r.coverages),
            "touches": f"{profile.touches}, up to {profile.force_n:.1f} N",
            "time of this call": f"{minutes:.1f} min",
            "bundle": str(r.bundle),
            "figure": str(r.figure),
        }
    )
