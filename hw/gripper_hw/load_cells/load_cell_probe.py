"""Diagnostics of the load cell for `doctor`: rate, noise and rejected samples. Also the search for one."""

import time
from collections.abc import Iterable, Iterator
from contextlib import closing, suppress
from typing import Final

import numpy as np

from gripper_force.config import Config
from gripper_force.errors import GripperError
from gripper_force.jobs.checks import Check, clock_name, gather, judged, keep_only, open_load_cell, rate_hz
from gripper_force.progress import Progress
from gripper_force.runtime.backends import MonotonicClock, open_devices
from gripper_force.schema import Tree
from gripper_force.types import NS_PER_S

_MIN_VALID_SHARE = 0.9
"""Lowest share of valid samples that passes."""

_LINES: Final = (("hx711", 115_200), ("cas", 9_600), ("hx711", 57_600), ("hx711", 9_600))
"""Formats and baud rates that the search tries, in this order."""

_SEARCH_S: Final = 4.0
"""Time for the first readings: an Arduino restarts for 1.6 s, and an HX711 may give 10 samples per second."""

_ENOUGH: Final = 8
"""Readings that make a load cell."""


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


def find(config: Config, ports: Iterable[str], progress: Progress) -> Tree | None:
    """Returns the section ``load_cell`` for the first port on which one of the known kinds of lines arrives, or None.

    Args:
        config: The configuration; of its load cell only the calibration is used.
        ports: Ports to listen at. Nothing is sent.
        progress: Called with each port.
    """
    for port in ports:
        for form, baud_rate in _LINES:
            progress(f"{port}: a load cell ({form}, {baud_rate} baud)?", 0)
            keys: Tree = {"backend": "serial", "port": port, "format": form, "baud_rate": baud_rate}
            with suppress(GripperError):  # in use by another program, or no serial port
                if _sends_readings(config, keys):
                    return keys
    return None


def _sends_readings(config: Config, keys: Tree) -> bool:
    clock = MonotonicClock()
    with closing(open_load_cell(config.with_values(load_cell=keys), clock)) as cell:
        cell.start()
        end_ns, readings = clock.now_ns() + round(_SEARCH_S * NS_PER_S), 0
        while clock.now_ns() < end_ns:
            time.sleep(0.05)
            readings += len(cell.drain())
            if readings >= _ENOUGH:
                # Lines of another device, or at another baud rate, are unreadable for the most part.
                return bool(cell.counts().get("unreadable", 0) < readings / 4)
    return False
