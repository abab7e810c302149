import math

import pytest

from gripper_hw.dynamixel.control_table import (
    CURRENT_BASED_POSITION_MODE,
    REGISTERS,
    VELOCITY_UNIT_RAD_S,
    load_model,
    model_names,
    rad_from_ticks,
    ticks_from_rad,
)
from gripper_hw.dynamixel.firmware import (
    CURRENT_LOOP_S,
    CURRENT_MODE,
    EXTENDED_POSITION_MODE,
    OVERHEATING_ERROR,
    OVERLOAD_ERROR,
    POSITION_MODE,
    PWM_MODE,
    VELOCITY_MODE,
    VirtualServo,
)
from gripper_hw.dynamixel.packets import Error

MODEL = load_model("XM430-W350")
COMPLETE = load_model("XL330-M288")
"""A model that has every register."""

MS = 1_000_000


def make(mode: int = CURRENT_BASED_POSITION_MODE, **values: int) -> VirtualServo:
    servo = VirtualServo(1, MODEL)
    for name, value in {"operating_mode": mode, "torque_enable": 1, **values}.items():
        servo.set(name, value)
    return servo


def settle(
    servo: VirtualServo, position_rad: float = 0.0, velocity_rad_s: float = 0.0, start_ns: int = 0
) -> float:
    """Motor current after 50 ms at a constant position and velocity."""
    for t_ns in range(start_ns, start_ns + 51 * MS, MS):
        current_a = servo.control(t_ns, position_rad, velocity_rad_s)
    return current_a


def write(servo: VirtualServo, name: str, value: int) -> Error:
    return servo.write(REGISTERS[name].address, REGISTERS[name].encode(value))


def read(servo: VirtualServo, name: str) -> int:
    error, data = servo.read(REGISTERS[name].address, REGISTERS[name].size)
    assert error is Error.NONE
    return REGISTERS[name].decode(data)


# Access rules, register by register.


@pytest.mark.parametrize("model", model_names())
def test_initial_values_match_the_model(model):
    servo = VirtualServo(7, load_model(model), firmware=48)
    assert (read(servo, "model_number"), read(servo, "firmware_version")) == (load_model(model).number, 48)
    assert (read(servo, "id"), servo.id) == (7, 7)
    assert read(servo, "shutdown") == load_model(model).initial["shutdown"]
    assert read(servo, "return_delay_time") == 250


def test_register_that_a_model_lacks_is_absent():
    assert VirtualServo(1, load_model("XM540-W150")).read(65, 1) == (Error.NONE, b"\0")
    assert VirtualServo(1, load_model("XW540-T140")).read(65, 1)[0] is Error.ACCESS


@pytest.mark.parametrize("name", [name for name, register in REGISTERS.items() if register.access == "r"])
def test_read_only_registers_refuse_writes(name):
    assert write(VirtualServo(1, MODEL), name, 0) is Error.ACCESS


@pytest.mark.parametrize(
    "name", [name for name, entry in REGISTERS.items() if entry.access == "rw" and entry.eeprom]
)
def test_eeprom_is_locked_while_torque_is_on(name):
    servo = VirtualServo(1, COMPLETE)
    before = servo.get(name)
    assert write(servo, name, before) is Error.NONE or name == "secondary_id"
    servo.set("torque_enable", 1)
    assert write(servo, name, before) is Error.ACCESS


@pytest.mark.parametrize(
    "name", [name for name, entry in REGISTERS.items() if entry.access == "rw" and entry.range]
)
def test_values_outside_the_range_are_refused_and_the_bounds_accepted(name):
    servo = VirtualServo(1, COMPLETE)
    servo.set("operating_mode", CURRENT_BASED_POSITION_MODE)
    register = REGISTERS[name]
    assert register.range is not None
    low, high = register.range
    for bound, beyond in ((low, low - 1), (high, high + 1)):
        assert write(servo, name, bound) is Error.NONE
        assert servo.get(name) == bound
        try:
            data = register.encode(beyond)
        except OverflowError:
            continue
        assert servo.write(register.address, data) is Error.DATA_RANGE
        assert servo.get(name) == bound


@pytest.mark.parametrize(
    "name", [name for name, entry in REGISTERS.items() if entry.access == "rw" and entry.size > 1]
)
def test_partial_register_write_is_refused(name):
    register = REGISTERS[name]
    servo = VirtualServo(1, MODEL)
    assert servo.write(register.address, bytes(register.size - 1)) is Error.DATA_LENGTH
    assert servo.write(register.address + 1, bytes(register.size - 1)) is Error.DATA_LENGTH


