import math
import re
from dataclasses import FrozenInstanceError
from pathlib import Path

import numpy as np
import pytest

from gripper_force.config import Config, load_config
from gripper_force.errors import ConfigError, RequestError
from gripper_force.jobs.profile_files import update_rig
from gripper_force.profiles.rig_profile import ServoCalibration
from gripper_force.runtime.log_writer import LogWriter
from gripper_force.runtime.resolve import ResolvedConfig, make_controller, make_estimator, resolve
from gripper_force.types import NS_PER_S, Frame
from gripper_force.vision.checkpoint_writer import replace_header
from gripper_force.vision.header import read_checkpoint
from gripper_hw.dynamixel.servo import DynamixelServo

NO_SENSORS = ["camera.backend=none", "load_cell.backend=none"]


def test_a_configuration_that_was_never_resolved_has_no_controller() -> None:
    with pytest.raises(ConfigError, match=r"gripper\.nm_per_a is not set"):
        make_controller(Config())


def test_servo_data_fill_in_what_is_left_open() -> None:
    config = resolve(load_config(None, NO_SENSORS)).config
    spec = DynamixelServo.spec(config.servo)
    assert config.gripper.nm_per_a == spec.nm_per_a
    assert config.gripper.current_step_a == spec.current_step_a
    low_v, high_v = spec.voltage_range_v
    assert config.control.voltage_limits_v is not None
    assert config.control.voltage_limits_v[0] < low_v < high_v < config.control.voltage_limits_v[1]
    make_controller(config)


@pytest.mark.parametrize("rate_hz", [5.0, 20.0, 60.0, 90.0])
def test_the_controller_knows_the_cameras_rate(rate_hz: float) -> None:
    control = resolve(
        load_config(None, [f"camera.rate_hz={rate_hz}", "vision.checkpoint=none"])
    ).config.control
    assert control.frame_hz == rate_hz
    assert 2 < control.vision_gap_ms * rate_hz / 1e3 < 3
    assert control.max_frame_age_ms == pytest.approx(100 + 1e3 / rate_hz - 1e3 / 60)
    assert control.plant[2] == pytest.approx(0.060 + 0.5 / rate_hz - 0.5 / 60)


def test_the_rate_of_a_log_is_that_of_its_frames(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with LogWriter(path, config="", metadata={}) as log:
        for seq in range(10):
            t_ns = seq * NS_PER_S // 25
            log.write(Frame(t_ns, t_ns, seq, np.zeros((8, 8), np.uint8)))
    keys = ["camera.backend=playback", f"camera.path={path}", "vision.checkpoint=none"]
    config = resolve(load_config(None, keys)).config
    assert config.camera.rate_hz == config.control.frame_hz == 25


def test_configured_values_are_kept() -> None:
    given = [
        "gripper.nm_per_a=1.5",
        "gripper.current_step_a=0.001",
        "gripper.position_loop_a_per_rad=4",
        "gripper.position_loop_gain_per_s=20",
        "control.voltage_limits_v=[11, 13]",
        "control.vision_rate_hz=25",
    ]
    config = load_config(None, [*NO_SENSORS, *given])
    assert resolve(config).config == config


@pytest.mark.parametrize(
    "key", ["open_position_rad=1.0", "open_position_rad=-1.0", "open_width_m=0.3", "pinion_radius_m=0.01"]
)
def test_a_travel_outside_the_servos_turn_is_refused(key: str) -> None:
    sign = -1 if key.endswith("-1.0") else 1
    with pytest.raises(ConfigError, match=r"leaves the servo's turn.*open_position_rad"):
        resolve(load_config(None, [*NO_SENSORS, f"gripper.{key}", f"gripper.closing_sign={sign}"]))


FINGER = Path(__file__).parents[2] / "examples" / "grippers" / "rotary_finger.yaml"


def test_a_pinion_radius_of_another_order_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"gripper\.pinion_radius_m=0\.2 moves the jaws .* in 0\.23 rad"):
        resolve(load_config(None, [*NO_SENSORS, "gripper.pinion_radius_m=0.2"]))
    finger = load_config(FINGER, [*NO_SENSORS, "gripper.pinion_radius_m=0.2"])
    assert resolve(finger).config.gripper.linkage.kind == "finger"


