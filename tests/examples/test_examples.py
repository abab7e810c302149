"""The examples of the library, run as a user runs them: in lockstep, and in real time behind a pseudo-terminal."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

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


def start(name: str, *arguments: object) -> "subprocess.Popen[str]":
    command = [sys.executable, "-u", str(EXAMPLES / name), *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def run_beside_examples(*arguments: str | Path) -> "subprocess.CompletedProcess[str]":
    """Runs Python with the examples on its path."""
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(EXAMPLES), os.environ.get("PYTHONPATH", "")])}
    command = [sys.executable, *arguments]
    return subprocess.run(command, capture_output=True, text=True, env=env, timeout=120, check=False)


def test_embed_fits_on_a_page() -> None:
    assert len((EXAMPLES / "embed.py").read_text().splitlines()) <= 26


def test_embed_holds_an_object_in_lockstep(lockstep: Path) -> None:
    with start("embed.py", lockstep) as process:
        out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    results = [line for line in out.splitlines() if "GraspResult" in line]
    assert len(results) == 3
    assert "held" in results[0]
    assert "held" in results[1]
    assert any(" N at " in line for line in out.splitlines())


def test_embed_in_real_time_without_an_object(real_time: Path, server: PtyServer) -> None:
    with start("embed.py", real_time) as process:
        out, err = process.communicate(timeout=120)
    assert process.returncode == 1
    assert "no_object" in out
    assert "RequestError: no object is gripped" in err  # an exception in the caller's code
    assert server.bus.servos[0].get("torque_enable") == 0


def test_ctrl_c_ends_embed_without_torque(real_time: Path, server: PtyServer) -> None:
    with start("embed.py", real_time) as process:
        assert process.stdout is not None
        while "approach" not in process.stdout.readline():
            assert process.poll() is None
        assert server.bus.servos[0].get("torque_enable") == 1
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=60)
    assert "KeyboardInterrupt" in err
    assert process.returncode != 0
    assert server.bus.servos[0].get("torque_enable") == 0


def test_an_own_camera_serves_a_grasp_that_holds() -> None:
    with start("own_camera.py") as process:
        out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    assert "held" in out
    assert "(64, 64)" in out


OWN_CAMERA_IN_REAL_TIME = """
import sys
import gripper_force as gf
overrides = {"clock": "realtime", "servo.port": sys.argv[1], "servo.bus_watchdog_ms": 2540,
    "servo.reply_margin_ms": 500, "load_cell.backend": "none", "camera.backend": "own_camera:PatternCamera",
    "vision.checkpoint": "none", "control.feedback": "current"}
with gf.open_gripper(overrides=overrides) as gripper:
    gripper.move(0.06)
    assert gripper.frame.gray.shape == (128, 128)
    print("frames", gripper.frame.seq > 10)
"""


def test_own_camera_in_real_time(server: PtyServer) -> None:
    done = run_beside_examples("-c", OWN_CAMERA_IN_REAL_TIME, server.device_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "frames True\n"


def test_own_camera_satisfies_the_contract(tmp_path: Path) -> None:
    program = (
        "import pytest, own_camera, gripper_force as gf\n"
        "from gripper_force.runtime.backends import MonotonicClock\n"
        "from gripper_force.testing.camera_contract import CameraContract\n"
        "class TestPatternCamera(CameraContract):\n"
        "    @pytest.fixture\n"
        "    def camera(self):\n"
        "        return own_camera.PatternCamera(gf.CameraConfig(), MonotonicClock())\n"
    )
    (tmp_path / "test_own.py").write_text(program)
    done = run_beside_examples("-m", "pytest", "-q", "-p", "no:cacheprovider", tmp_path / "test_own.py")
    assert done.returncode == 0, done.stdout