@pytest.mark.parametrize("name", ["goal_current", "goal_pwm", "goal_velocity"])
def test_goals_outside_their_limit_registers_are_refused(name):
    servo = VirtualServo(1, MODEL)
    limit = servo.get(name.removeprefix("goal_") + "_limit")
    assert write(servo, name, -limit) is Error.NONE
    assert write(servo, name, limit + 1) is Error.DATA_LIMIT
    assert servo.get(name) == -limit


def test_position_limits_apply_only_in_position_mode():
    servo = VirtualServo(1, MODEL)
    assert write(servo, "goal_position", 4096) is Error.DATA_LIMIT
    assert write(servo, "goal_position", 4095) is Error.NONE
    servo.set("operating_mode", EXTENDED_POSITION_MODE)
    assert write(servo, "goal_position", -100_000) is Error.NONE
    assert write(servo, "goal_position", 1_048_576) is Error.DATA_RANGE


def test_current_limit_and_operating_modes_depend_on_the_model():
    servo = VirtualServo(1, MODEL)
    assert write(servo, "current_limit", 1193) is Error.NONE
    assert write(servo, "current_limit", 1194) is Error.DATA_RANGE
    assert write(servo, "operating_mode", 2) is Error.DATA_RANGE
    assert write(servo, "operating_mode", 5) is Error.NONE


def test_undefined_addresses_are_refused_and_gaps_read_zero():
    servo = VirtualServo(1, MODEL)
    assert servo.read(15, 1) == (Error.ACCESS, b"")
    assert servo.read(600, 1000) == (Error.ACCESS, b"")
    assert servo.write(15, b"\0") is Error.ACCESS
    assert servo.write(10_000, b"\0") is Error.ACCESS
    error, data = servo.read(0, 147)
    assert error is Error.NONE
    assert data[14:20] == bytes(6)


def test_partly_refused_write_changes_nothing():
    servo = VirtualServo(1, MODEL)
    assert servo.write(64, b"\x01\x02") is Error.DATA_RANGE  # torque on, and an invalid LED value
    assert servo.get("torque_enable") == 0


@pytest.mark.parametrize(
    ("model", "firmware", "address", "data"),
    [
        ("XM430-W350", 52, 168, 224),
        ("XM430-W350", 52, 578, 634),
        ("XL330-M288", 51, 168, 224),
        ("XL330-M288", 52, 168, 208),
    ],
)
def test_indirect_data_reads_and_writes_its_target(model, firmware, address, data):
    servo = VirtualServo(1, load_model(model), firmware)
    for index, target in enumerate((65, 102, 103)):
        assert servo.write(address + 2 * index, target.to_bytes(2, "little")) is Error.NONE
    assert servo.write(data, b"\x01\x39\x07") is Error.DATA_LIMIT
    assert servo.write(data, b"\x01\x39\x01") is Error.NONE
    assert (servo.get("led"), servo.get("goal_current")) == (1, 0x139)
    assert servo.read(data, 3) == (Error.NONE, b"\x01\x39\x01")
    assert servo.write(data + 1, b"\x01") is Error.DATA_LENGTH
    assert servo.write(address, (10).to_bytes(2, "little")) is Error.DATA_RANGE


def test_mode_change_resets_the_goal_current():
    servo = VirtualServo(1, MODEL)
    write(servo, "goal_current", 5)
    write(servo, "operating_mode", 5)
    assert servo.get("goal_current") == servo.get("current_limit")


def test_registered_write_waits_for_action():
    servo = VirtualServo(1, MODEL)
    assert servo.action() is Error.INSTRUCTION
    assert servo.register_write(65, b"\x02") is Error.DATA_RANGE
    assert servo.register_write(65, b"\x01") is Error.NONE
    assert (servo.get("led"), servo.get("registered_instruction")) == (0, 1)
    assert servo.action() is Error.NONE
    assert (servo.get("led"), servo.get("registered_instruction")) == (1, 0)


# Safety.