@pytest.mark.parametrize("nm_per_a", [0.178, 18.0])
def test_a_torque_constant_of_another_order_is_refused(nm_per_a: float) -> None:
    with pytest.raises(ConfigError, match=r"gripper\.nm_per_a=.* so that no force limit would hold"):
        resolve(load_config(None, [f"gripper.nm_per_a={nm_per_a}"]))


@pytest.mark.parametrize("key", ["camera.backend=none", "vision.checkpoint=none"])
def test_a_run_without_vision_has_no_network(key: str) -> None:
    run = resolve(load_config(None, [key]))
    assert run.model is None
    assert make_estimator(run) is None


def test_a_run_that_only_records_has_no_network() -> None:
    assert resolve(Config(), vision=False).model is None


def test_auto_becomes_a_network_and_an_engine_with_the_reason() -> None:
    assert resolve(Config()).choices == ()
    run = resolve(load_config(None, ["vision.checkpoint=auto"]))
    assert "auto" not in (run.config.vision.checkpoint, run.config.vision.engine)
    assert run.config.vision.checkpoint in run.choices[0]
    assert ("vision", run.choices[0]) in run.notes


def test_the_level_of_detail_is_chosen_before_devices_open() -> None:
    run = resolve(load_config(None, [*NO_SENSORS, "sim.detail=auto", "budget.sim_error_n=10"]))
    assert run.config.sim.detail != "auto"
    assert [unit for unit, _ in run.notes] == ["simulation"]


def test_resolving_again_changes_nothing() -> None:
    run = resolve(load_config(None, NO_SENSORS))
    assert resolve(run.config).config == run.config


def test_a_resolved_configuration_is_frozen() -> None:
    run = ResolvedConfig(Config())
    with pytest.raises(FrozenInstanceError):
        run.choices = ("x",)  # type: ignore[misc]


