"""A known mass on a simulated jaw, with known torque constant and friction."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from gripper_calibration.procedures import calibrate_weight as procedure
from gripper_calibration.procedures.calibrate_weight import PLACES, WeightResult, calibrate_weight, masses_kg
from gripper_force.cli import app
from gripper_force.config import Config, load_config
from gripper_force.errors import ConfigError, DataError, DeviceError
from gripper_hw.dynamixel.control_table import load_model
from gripper_hw.dynamixel.virtual import VirtualBus, find_bus
from gripper_hw.sim.scene import draw_scene

GRIPPERS = Path(__file__).parents[3] / "examples" / "grippers"


def true_nm_per_a(config: Config) -> float:
    return load_model(config.servo.model).nm_per_a * draw_scene("none", config.seed, config.sim).nm_per_a


def measure(config: Config, mass_kg: float = 0.5) -> WeightResult:
    return calibrate_weight(config, mass_kg, prompt=lambda _: None)


@pytest.mark.parametrize(("seed", "friction_n"), [(7, 0.5), (1, 1.5)])
def test_the_torque_constant_is_found_whatever_the_configured_friction(seed: int, friction_n: float) -> None:
    config = load_config(None, [f"seed={seed}", f"gripper.friction_n={friction_n}"])
    found = measure(config, 0.4 if friction_n == 1.5 else 0.5)
    assert found.nm_per_a.low is not None
    assert found.nm_per_a.high is not None
    assert found.nm_per_a.low < true_nm_per_a(config) < found.nm_per_a.high
    assert found.nm_per_a.half < 0.03 * found.nm_per_a.value
    assert found.settings["nm_per_a"] == found.nm_per_a.value


def test_the_torque_constant_is_found_through_a_linkage_that_moves_the_jaws_on_rails() -> None:
    config = load_config(GRIPPERS / "viperx_aloha.yaml", ["seed=4"])
    least_kg, most_kg = masses_kg(config)
    found = measure(config, (least_kg + most_kg) / 2)
    assert found.nm_per_a.value == pytest.approx(true_nm_per_a(config), rel=0.03)


@pytest.mark.parametrize("name", ["rotary_finger", "four_bar", "two_servos"])
def test_other_grippers_are_refused(name: str) -> None:
    with pytest.raises(ConfigError, match="use a load cell"):
        measure(load_config(GRIPPERS / f"{name}.yaml"))


@pytest.mark.parametrize("mass_kg", [0.0, -1.0, 0.1, 5.0, float("nan")])
def test_an_unsuitable_mass_is_refused(mass_kg: float) -> None:
    with pytest.raises(ConfigError, match=r"use one of 0\.204 to 0\.8\d* kg"):
        measure(load_config(None), mass_kg)


def test_a_force_limit_that_lifts_no_mass_is_named() -> None:
    with pytest.raises(ConfigError, match="raise the limit, or use a load cell"):
        measure(load_config(None, ["control.force_limit_n=3"]))


def fit(step_n: float, breakaway_n: float) -> WeightResult:
    """The result if a weight of 4 N changes the motor force at each jaw by so much."""
    config = load_config(None, ["gripper.nm_per_a=1.8", "gripper.friction_n=0.9"])
    middle_n, half_n = np.zeros(len(PLACES)), np.full(len(PLACES), breakaway_n)
    empty = procedure._Balance(middle_n + half_n, middle_n - half_n)
    loaded = procedure._Balance(empty.up_n + step_n, empty.down_n + step_n)
    return procedure._fit(config, empty, loaded, 4.0)


def test_friction_that_contradicts_the_breakaway_is_not_proposed() -> None:
    assert fit(2.0, 1.0).settings.keys() == {"nm_per_a", "gain_std", "friction_n"}
    for breakaway_n in (0.3, 2.0):
        assert fit(2.0, breakaway_n).settings.keys() == {"nm_per_a", "gain_std"}


@pytest.mark.parametrize("step_n", [1.0, 4.0, 0.0, -2.0])
def test_another_mass_than_the_stated_one_is_refused(step_n: float) -> None:
    with pytest.raises(DataError, match="check that it hangs freely"):
        fit(step_n, 1.0)


def test_the_torque_constant_of_a_weak_motor_with_little_friction_is_found() -> None:
    config = load_config(None, ["sim.friction=0.2", "sim.gain=0.75", "gripper.friction_n=0.3"])
    assert measure(config, 0.7).ratio == pytest.approx(0.75, rel=0.02)


def test_a_wrong_closing_direction_is_named() -> None:
    with pytest.raises((DataError, DeviceError), match=r"closing_sign|stopped"):
        measure(load_config(None, ["gripper.closing_sign=-1"]))


def test_a_mass_that_the_jaws_cannot_lift_ends_with_its_remedy_and_without_torque() -> None:
    buses: list[VirtualBus | None] = []

    def progress(text: str, steps: int = 1) -> None:
        buses.append(find_bus("rig"))

    with pytest.raises((DataError, DeviceError), match=r"take a smaller mass|stopped"):
        calibrate_weight(
            load_config(None, ["sim.hanging_mass_kg=3"]), 0.3, prompt=lambda _: None, progress=progress
        )
    assert len(buses) > len(PLACES)
    assert all(bus is not None and bus.servos[0].get("torque_enable") == 0 for bus in buses)


def test_the_command_proposes_a_configuration() -> None:
    result = CliRunner().invoke(app, ["calibrate", "weight", "--mass-kg", "0.5", "--yes", "--json"])
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert set(found["settings"]) == {"nm_per_a", "gain_std", "friction_n"}
    overrides = [f"gripper.{key}={value}" for key, value in found["settings"].items()]
    assert load_config(None, overrides).gripper.nm_per_a == found["nm_per_a"]["value"]
    assert found["nm_per_a"]["low"] < true_nm_per_a(load_config()) < found["nm_per_a"]["high"]


def test_a_script_cannot_hang_up_a_real_mass() -> None:
    arguments = ["calibrate", "weight", "--mass-kg", "0.5", "--yes", "--set", "servo.port=/dev/ttyUSB9"]
    result = CliRunner().invoke(app, [*arguments, "--set", "clock=realtime", "--set", "camera.backend=none"])
    assert isinstance(result.exception, ConfigError)
    assert "leave out --yes" in str(result.exception)
