"""Shared colours and texts of the calibration figures."""

from typing import Final

from gripper_force.profiles.rig_profile import CalibratedValue

DATA: Final = "#7f9cc0"
FIT: Final = "#c2410c"
OTHER: Final = "#4d7c0f"
GRAY: Final = "#8a9099"


def value_text(value: CalibratedValue, unit: str) -> str:
    """Returns a value with its unit and interval, for a person."""
    if value.low is None or value.high is None:
        return f"{value.value:.4g} {unit} (given)"
    return f"{value.value:.4g} {unit} ({value.low:.4g} to {value.high:.4g})"