@pytest.mark.parametrize(
    ("slow", "message"),
    [
        (["servo.reply_margin_ms=40"], r"reply_margin_ms must be below servo\.bus_watchdog_ms 40"),
        (["control.rate_hz=10", "servo.bus_watchdog_ms=500"], "too slow for a force loop; set at least 20"),
        (["control.rate_hz=40"], "would stop by itself; set the rate to at least 50"),
    ],
)
def test_a_loop_too_slow_for_itself_or_for_the_servo_is_refused(slow: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        resolve(load_config(None, [*NO_SENSORS, *slow]))


@pytest.mark.parametrize("target_n", [9.01, 0.0, -1.0, math.nan, math.inf])
def test_a_target_out_of_range_is_refused(target_n: float) -> None:
    with pytest.raises(RequestError, match="target of"):
        ResolvedConfig(Config()).check_target(target_n)


def test_a_linkage_takes_large_targets_once_its_jaws_are_calibrated() -> None:
    viperx = Path(__file__).parents[2] / "examples/grippers/viperx_aloha.yaml"
    with pytest.raises(
        RequestError, match=r"2\.\d+ times the .*position_bound_rad.* after calibrate jaws and servo"
    ):
        ResolvedConfig(load_config(viperx)).check_target(6.0)
    ResolvedConfig(load_config(viperx, ["gripper.position_bound_rad=0.1"])).check_target(6.0)


def test_the_largest_target_that_a_message_names_is_accepted() -> None:
    config = load_config(None, ["control.force_limit_n=10", "object=none"])
    profile = ResolvedConfig(config, target_limits_n={"rig profile": 5.0599})
    for run, target_n in ((ResolvedConfig(config), 8.0), (profile, 6.0)):
        with pytest.raises(RequestError) as caught:
            run.check_target(target_n)
        named = re.search(r"(?:at most|above the) ([\d.]+) N", str(caught.value))
        assert named is not None
        run.check_target(float(named[1]))


def test_a_target_beyond_a_profile_is_refused() -> None:
    run = resolve(load_config(None, ["object=sponge", "calibration.object=own", "control.force_limit_n=60"]))
    (most_n,) = run.target_limits_n.values()
    run.check_target(most_n)
    with pytest.raises(RequestError, match=r"object profile .*sponge\.yaml was calibrated with"):
        run.check_target(most_n + 0.1)


@pytest.mark.parametrize(
    ("key", "message"),
    [
        ("servo.backend=dynamixl", "did you mean 'dynamixel'"),
        ("servo.backend=no_such_package:Servo", "servo.backend=no_such_package:Servo needs no_such_package"),
        ("vision.checkpoint=none", None),
    ],
)
def test_a_wrong_servo_backend_is_named(key: str, message: str | None) -> None:
    config = load_config(None, [*NO_SENSORS, key])
    if message is None:
        resolve(config)
    else:
        with pytest.raises(ConfigError, match=message):
            resolve(config)


def test_a_missing_checkpoint_is_found_before_devices_open(tmp_path: Path) -> None:
    with pytest.raises(Exception, match=r"no\.safetensors"):
        resolve(load_config(None, [f"vision.checkpoint={tmp_path}/no.safetensors"]))


def test_a_network_of_one_rig_says_so_on_another(tiny_checkpoint: Path, tmp_path: Path) -> None:
    header = read_checkpoint(tiny_checkpoint)[2]
    one, several = tmp_path / "one.safetensors", tmp_path / "several.safetensors"
    settings = load_config().rig_settings()
    for path, rigs in ((one, 1), (several, 2)):
        replace_header(
            tiny_checkpoint, header.model_copy(update={"trained_on": {"rigs": rigs, **settings}}), path
        )
    other = ["camera.exposure_us=8000", "vision.region=[0, 0, 90, 90]"]
    notes = resolve(load_config(None, [f"vision.checkpoint={one}", *other])).notes
    assert (
        "session",
        "the network was made with camera.exposure_us 4000, not 8000; vision.region None, not [0, 0, 90, 90]",
    ) in notes
    for checkpoint, keys in ((one, []), (several, other), (tiny_checkpoint, other)):
        notes = resolve(load_config(None, [f"vision.checkpoint={checkpoint}", *keys])).notes
        assert not any("was made with" in text for _, text in notes)


def test_a_configuration_that_overrides_what_was_measured_says_so(
    servo_calibration: ServoCalibration, tmp_path: Path
) -> None:
    rig = tmp_path / "rig_profile.yaml"
    update_rig(rig, servo_calibration)
    own = [*NO_SENSORS, f"calibration.rig={rig}", "target_n=2"]
    assert not any("overrides" in text for _, text in resolve(load_config(None, own)).notes)
    given = [*own, "gripper.friction_n=0.5", "gripper.open_width_m=0.08"]
    assert (
        "session",
        "the configuration overrides gripper.friction_n, gripper.open_width_m of the rig profile; delete them to use "
        "its values",
    ) in resolve(load_config(None, given)).notes


def test_a_run_says_that_nothing_notices_an_unfamiliar_object() -> None:
    def warns(*keys: str) -> bool:
        notes = resolve(load_config(None, list(keys))).notes
        return any("no out-of-distribution score" in text for _, text in notes)

    assert warns("vision.engine=openvino", "vision.precision=bfloat16")
    assert not warns("vision.engine=openvino")
    assert not warns("vision.checkpoint=none")


@pytest.mark.parametrize("name", ["default", "small"])
def test_shipped_networks_are_for_any_rig(name: str) -> None:
    keys = [
        "camera.exposure_us=8000",
        "gripper.open_width_m=0.05",
        "sim.tool=rods",
        f"vision.checkpoint={name}",
    ]
    assert not any("was made with" in text for _, text in resolve(load_config(None, keys)).notes)