def test_watchdog_trip_locks_the_goals_until_cleared():
    servo = make(goal_position=4000, bus_watchdog=2)
    servo.feed_watchdog(0)
    for t_ns in range(0, 40 * MS + 1, MS):
        current_a = servo.control(t_ns, 0.0, 0.0)
    assert current_a > 1.0
    assert servo.control(41 * MS, 0.0, 0.0) == 0.0
    assert read(servo, "bus_watchdog") == -1
    for goal in ("goal_pwm", "goal_current", "goal_velocity", "goal_position"):
        assert write(servo, goal, 0) is Error.DATA_RANGE
    assert write(servo, "bus_watchdog", 0) is Error.NONE
    assert write(servo, "goal_position", 0) is Error.NONE
    assert settle(servo, start_ns=42 * MS) < -1.0


def test_watchdog_is_inactive_while_torque_is_off():
    servo = make(bus_watchdog=1, torque_enable=0)
    servo.check_watchdog(10**12)
    assert read(servo, "bus_watchdog") == 1


def test_hardware_error_in_shutdown_keeps_torque_off_until_reboot():
    servo = make(goal_position=4000)
    servo.raise_hardware_error(OVERLOAD_ERROR)
    assert servo.alert
    assert (read(servo, "hardware_error_status"), read(servo, "torque_enable")) == (OVERLOAD_ERROR, 0)
    assert settle(servo) == 0.0
    assert write(servo, "torque_enable", 1) is Error.RESULT_FAIL
    servo.reboot(0)
    assert not servo.alert
    assert write(servo, "torque_enable", 1) is Error.NONE


def test_hardware_error_outside_shutdown_keeps_torque():
    servo = make(shutdown=0)
    servo.raise_hardware_error(OVERLOAD_ERROR)
    assert servo.alert
    assert read(servo, "torque_enable") == 1


def test_temperature_and_voltage_raise_hardware_errors():
    servo = make()
    servo.set_conditions(temperature_c=80.0, voltage_v=12.0)
    assert not servo.alert
    servo.set_conditions(temperature_c=80.5)
    assert read(servo, "hardware_error_status") == OVERHEATING_ERROR
    servo.set_conditions(voltage_v=9.0)
    assert read(servo, "hardware_error_status") == OVERHEATING_ERROR | 1
    assert (read(servo, "present_temperature"), read(servo, "present_input_voltage")) == (80, 90)


def test_reboot_resets_ram_and_turns_and_keeps_the_eeprom():
    servo = make(bus_watchdog=5, return_delay_time=0)
    servo.write(168, (126).to_bytes(2, "little"))
    settle(servo, position_rad=rad_from_ticks(5000))
    assert read(servo, "present_position") == 5000
    servo.reboot(7)
    assert servo.silent_until_ns > 7
    assert read(servo, "present_position") == 5000 - 4096
    assert (read(servo, "torque_enable"), read(servo, "bus_watchdog")) == (0, 0)
    assert (read(servo, "operating_mode"), read(servo, "return_delay_time")) == (5, 0)
    assert servo.read(168, 2)[1] == (224).to_bytes(2, "little")


@pytest.mark.parametrize(("option", "id_", "baud"), [(0xFF, 1, 1), (0x01, 9, 1), (0x02, 9, 3)])
def test_factory_reset_options(option, id_, baud):
    servo = VirtualServo(9, MODEL, firmware=47)
    servo.set("baud_rate", 3)
    servo.set("operating_mode", 5)
    assert servo.factory_reset(option, 0) is Error.NONE
    assert (servo.id, read(servo, "id"), read(servo, "baud_rate")) == (id_, id_, baud)
    assert (read(servo, "operating_mode"), read(servo, "firmware_version")) == (3, 47)
    assert servo.factory_reset(0x55, 0) is Error.DATA_RANGE


# Motor control.


@pytest.mark.parametrize("mode", MODEL.operating_modes)
def test_current_is_zero_without_torque(mode):
    assert settle(make(mode, torque_enable=0, goal_current=500, goal_position=4000, goal_velocity=100)) == 0.0


def test_current_follows_the_loop_time_constant():
    servo = make(CURRENT_MODE, goal_current=100)
    servo.control(0, 0.0, 0.0)
    current_a = servo.control(round(CURRENT_LOOP_S * 1e9), 0.0, 0.0)
    assert current_a == pytest.approx(100 * MODEL.current_unit_a * (1 - math.exp(-1)))


def test_current_mode_holds_goal_current_up_to_no_load_speed():
    servo = make(CURRENT_MODE, goal_current=-100)
    assert settle(servo, velocity_rad_s=-2.0) == pytest.approx(-0.269, abs=1e-6)
    no_load_rad_s = MODEL.no_load_rpm * 2 * math.pi / 60
    assert settle(servo, velocity_rad_s=-no_load_rad_s, start_ns=60 * MS) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("goal", [0, 1, 100, 400])
