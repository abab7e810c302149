"""Building blocks of `gripper_force.jobs.doctor` that the probes of the devices share."""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Final, Literal, TypeVar

import numpy as np

from gripper_force.config import Config
from gripper_force.errors import ConfigError
from gripper_force.interfaces import Clock, Devices
from gripper_force.plugins import load_class
from gripper_force.runtime.backends import LOAD_CELLS
from gripper_force.types import NS_PER_MS, NS_PER_S

_FIRST_NS: Final = 5 * NS_PER_S
"""Longest start of a sensor: an Arduino restarts when its port is opened."""

_MEASURE_NS: Final = NS_PER_S
"""Time for which a sensor is measured."""

_POLL_NS: Final = NS_PER_MS

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Check:
    """One row of the diagnosis.

    Attributes:
        unit: The device or part that was checked.
        name: The property that was checked.
        found: Its value, with units.
        ok: False if something must be done; None if the row only informs.
        advice: The remedy, or something to know.
    """

    unit: str
    name: str
    found: str
    ok: bool | None
    advice: str = ""


@dataclass(frozen=True, slots=True)
class RegisterChange:
    """A servo register that the setup would change; values with units."""

    register: str
    old: str
    new: str


@dataclass(frozen=True, slots=True)
class SetupResult:
    """Result of a servo's setup.

    Attributes:
        servo: Id of the servo.
        changes: Registers that differed from what a run needs.
        applied: True if they were written and read back.
    """

    servo: int
    changes: list[RegisterChange]
    applied: bool


Confirm = Callable[[str, list[RegisterChange]], bool]
"""Receives a servo's name and the changes; returns True to apply them."""


@dataclass(frozen=True, slots=True)
class FoundServo:
    """A servo that answered a ping.

    Attributes:
        port: Its port.
        baud_rate: Baud rate at which it answered.
        id: Its id.
        model: Value of ``servo.model``, or for an unsupported servo its name or number.
        firmware: Firmware version.
        max_current_a: Largest current limit; None if it is not supported.
    """

    port: str
    baud_rate: int
    id: int
    model: str
    firmware: int
    max_current_a: float | None


@dataclass(frozen=True, slots=True)
class PortScan:
    """Servos on one serial port; or why it could not be searched, which is empty otherwise."""

    port: str
    servos: list[FoundServo]
    problem: str


def keep_only(config: Config, unit: Literal["servo", "camera", "load_cell"]) -> Config:
    """Returns the configuration without the other sensors, so that their failures do not hide this one's.

    A simulated rig has no object, because one that does not fit would hide the unit, too.
    """
    others = {"camera", "load_cell"} - {unit}
    return config.with_values(object="none", **{name: {"backend": "none"} for name in others})


def gather(devices: Devices, take: Callable[[], Iterable[T]]) -> list[T]:
    """Collects the items of a sensor for one second from the first one on. May be empty."""
    clock, items = devices.clock, list[T]()
    end_ns = clock.now_ns() + _FIRST_NS
    while (now_ns := clock.now_ns()) < end_ns:
        devices.check()
        new = list(take())
        if new and not items:
            end_ns = now_ns + _MEASURE_NS
        items += new
        clock.sleep_until_ns(now_ns + _POLL_NS)
    return items


def clock_name(config: Config) -> str:
    """Name of the time that the run's clock keeps."""
    return "simulated time" if config.clock == "lockstep" else "real time"


def rate_hz(times_ns: list[int]) -> float:
    """Rate of events at two or more times."""
    return (len(times_ns) - 1) * NS_PER_S / max(1, times_ns[-1] - times_ns[0])


def time_ms(call: Callable[[], object], count: int) -> tuple[float, float]:
    """Median and 99th percentile of the time that ``call`` takes, in ms."""
    times_ns = []
    for _ in range(count):
        start_ns = time.perf_counter_ns()
        call()
        times_ns.append(time.perf_counter_ns() - start_ns)
    median_ms, p99_ms = np.percentile(times_ns, (50, 99)) / NS_PER_MS
    return float(median_ms), float(p99_ms)


def judged(unit: str, name: str, found: str, good: bool, advice: str, *, harmless: bool = False) -> Check:
    """Makes a check, with advice if it is not good. A harmless one does not count as a problem."""
    return Check(unit, name, found, True) if good else Check(unit, name, found, harmless, advice)


def open_load_cell(config: Config, clock: Clock) -> Any:
    """Opens the configured load cell alone, without a simulated world.

    Raises:
        ConfigError: The backend is unknown, simulated, or ``none``.
    """
    name = config.load_cell.backend
    if name in ("none", "simulated"):
        raise ConfigError(f"this needs a real load cell, but load_cell.backend is {name!r}; name yours")
    return load_class("load_cells", LOAD_CELLS, name, "load_cell.backend")(config.load_cell, clock)
