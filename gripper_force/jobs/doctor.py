"""Diagnostics: checks that every configured device is present and fast enough.

Each device package provides a probe module; see `PROBES`.
"""

import os
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from importlib import import_module, metadata
from typing import Final

import numpy as np

from gripper_force.config import Config
from gripper_force.errors import GripperError, UnfamiliarFrameError
from gripper_force.jobs.checks import Check, Confirm, PortScan, SetupResult, judged, time_ms
from gripper_force.progress import Progress, no_progress
from gripper_force.runtime.backends import MonotonicClock
from gripper_force.runtime.process import real_time_priority
from gripper_force.runtime.resolve import ResolvedConfig, make_estimator, resolve_vision
from gripper_force.schema import Tree
from gripper_force.types import NS_PER_MS

PROBES: Final = {
    "servo": "gripper_hw.dynamixel.servo_probe",
    "camera": "gripper_hw.cameras.camera_probe",
    "load cell": "gripper_hw.load_cells.load_cell_probe",
    "simulation": "gripper_hw.sim.simulation_probe",
}
"""Modules with a function ``probe(config)`` that yields checks, in the order of the table."""

_SCAN: Final = "gripper_hw.dynamixel.servo_scan"
_SLEEP_MS: Final = 5

_OPENCV: Final = (
    "opencv-contrib-python-headless",
    "opencv-contrib-python",
    "opencv-python-headless",
    "opencv-python",
)
"""Distributions that contain a module ``cv2``; the one installed last overwrites that of the others."""


def doctor(config: Config) -> Iterator[Check]:
    """Checks every device and this machine. Nothing moves, and nothing is written to a device.

    A failure becomes a row of the table; nothing is raised.
    """
    # PyTorch's Triton and Mesa's EGL each bring an LLVM; a process that loads Triton second crashes.
    network = list(_guarded("network", _network(config)))
    for unit in PROBES:
        yield from check_unit(config, unit)
    yield from network
    yield from _guarded("clock", _clock(config))
    yield from _guarded("opencv", _opencv())


def check_unit(config: Config, unit: str) -> Iterator[Check]:
    """Checks one unit of `PROBES`, as `doctor` does."""
    yield from _guarded(unit, _probe(PROBES[unit], config))


def setup(config: Config, confirm: Confirm, *, commission: bool = False) -> SetupResult:
    """Sets the registers of the configured servo to the values that a run needs, if ``confirm`` agrees.

    Args:
        config: The configuration.
        confirm: Called with the changes.
        commission: Only registers that survive power-off, among them Homing Offset and, if no other servo shares the
            bus, a baud rate of at least a million. ``confirm`` is then called once for each change.

    Raises:
        GripperError: The servo is missing, is another model, has torque on, or does not keep a value.
    """
    result: SetupResult = import_module(PROBES["servo"]).setup(config, confirm, commission=commission)
    return result


def serial_ports() -> list[str]:
    """Returns the paths of the serial ports that are plugged in, those that stay after a restart if there are such."""
    ports: list[str] = import_module(_SCAN).ports()
    return ports


def scan_servos(config: Config, ports: Iterable[str], progress: Progress = no_progress) -> list[PortScan]:
    """Looks for servos on each port at every baud rate of the X series. Nothing is written."""
    scans: list[PortScan] = import_module(_SCAN).scan(config, ports, progress=progress)
    return scans


def find_cameras() -> list[Tree]:
    """Returns the keys of the section ``camera`` for each camera that is plugged in."""
    cameras: list[Tree] = import_module(PROBES["camera"]).find()
    return cameras


def find_load_cell(config: Config, ports: Iterable[str], progress: Progress = no_progress) -> Tree | None:
    """Returns the keys of ``load_cell`` for the first port that sends a load cell's lines, or None."""
    section: Tree | None = import_module(PROBES["load cell"]).find(config, ports, progress)
    return section


def _probe(module: str, config: Config) -> Iterator[Check]:
    yield from import_module(module).probe(config)


