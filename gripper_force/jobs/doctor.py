"""Is everything there that the configuration names, and fast enough? One probe a room tells, row by row."""

import os
import re
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final, Literal, TypeVar

import numpy as np

from gripper_force.config import Config
from gripper_force.errors import GripperError
from gripper_force.interfaces import Devices
from gripper_force.runtime.backends import MonotonicClock
from gripper_force.runtime.priority import real_time_priority
from gripper_force.types import NS_PER_MS, NS_PER_S

PROBES: Final = {
    "servo": "gripper_hw.dynamixel.servo_probe",
    "camera": "gripper_hw.cameras.camera_probe",
    "load cell": "gripper_hw.load_cells.load_cell_probe",
    "simulation": "gripper_hw.sim.simulation_probe",
}
"""Modules with a function ``probe``, in the order of its table."""

_FIRST_NS: Final = 5 * NS_PER_S
"""How long a sensor may take to wake up: an Arduino restarts when its port is opened."""

_POLL_NS: Final = NS_PER_MS
_SLEEP_MS: Final = 5

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Check:
    """One row.

    Attributes:
        unit: What was looked at.
        name: What of it.
        found: What it is, with units.
        ok: False where something is to be done; None for what is only listed, as nobody asked for it.
        advice: What to do, or what to know.
    """

    unit: str
    name: str
    found: str
    ok: bool | None
    advice: str = ""


@dataclass(frozen=True, slots=True)
class RegisterChange:
    """A servo's register that `setup` would change, with units."""

    register: str
    old: str
    new: str


Agree = Callable[[str, list[RegisterChange]], bool]
"""Asked with a servo's name and what would change; True lets it happen."""


def doctor(config: Config) -> Iterator[Check]:
    """Looks at every device and at this machine. Nothing moves, and nothing is written to a device.

    What fails is a row; nothing is raised.
    """
    for unit, module in PROBES.items():
        yield from _guarded(unit, _room(module, config))
    yield from _guarded("network", _network(config))
    yield from _guarded("clock", _clock(config))


def setup(config: Config, agree: Agree) -> dict[str, Any]:
    """Brings the registers of the configured servo to what a run needs, if ``agree`` says so.

    Returns:
        ``servo``, ``changes`` and ``applied``.

    Raises:
        GripperError: The servo is not there, is another model, has torque on, or does not keep a value.
    """
    result: dict[str, Any] = import_module(PROBES["servo"]).setup(config, agree)
    return result


def only(config: Config, unit: Literal["servo", "camera", "load_cell"]) -> Config:
    """The configuration without the other sensors, so that one which fails does not hide the rest."""
    others = {"camera", "load_cell"} - {unit}
    return config.model_copy(
        update={name: getattr(config, name).model_copy(update={"backend": "none"}) for name in others}
    )


def gather(devices: Devices, take: Callable[[], Iterable[T]]) -> list[T]:
    """What a sensor gives within one second of the run's clock, from its first on. May be empty."""
    clock, taken = devices.clock, list[T]()
    end_ns = clock.now_ns() + _FIRST_NS
    while (now_ns := clock.now_ns()) < end_ns:
        devices.check()
        new = list(take())
        if new and not taken:
            end_ns = now_ns + NS_PER_S
        taken += new
        clock.sleep_until_ns(now_ns + _POLL_NS)
    return taken


def time_of(config: Config) -> str:
    """Which time a run's clock tells."""
    return "simulated time" if config.clock == "lockstep" else "real time"


def rate_hz(times_ns: list[int]) -> float:
    """Rate of events at these times, two or more."""
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
    """A check with advice where it is not good; ``harmless`` where a run can go on all the same."""
    return Check(unit, name, found, True) if good else Check(unit, name, found, harmless, advice)


def _room(module: str, config: Config) -> Iterator[Check]:
    yield from import_module(module).probe(config)


def _guarded(unit: str, checks: Iterable[Check]) -> Iterator[Check]:
    try:
        yield from checks
    except GripperError as error:
        # An error's sentence says what is wrong, then what to do.
        found, _, advice = str(error).partition("; ")
        yield Check(unit, "usable", found, False, advice)
    except Exception as error:  # a defect of one probe must not hide what the others find
        yield Check(unit, "usable", f"{type(error).__name__}: {error}", False, "a defect of ours: report it")


def _network(config: Config) -> Iterator[Check]:
    vision = config.vision
    if config.camera.backend == "none" or vision.checkpoint == "none":
        yield Check("network", "step", "not needed: no camera, or no checkpoint", None)
        return
    from gripper_force.runtime.assembly import settled
    from gripper_force.vision.estimator import open_estimator
    from gripper_force.vision.model_files import read_model
    from gripper_force.vision.selection import ENGINE_PACKAGES

    vision = settled(config)[0].vision
    package = ENGINE_PACKAGES[vision.engine]
    estimator = open_estimator(read_model(vision.checkpoint), vision)
    threads = f"{vision.precision}, {vision.threads} of {os.cpu_count()} threads"
    yield Check("network", vision.engine, f"{package} {version(package)}, {threads}", True)
    cpu = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    bfloat16 = re.search(r"\b(\w*bf16)\b", cpu)
    yield Check("network", "bfloat16", bfloat16[0] if bfloat16 else "not in this CPU", None)
    gray = np.random.default_rng(0).integers(0, 256, (128, 128), np.uint8)
    while estimator.update(gray) is None:
        pass
    median_ms, p99_ms = time_ms(lambda: estimator.update(gray), 50)
    found = f"median {median_ms:.1f} ms, p99 {p99_ms:.1f} ms of 50"
    frame_ms = 1e3 / config.camera.rate_hz
    advice = f"slower than frames come at camera.rate_hz={config.camera.rate_hz:g}: close what computes"
    lockstep = config.clock == "lockstep"
    yield judged("network", "step", found, median_ms <= frame_ms, advice, harmless=lockstep)


def _clock(config: Config) -> Iterator[Check]:
    yield Check("clock", "resolution", f"{time.get_clock_info('monotonic').resolution * 1e9:.0f} ns", True)
    lockstep = config.clock == "lockstep"
    with real_time_priority() as refusal:
        advice = refusal.rpartition("; ")[2]
        found = "refused" if refusal else "granted"
        yield judged("clock", "priority", found, not refusal, advice, harmless=True)
    clock, late_ns = MonotonicClock(), []
    for _ in range(200):
        due_ns = clock.now_ns() + _SLEEP_MS * NS_PER_MS
        clock.sleep_until_ns(due_ns)
        late_ns.append(clock.now_ns() - due_ns)
    median_ms, p99_ms = np.percentile(late_ns, (50, 99)) / NS_PER_MS
    found = f"median {median_ms:.2f} ms, p99 {p99_ms:.2f} ms of 200 sleeps of {_SLEEP_MS} ms"
    cycle_ms = 1e3 / config.control.rate_hz
    advice = f"more than a cycle at control.rate_hz={config.control.rate_hz:g}: close what computes"
    yield judged("clock", "wakes late by", found, p99_ms <= cycle_ms, advice, harmless=lockstep)