@pytest.mark.parametrize("side", [-1, 1])
def test_mode_5_limits_the_current_to_its_goal(goal, side):
    servo = make(goal_current=goal, goal_position=2048 + side * 2000)
    assert settle(servo) == pytest.approx(side * goal * MODEL.current_unit_a, abs=1e-6)
    assert read(servo, "present_current") == side * goal


def test_mode_5_obeys_current_limit_and_holds_its_position():
    assert settle(make(current_limit=50, goal_current=400, goal_position=4000)) == pytest.approx(50 * 2.69e-3)
    assert settle(make(goal_position=2048)) == pytest.approx(0.0, abs=1e-9)


def test_position_mode_ignores_goal_current():
    assert settle(make(POSITION_MODE, goal_current=1, goal_position=4000)) > 2.0


def test_position_mode_brakes_near_its_goal():
    servo = make(POSITION_MODE, goal_position=2060)
    assert settle(servo, velocity_rad_s=4.0) < 0.0
    assert settle(servo, velocity_rad_s=0.0, start_ns=60 * MS) > 0.0


def test_position_gains_have_effect():
    assert settle(make(POSITION_MODE, goal_position=2058)) > settle(
        make(POSITION_MODE, goal_position=2058, position_p_gain=100)
    )
    slow = make(POSITION_MODE, goal_position=2058, position_i_gain=10_000)
    assert settle(slow) > settle(make(POSITION_MODE, goal_position=2058))
    damped = make(POSITION_MODE, goal_position=2058, position_d_gain=10_000)
    assert settle(damped, velocity_rad_s=1.0) < settle(
        make(POSITION_MODE, goal_position=2058), velocity_rad_s=1.0
    )


def test_integral_resets_when_torque_goes_off():
    servo = make(POSITION_MODE, goal_position=2058, position_i_gain=10_000)
    fresh_a = settle(servo)
    settle(servo, start_ns=60 * MS)
    servo.set("torque_enable", 0)
    servo.control(120 * MS, 0.0, 0.0)
    servo.set("torque_enable", 1)
    assert settle(servo, start_ns=120 * MS) == pytest.approx(fresh_a, rel=1e-3)


def test_velocity_mode_needs_no_current_at_its_goal():
    servo = make(VELOCITY_MODE, goal_velocity=100)
    assert settle(servo, velocity_rad_s=100 * VELOCITY_UNIT_RAD_S) == pytest.approx(0.0, abs=1e-9)
    assert settle(servo, velocity_rad_s=0.0, start_ns=60 * MS) > 0.5


def test_pwm_mode_sets_a_voltage():
    servo = make(PWM_MODE, goal_pwm=442)
    assert settle(servo) == pytest.approx(MODEL.stall_current_a * 442 / 885, abs=1e-3)
    assert read(servo, "present_pwm") == 442
    assert settle(make(PWM_MODE, goal_pwm=442, pwm_limit=100)) == pytest.approx(2.3 * 100 / 885, abs=1e-3)


def test_goal_pwm_limits_the_other_modes():
    servo = make(CURRENT_BASED_POSITION_MODE, goal_current=400, goal_position=10_000, goal_pwm=100)
    assert settle(servo) == pytest.approx(2.3 * 100 / 885, abs=1e-3)


def test_present_registers_are_quantised():
    servo = make(torque_enable=0)
    servo.control(1_234 * MS, 0.5, -1.0, current_noise_a=0.1)
    assert read(servo, "present_position") == ticks_from_rad(0.5)
    assert read(servo, "present_velocity") == round(-1.0 / VELOCITY_UNIT_RAD_S)
    assert read(servo, "present_current") == round(0.1 / MODEL.current_unit_a)
    assert read(servo, "realtime_tick") == 1_234
    assert read(servo, "moving") == 1


def test_backward_time_step_has_no_effect():
    servo = make(CURRENT_MODE, goal_current=100)
    current_a = settle(servo)
    assert servo.control(0, 0.0, 0.0) == current_a


def test_zero_rad_is_tick_2048_plus_homing_offset():
    servo = VirtualServo(1, MODEL)
    assert read(servo, "present_position") == 2048
    servo.set("homing_offset", -48)
    assert read(servo, "present_position") == 2000