def _guarded(unit: str, checks: Iterable[Check]) -> Iterator[Check]:
    try:
        yield from checks
    except GripperError as error:
        # An error message states the problem, then the remedy.
        problem, _, advice = str(error).partition("; ")
        yield Check(unit, "usable", problem, False, advice)
    except Exception as error:  # a defect of one probe must not hide the results of the others
        yield Check(
            unit, "usable", f"{type(error).__name__}: {error}", False, "a defect of gripper-force: report it"
        )


def _network(config: Config) -> Iterator[Check]:
    if not config.uses_vision:
        yield Check("network", "step", "not needed: no camera or no checkpoint", None)
        return
    from gripper_force.jobs.cpu import bfloat16_instructions
    from gripper_force.vision.step_benchmark import engine_version

    config, model, _ = resolve_vision(config)
    # The region is one of the camera's frames, which can be larger than those that this check makes.
    uncropped = config.with_values(vision={"region": None})
    estimator = make_estimator(ResolvedConfig(uncropped, model))
    assert model is not None  # the configuration has vision
    assert estimator is not None
    vision = config.vision
    package = f"{vision.engine} {engine_version(vision.engine)}".strip()
    threads = f"{vision.precision}, {vision.threads} of {os.cpu_count()} threads"
    yield Check("network", vision.engine, f"{package}, {threads}", True)
    yield Check("network", "bfloat16", bfloat16_instructions() or "not in this CPU", None)
    gray = np.random.default_rng(0).integers(0, 256, (128, 128), np.uint8)

    def step() -> None:
        with suppress(UnfamiliarFrameError):  # no network knows noise; it takes as long
            estimator.update(gray)

    for _ in range(model.header.preprocess.lead_in):
        step()
    median_ms, p99_ms = time_ms(step, 50)
    result = f"median {median_ms:.1f} ms, p99 {p99_ms:.1f} ms of 50"
    frame_ms = 1e3 / config.camera.rate_hz
    advice = (
        f"slower than the frames at camera.rate_hz={config.camera.rate_hz:g}: close other programs, or set "
        "vision.engine=auto or vision.checkpoint=small"
    )
    lockstep = config.clock == "lockstep"
    yield judged("network", "step", result, median_ms <= frame_ms, advice, harmless=lockstep)


def _opencv() -> Iterator[Check]:
    """Checks that one distribution gives ``cv2``, and that it has what this project calls."""
    import cv2

    installed = [f"{name} {found.version}" for name in _OPENCV for found in metadata.distributions(name=name)]
    remedy = f"pip uninstall {' '.join(_OPENCV)}, then pip install {_OPENCV[0]}"
    has_aruco = hasattr(getattr(cv2, "aruco", None), "ArucoDetector")
    found = f"cv2 {cv2.__version__} of {', '.join(installed) or 'no known distribution'}"
    if has_aruco:
        advice = f"each overwrites the module cv2 of the others, and to remove one breaks it: {remedy}"
        yield judged("opencv", "module", found, len(installed) <= 1, advice, harmless=True)
    else:
        yield Check("opencv", "module", f"{found} has no cv2.aruco.ArucoDetector", False, remedy)


def _clock(config: Config) -> Iterator[Check]:
    yield Check("clock", "resolution", f"{time.get_clock_info('monotonic').resolution * 1e9:.0f} ns", True)
    lockstep = config.clock == "lockstep"
    with real_time_priority() as refusal:
        advice = refusal.rpartition("; ")[2]
        result = "refused" if refusal else "granted"
        yield judged("clock", "priority", result, not refusal, advice, harmless=True)
    clock, late_ns = MonotonicClock(), []
    for _ in range(200):
        due_ns = clock.now_ns() + _SLEEP_MS * NS_PER_MS
        clock.sleep_until_ns(due_ns)
        late_ns.append(clock.now_ns() - due_ns)
    median_ms, p99_ms = np.percentile(late_ns, (50, 99)) / NS_PER_MS
    result = f"median {median_ms:.2f} ms, p99 {p99_ms:.2f} ms of 200 sleeps of {_SLEEP_MS} ms"
    cycle_ms = 1e3 / config.control.rate_hz
    advice = f"more than a cycle at control.rate_hz={config.control.rate_hz:g}: close other programs"
    yield judged("clock", "wakes late by", result, p99_ms <= cycle_ms, advice, harmless=lockstep)
