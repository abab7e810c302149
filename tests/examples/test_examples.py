"""The examples of the library: in lockstep, and in real time behind a pseudo-terminal."""

import runpy
import signal
import subprocess
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import pytest
import yaml

import gripper_force as gf
from gripper_force.interfaces import Camera, Clock
from gripper_force.testing.camera_contract import CameraContract
from gripper_hw.dynamixel.pty_server import PtyServer

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture
def lockstep(tmp_path: Path) -> Path:
    return write(tmp_path / "lockstep.yaml", {"object": "stapler", "sim": {"detail": "coarse"}})


@pytest.fixture
def real_time(tmp_path: Path, server: PtyServer) -> Path:
    servo = {"port": server.device_path, "bus_watchdog_ms": 2540, "reply_margin_ms": 500}
    return write(
        tmp_path / "real.yaml", {"clock": "realtime", "servo": servo, "load_cell": {"backend": "none"}}
    )


def write(path: Path, keys: dict[str, object]) -> Path:
    current = {"camera": {"backend": "none"}, "control": {"feedback": "current", "timeout_s": 3.0}}
    path.write_text(yaml.safe_dump({**current, **keys}))
    return path


@pytest.fixture
def beside_examples(monkeypatch: pytest.MonkeyPatch) -> None:
    """Makes the modules in the folder importable, as they are for a program in it."""
    monkeypatch.syspath_prepend(EXAMPLES)


@pytest.fixture
def run(beside_examples: None, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Runs an example as the main program, with arguments."""

    def run(name: str, *arguments: Path) -> None:
        monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")

    return run


def test_embed_fits_on_a_page() -> None:
    assert len((EXAMPLES / "embed.py").read_text().splitlines()) <= 26


def test_embed_holds_an_object_in_lockstep(
    run: Callable[..., None], lockstep: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run("embed.py", lockstep)
    lines = capsys.readouterr().out.splitlines()
    results = [line for line in lines if "GraspResult" in line]
    assert len(results) == 3
    assert "held" in results[0]
    assert "held" in results[1]
    assert any(" N at " in line for line in lines)


def test_embed_in_real_time_without_an_object(
    run: Callable[..., None], real_time: Path, server: PtyServer, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(gf.RequestError, match="no object is gripped"):  # in the caller's code
        run("embed.py", real_time)
    assert "no_object" in capsys.readouterr().out
    assert server.bus.servos[0].get("torque_enable") == 0


def test_ctrl_c_ends_embed_without_torque(real_time: Path, server: PtyServer) -> None:
    command = [sys.executable, "-u", str(EXAMPLES / "embed.py"), str(real_time)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        while "approach" not in process.stdout.readline():
            assert process.poll() is None
        assert server.bus.servos[0].get("torque_enable") == 1
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=60)
    assert "KeyboardInterrupt" in err
    assert process.returncode != 0
    assert server.bus.servos[0].get("torque_enable") == 0


def test_an_own_camera_serves_a_grasp_that_holds(
    run: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    run("own_camera.py")
    out = capsys.readouterr().out
    assert "held" in out
    assert "(64, 64)" in out


@pytest.mark.usefixtures("beside_examples")
def test_own_camera_in_real_time(server: PtyServer) -> None:
    overrides = {
        "clock": "realtime",
        "servo.port": server.device_path,
        "servo.bus_watchdog_ms": 2540,
        "servo.reply_margin_ms": 500,
        "load_cell.backend": "none",
        "camera.backend": "own_camera:PatternCamera",
        "vision.checkpoint": "none",
        "control.feedback": "current",
    }
    with gf.open_gripper(overrides=overrides) as gripper:
        gripper.move(0.06)
        assert gripper.frame is not None
        assert gripper.frame.gray.shape == (128, 128)
        assert gripper.frame.seq > 10


class TestPatternCamera(CameraContract):
    @pytest.fixture
    def clock(self, clock: Clock) -> Clock:
        """The simulated clock, which waits for nothing."""
        return clock

    @pytest.fixture
    def camera(self, beside_examples: None, clock: Clock) -> Camera:
        camera: Camera = import_module("own_camera").PatternCamera(gf.CameraConfig(), clock)
        return camera
