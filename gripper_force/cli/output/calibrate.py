"""Tables of calibrations of a rig and of an object."""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from rich.table import Table

from gripper_force.cli.console import number, out, pairs

if TYPE_CHECKING:
    from gripper_calibration.fits.cross_validation import Coverage
    from gripper_calibration.procedures.calibrate_jaws import JawsResult
    from gripper_calibration.procedures.calibrate_object import ObjectCalibration
    from gripper_calibration.procedures.calibrate_weight import WeightResult
    from gripper_calibration.procedures.teach import Taught
    from gripper_force.profiles.object_profile import Interval


def rig_table(r: Mapping[str, object]) -> None:
    """Prints the calibrated values of a rig, each with its 95 % interval."""
    pairs({name: _found(value) for name, value in r.items()})


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
            "torque constant, Nm/A": _found(r.nm_per_a.model_dump()),
            "breakaway friction": f"{r.breakaway_n:.2f} N",
        }
    )
    keys = "".join(f"  {key}: {value:.4g}\n" for key, value in r.settings.items())
    out.print(f"\nput this into your configuration:\ngripper:\n{keys}", end="")


def _found(value: object) -> object:
    if isinstance(value, list):
        return ", ".join(f"{item:.5g}" for item in value)
    if not isinstance(value, dict):
        return value
    if "low" not in value:  # settings
        known = {name: setting for name, setting in value.items() if setting is not None}
        return ", ".join(f"{name} {setting}" for name, setting in known.items()) or None
    if value["low"] is None:
        return f"{value['value']:.6g} (given)"
    return f"{value['value']:.6g} ({value['low']:.6g} to {value['high']:.6g})"


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
            "report": str(r.report_path),
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
            "time": f"{minutes:.1f} min",
            "bundle": str(r.bundle),
            "figure": str(r.figure),
        }
    )
