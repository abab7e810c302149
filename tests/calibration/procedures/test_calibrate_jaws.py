"""Homing on the simulated rig, whose ends, closing direction and friction are known."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

import gripper_force as gf
from gripper_calibration.procedures import calibrate_jaws as procedure
from gripper_calibration.procedures.calibrate_jaws import JawsResult, calibrate_jaws
from gripper_force.cli import app
from gripper_force.config import Config, load_config
from gripper_force.control.linkage import make_linkage
from gripper_force.errors import DataError, DeviceError
from gripper_force.interfaces import Devices
from gripper_force.progress import Progress, Prompt
from gripper_force.runtime.backends import open_devices
from gripper_force.types import ServoState
from gripper_hw.dynamixel.servo import DynamixelServo
from gripper_hw.dynamixel.virtual import VirtualBus, find_bus
from gripper_hw.sim.scene import draw_scene

# The simulated jaws stop 1 mm before they meet, and 4 mm beyond the nominal open position.
GRIPPERS = Path(__file__).parents[3] / "examples" / "grippers"
OPEN_END_RAD = -0.004 / 0.020
CLOSED_END_RAD = (0.046 - 0.001) / 0.020


def config_of(*overrides: str) -> Config:
    return load_config(None, ["object=none", "sim.detail=coarse", "camera.backend=none", *overrides])


@cache
def home(*overrides: str) -> JawsResult:
    """The result with these settings, which several tests read."""
    asked: list[str] = []
    result = calibrate_jaws(config_of(*overrides), prompt=lambda text: asked.append(text))
    assert asked == ["Take everything from between the jaws and open them by hand"]
    return result


LITTLE = ("gripper.friction_n=0.1",)
WRONG = ("gripper.closing_sign=-1", "gripper.open_position_rad=2", "gripper.friction_n=5")


@pytest.mark.parametrize("overrides", [LITTLE, WRONG], ids=["little friction", "wrong"])
def test_ends_direction_and_friction_are_found_with_any_configuration(overrides: tuple[str, ...]) -> None:
    result = home("seed=3", *overrides)
    scene = draw_scene("none", 3, config_of().sim)
    friction_n = (scene.servo_friction_nm / 0.040 + scene.jaw_friction_n) / scene.nm_per_a
    assert result.closing_sign == 1
    assert result.open_end_rad == pytest.approx(OPEN_END_RAD, abs=0.06)
    assert result.closed_end_rad == pytest.approx(CLOSED_END_RAD, abs=0.06)
    assert result.friction_n == pytest.approx(friction_n, rel=0.12)
    for breakaway_n, running_n in zip(result.breakaway_n, result.running_n, strict=True):
        assert running_n < breakaway_n < 1.5 * running_n
    assert result.open_width_m == pytest.approx(0.100, abs=0.003)


@pytest.mark.parametrize("name", ["four_bar", "rotary_finger", "two_servos", "viperx_aloha"])
def test_every_other_linkage_is_homed(name: str) -> None:
    overrides = ["object=none", "sim.detail=coarse", "camera.backend=none", "seed=5"]
    config = load_config(GRIPPERS / f"{name}.yaml", overrides)
    result = calibrate_jaws(config, prompt=lambda text: None)
    assert result.closing_sign == config.gripper.closing_sign
    assert result.open_width_m == config.gripper.open_width_m
    open_rad = make_linkage(config.gripper).closing_rad(result.open_width_m)
    assert result.open_position_rad == pytest.approx(open_rad, abs=0.07)
    assert result.position_bound_rad is not None
    assert abs(result.open_position_rad - config.gripper.open_position_rad) < result.position_bound_rad < 0.3
    assert yaml.safe_load(result.yaml)["gripper"]["position_bound_rad"] == round(result.position_bound_rad, 2)


def test_its_proposal_makes_a_grasp_possible() -> None:
    proposed = yaml.safe_load(home("seed=3", *WRONG).yaml)["gripper"]
    overrides = [f"gripper.{key}={value}" for key, value in proposed.items()]
    config = load_config(
        None, ["object=sponge", "sim.detail=coarse", "camera.backend=none", "seed=3", *overrides]
    )
    with gf.open_gripper(config) as gripper:
        assert gripper.grasp(3.0).outcome == "held"


def test_friction_beyond_the_configured_one_is_overcome() -> None:
    result = home("seed=3", "sim.friction=2.5")
    assert result.friction_n == pytest.approx(0.95 * 2.5, rel=0.15)
    # The simulated stops give by 2 mm under the current that this friction needs.
    assert result.closed_end_rad == pytest.approx(CLOSED_END_RAD, abs=0.1)


def test_an_object_between_the_jaws_is_pressed_gently(monkeypatch: pytest.MonkeyPatch) -> None:
    forces_n: list[float] = []

    @contextmanager
    def observed(config: Config) -> Iterator[Devices]:
        with open_devices(config) as devices:
            assert devices.observe_world is not None
            devices.observe_world(lambda state: forces_n.append(state.force_n))
            yield devices

    monkeypatch.setattr(procedure, "open_devices", observed)
    with pytest.raises(DataError, match="nothing lies between"):
        home("object=sponge")
    assert 0.3 < max(forces_n) < 2.0


def test_jaws_that_nothing_moves_are_named() -> None:
    with pytest.raises(DataError, match=r"the jaws move by 0\.00 rad only, .* with all the current"):
        home("sim.friction=20")


def test_contradictory_travel_is_refused() -> None:
    with pytest.raises(
        DataError, match=r"move by 1\.50 rad between their ends, but the configured geometry has 2\.30 rad"
    ):
        procedure._proposal(config_of(), -0.2, 1.3, 1)


def test_half_open_jaws_are_refused() -> None:
    with pytest.raises(DataError, match="the jaws were not open at the start"):
        procedure._check_ends(1.0, 0.0, 2.0, 0.0)


@pytest.mark.parametrize(
    ("breakaway_n", "running_n", "message"),
    [
        ((1.0, 1.0), (0.9, 0.2), "a cable or a weight"),
        ((0.1, 1.0), (0.9, 0.9), "begin to move"),
    ],
)
def test_contradictory_friction_is_refused(
    breakaway_n: tuple[float, float], running_n: tuple[float, float], message: str
) -> None:
    with pytest.raises(DataError, match=message):
        procedure._check_friction(breakaway_n, running_n)


def test_jaws_that_something_stops_meanwhile_end_the_measurement(monkeypatch: pytest.MonkeyPatch) -> None:
    buses: list[VirtualBus | None] = []
    stopped: list[ServoState] = []
    is_blocked: list[bool] = []
    read = DynamixelServo.read

    def observed(servo: DynamixelServo) -> ServoState:
        buses[:] = [find_bus("rig")]
        state = read(servo)
        if not is_blocked:
            return state
        stopped.append(state)
        return replace(state, position_rad=stopped[0].position_rad, velocity_rad_s=0.0)

    def progress(text: str, steps: int = 1) -> None:
        if text == "measuring friction":
            is_blocked.append(True)

    monkeypatch.setattr(DynamixelServo, "read", observed)
    with pytest.raises(
        DataError, match="rad, although they moved there before; check that nothing blocks them"
    ):
        calibrate_jaws(config_of(), prompt=lambda text: None, progress=progress)
    assert buses[0] is not None
    assert buses[0].servos[0].get("torque_enable") == 0


def test_device_failure_turns_torque_off(monkeypatch: pytest.MonkeyPatch) -> None:
    buses: list[VirtualBus | None] = []
    read = DynamixelServo.read

    def hot(servo: DynamixelServo) -> ServoState:
        buses[:] = [find_bus("rig")]
        return replace(read(servo), temperature_c=99.0)

    monkeypatch.setattr(DynamixelServo, "read", hot)
    with pytest.raises(DeviceError, match="the servo is at 99 C"):
        home()
    assert buses[0] is not None
    assert buses[0].servos[0].get("torque_enable") == 0


def test_command_prints_the_configuration(monkeypatch: pytest.MonkeyPatch) -> None:
    configs: list[Config] = []

    def homed(config: Config, *, prompt: Prompt, progress: Progress) -> JawsResult:
        configs.append(config)
        prompt("Take everything from between the jaws")
        progress("moving", 0)
        return home("seed=3", *LITTLE)

    monkeypatch.setattr(procedure, "calibrate_jaws", homed)
    call = ["calibrate", "jaws", "--yes", "--set", "object=none", "--set", "sim.detail=coarse"]
    done = CliRunner().invoke(app, call, catch_exceptions=False)
    assert done.exit_code == 0
    assert "closing_sign: 1" in done.stdout
    assert (
        "next: gripper-force calibrate servo --gauge-mm 30 --set object=block --set sim.detail" in done.stderr
    )
    found = json.loads(CliRunner().invoke(app, [*call, "--json"]).stdout)
    assert found["closing_sign"] == 1
    assert found["open_width_m"] > 0.09
    assert configs == 2 * [load_config(None, ["object=none", "sim.detail=coarse"])]
