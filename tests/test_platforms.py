"""macOS: what only Linux has is left out, or refused in one sentence. Linux stands in, without what macOS lacks."""

import os
import pty
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from gripper_force.config import CameraConfig, Config
from gripper_force.errors import ConfigError, DeviceError
from gripper_force.jobs import doctor
from gripper_force.qualification.bench.command_bench import commands
from gripper_force.qualification.proc_files import process_text
from gripper_force.runtime import process
from gripper_force.runtime.backends import MonotonicClock
from gripper_force.vision import step_benchmark
from gripper_hw.cameras.uvc import UvcCamera
from gripper_hw.dynamixel.port import open_port
from gripper_hw.serial_line import ExclusiveSerial, open_line


@pytest.fixture
def macos(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "darwin")
    for name in [name for name in dir(os) if name.startswith("sched_")]:
        if name not in ("sched_yield", "sched_get_priority_min", "sched_get_priority_max"):
            monkeypatch.delattr(os, name)


@pytest.fixture
def device_path() -> Iterator[str]:
    """A pseudo-terminal."""
    ends = pty.openpty()
    yield os.ttyname(ends[1])
    for end in ends:
        os.close(end)


@pytest.mark.usefixtures("macos")
def test_real_time_priority_is_refused() -> None:
    with process.real_time_priority() as refusal:
        assert refusal == (
            "the control loop has no real-time priority, so cycles may start late; use Linux for a real gripper"
        )
    with process.real_time_settings() as refusal:  # no one allowed it
        assert refusal == ""


@pytest.mark.usefixtures("macos")
def test_a_port_has_one_user(device_path: str) -> None:
    line = open_line(device_path, 57_600, unit="servo", timeout_s=0)
    with pytest.raises(DeviceError, match=r"is in use by .* one that it can't see; close that first"):
        open_line(device_path, 57_600, unit="servo", timeout_s=0)
    line.close()
    open_line(device_path, 57_600, unit="servo", timeout_s=0).close()


@pytest.mark.usefixtures("macos")
def test_a_port_without_low_latency_mode_opens(device_path: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_port: ExclusiveSerial, _on: bool) -> None:  # as in serialposix.py without a platform's own
        raise NotImplementedError("Low latency not supported on this platform")

    monkeypatch.setattr(ExclusiveSerial, "set_low_latency_mode", refuse)
    open_port(device_path, 57_600, 100.0).closePort()


@pytest.mark.usefixtures("macos")
def test_a_usb_camera_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"camera\.backend=uvc needs Video4Linux, which only Linux has"):
        UvcCamera(CameraConfig(backend="uvc", device=0), MonotonicClock())


def test_a_measurement_of_proc_is_refused() -> None:
    with pytest.raises(
        ConfigError, match="reads /proc/self/no_such_file, which only Linux has; run it on Linux"
    ):
        process_text("no_such_file")
    if Path("/proc").is_dir():
        assert int(process_text("statm").split()[1]) > 0


@pytest.mark.usefixtures("macos")
def test_the_memory_of_a_command_is_counted_in_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    """As macOS counts it; Linux counts kilobytes."""
    taken = SimpleNamespace(ru_utime=0.1, ru_stime=0.0, ru_maxrss=100 * 2**20)
    wait = os.wait4
    monkeypatch.setattr(os, "wait4", lambda *which: (*wait(*which)[:2], taken))
    (cost,) = commands(["--version"])
    assert cost.memory_mb == 100.0


@pytest.mark.usefixtures("macos")
def test_doctor_has_a_row_for_everything(monkeypatch: pytest.MonkeyPatch, tiny_checkpoint: Any) -> None:
    monkeypatch.setattr(step_benchmark, "cpu_info", list)
    config = Config().with_values(vision={"checkpoint": str(tiny_checkpoint)})
    checks = [
        *doctor._guarded("network", doctor._network(config)),
        *doctor._guarded("clock", doctor._clock(config)),
    ]
    assert not [check for check in checks if "defect" in check.advice]
    found = {(check.unit, check.name): check for check in checks}
    assert found["network", "bfloat16"].found == "not in this CPU"
    assert found["clock", "priority"].advice == "use Linux for a real gripper"


RENDER = """
import ctypes.util, os, sys
sys.platform = "darwin"
from gripper_hw.sim.engine import mujoco, new_renderer
assert os.environ["MUJOCO_GL"] == "cgl"
model = mujoco.MjModel.from_xml_string("<mujoco/>")
mujoco.mj_step(model, mujoco.MjData(model))
try:
    new_renderer(model, 64)
except Exception as error:
    print(type(error).__name__, error)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="a Mac has that renderer")
def test_the_simulation_asks_for_apples_renderer() -> None:
    """Linux has none, so the rendering is refused, in other words than those for a missing EGL."""
    environment = {key: value for key, value in os.environ.items() if key != "MUJOCO_GL"}
    done = subprocess.run(
        [sys.executable, "-c", RENDER],
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert done.stdout.startswith("SimulationError MuJoCo cannot render on this machine (")
    assert "EGL" not in done.stdout
