import pytest

from gripper_force.config import Config, load_config
from gripper_force.errors import ConfigError
from gripper_force.runtime.assembly import (
    checkpoint_of,
    controller_from,
    make_controller,
    make_estimator,
    settled,
)
from gripper_force.runtime.backends import open_devices


def test_a_configuration_that_met_no_servo_controls_nothing() -> None:
    with pytest.raises(ConfigError, match=r"gripper\.nm_per_a is not set"):
        controller_from(Config())


def test_the_servo_completes_what_is_left_open() -> None:
    config = load_config(None, ["camera.backend=none", "load_cell.backend=none"])
    with open_devices(config) as devices:
        completed, _ = make_controller(config, devices)
        servo = devices.servo
    assert completed.gripper.nm_per_a == servo.nm_per_a
    assert completed.gripper.current_step_a == servo.current_step_a
    low_v, high_v = servo.voltage_range_v
    assert completed.control.voltage_limits_v is not None
    assert completed.control.voltage_limits_v[0] < low_v < high_v < completed.control.voltage_limits_v[1]
    controller_from(completed)


def test_what_is_configured_is_kept() -> None:
    said = ["gripper.nm_per_a=1.5", "gripper.current_step_a=0.001", "control.voltage_limits_v=[11, 13]"]
    config = load_config(None, ["camera.backend=none", "load_cell.backend=none", *said])
    with open_devices(config) as devices:
        completed, _ = make_controller(config, devices)
    assert completed == config


@pytest.mark.parametrize("blind", ["camera.backend=none", "vision.checkpoint=none"])
def test_a_run_without_vision_has_no_network(blind: str) -> None:
    config = load_config(None, [blind])
    assert checkpoint_of(config) is None
    assert make_estimator(config, None, None) is None


def test_auto_becomes_a_network_and_an_engine_with_the_reason() -> None:
    named = load_config(None, [])
    assert settled(named) == (named, "")
    config, why = settled(load_config(None, ["vision.checkpoint=auto"]))
    assert "auto" not in (config.vision.checkpoint, config.vision.engine)
    assert config.vision.checkpoint in why


@pytest.mark.parametrize(
    ("slow", "sentence"),
    [
        (["control.rate_hz=10", "servo.bus_watchdog_ms=500"], "too slow for a force loop; set at least 20"),
        (["control.rate_hz=40"], "servo.bus_watchdog_ms 40 would stop by itself; set the rate to 50 or more"),
    ],
)
def test_a_loop_too_slow_for_itself_or_for_the_servo_is_refused(slow: list[str], sentence: str) -> None:
    config = load_config(None, ["camera.backend=none", "load_cell.backend=none", *slow])
    with open_devices(config) as devices, pytest.raises(ConfigError, match=sentence):
        make_controller(config, devices)
