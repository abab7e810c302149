import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from gripper_force.config import ServoConfig
from gripper_force.interfaces import BusStats, ServoSpec
from gripper_force.testing.servo_contract import ServoContract
from gripper_force.types import ServoCommand, ServoState


class Scaled:
    """A horn that turns at 1 rad/s against 0.1 A; velocity and current are multiplied by factors."""

    def __init__(self, velocity: float, current: float) -> None:
        self._velocity, self._current = velocity, current
        self._state = ServoState(0, 0.0, 0.0, 0.0, 30.0, 12.0, 0)
        self._goal_rad = 0.0
        self.stats = BusStats()

    @staticmethod
    def spec(config: ServoConfig) -> ServoSpec:
        return ServoSpec(1.78, 0.00269, (10.0, 14.8))

    def start(self) -> ServoState:
        return self._state

    def read(self) -> ServoState:
        old, step_rad = self._state, min(0.005, self._goal_rad - self._state.position_rad)
        self._state = replace(
            old,
            t_ns=old.t_ns + 5_000_000,
            position_rad=old.position_rad + step_rad,
            velocity_rad_s=self._velocity * step_rad / 0.005,
            current_a=self._current * 0.1,
        )
        return self._state

    def write(self, command: ServoCommand) -> None:
        self._goal_rad = command.goal_position_rad

    def stop(self, *, hold: bool) -> None: ...

    def close(self) -> None: ...


def check(velocity: float = 1.0, current: float = 1.0) -> None:
    ServoContract().test_velocity_and_current_belong_to_the_motion(
        Scaled(velocity, current), ServoConfig(), lambda: None, 0.2, 0.4
    )


def test_right_units_pass() -> None:
    check()


@pytest.mark.parametrize(
    "factors",
    [{"velocity": 30 / math.pi}, {"velocity": -1.0}, {"velocity": 0.0}, {"current": 1e3}, {"current": -1.0}],
)
def test_wrong_units_and_signs_of_velocity_and_current_fail(factors: dict[str, float]) -> None:
    with pytest.raises(AssertionError):
        check(**factors)


def test_second_servo_that_should_have_been_refused_is_stopped_and_closed(tmp_path: Path) -> None:
    module = tmp_path / "test_shared.py"
    module.write_text(
        f"""
import sys

import pytest

sys.path.insert(0, {str(Path(__file__).parent)!r})
from test_servo_contract import Scaled
from gripper_force.testing.servo_contract import ServoContract


class Noted(Scaled):
    def stop(self, *, hold): print("stopped")
    def close(self): print("closed")


class TestShared(ServoContract):
    @pytest.fixture
    def servo(self): return Scaled(1.0, 1.0)

    @pytest.fixture
    def second_servo(self): return Noted(1.0, 1.0)
""",
        encoding="utf-8",
    )
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-s",
        "-p",
        "no:cacheprovider",
        "-k",
        "second_servo",
        str(module),
    ]
    run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert "DID NOT RAISE" in run.stdout
    assert "stopped\nclosed\n" in run.stdout
