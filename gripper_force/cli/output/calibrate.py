"""What was found of a rig and of an object."""

import math
from typing import Any

from gripper_force.cli.console import number, pairs


def rig_table(r: dict[str, Any]) -> None:
    """What a calibration of the rig found, each value with its 95 % interval."""
    pairs({name: _found(value) for name, value in r.items()})


def _found(value: Any) -> Any:
    if isinstance(value, list):
        return ", ".join(f"{item:.5g}" for item in value)
    if not isinstance(value, dict):
        return value
    if value["low"] is None:
        return f"{value['value']:.6g} (given)"
    return f"{value['value']:.6g} ({value['low']:.6g} to {value['high']:.6g})"


def object_table(r: dict[str, Any]) -> None:
    """An object's profile."""
    after_n = r["after_n"]
    interval, plant = r["interval"], r["plant"]
    pairs(
        {
            "object": r["object"],
            "touches": f"{r['touches']} with {r['frames']} frames, up to {r['force_n']:.1f} N",
            **(
                {}
                if (at := r["crushed_at_n"]) is None
                else {"crushed": f"it stayed narrower after {at:.1f} N"}
            ),
            "error before": number(r["before_n"], "N"),
            "error after": "not known with so few touches" if after_n is None else number(after_n, "N"),
            "correction": r["correction"],
            "interval": f"{100 * interval['coverage']:.0f} % within {interval['base_n']:.2f} N at no force, "
            f"{math.hypot(interval['base_n'], 5 * interval['share']):.2f} N at 5 N",
            "stiffness": number(r["stiffness_n_m"], "N/m", 0),
            "loop": "not known: no servo in these logs"
            if plant is None
            else f"gain {plant['gain']:.2f}, lag {plant['lag_ms']:.0f} ms, delay {plant['delay_ms']:.0f} ms, "
            f"phase margin {plant['phase_margin_deg']:.0f} degrees",
            "profile": str(r["profile"]),
            "report": str(r["report"]),
        }
    )
