"""Diagnostics of the load cell for `doctor`: rate, noise and rejected samples."""

from collections.abc import Iterator

import numpy as np

from gripper_force.config import Config
from gripper_force.jobs.checks import Check, clock_name, gather, judged, keep_only, rate_hz
from gripper_force.runtime.backends import open_devices

_MIN_VALID_SHARE = 0.9
"""Lowest share of valid samples that passes."""


def probe(config: Config) -> Iterator[Check]:
    """Samples the configured load cell for a second.

    Raises:
        GripperError: See `open_devices` and the load cell's ``start``.
    """
    if config.load_cell.backend == "none":
        yield Check("load cell", "backend", "none", None)
        return
    with open_devices(keep_only(config, "load_cell")) as devices:
        cell = devices.load_cell
        assert cell is not None
        cell.start()
        samples = gather(devices, cell.drain)
        counts = cell.counts()
    causes = ", ".join(f"{count} {cause.replace('_', ' ')}" for cause, count in counts.items() if count)
    if len(samples) < 2:
        advice = "check its cable and supply, load_cell.baud_rate and load_cell.format"
        yield Check("load cell", "rate", f"{len(samples)} samples {causes}".strip(), False, advice)
        return
    rate = rate_hz([sample.t_ns for sample in samples])
    yield Check(
        "load cell", "rate", f"{rate:.1f} Hz of {config.load_cell.backend}, in {clock_name(config)}", True
    )
    forces_n = [sample.force_n for sample in samples if sample.valid]
    if forces_n:
        noise = f"{np.std(forces_n):.4f} N std around {np.mean(forces_n):.3f} N"
        yield Check("load cell", "noise", noise, True)
    enough_valid = len(forces_n) >= _MIN_VALID_SHARE * len(samples)
    advice = "check its wiring and shielding, and that the load is within its range"
    if counts.get("not_finite"):
        advice = "set load_cell.n_per_raw (newtons per unit of its reading) and load_cell.tare_raw"
    rejected = f"{len(samples) - len(forces_n)} of {len(samples)} samples"
    yield judged("load cell", "rejected", rejected + (f" ({causes})" if causes else ""), enough_valid, advice)
