import itertools
import math
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gripper_force.config import ServoConfig
from gripper_force.errors import (
    ConfigError,
    DeviceError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    HardwareFaultError,
)
from gripper_force.interfaces import Servo, ServoSpec
from gripper_force.types import ServoCommand
from gripper_hw.dynamixel.control_table import (
    REGISTERS,
    VELOCITY_UNIT_RAD_S,
    load_model,
    rad_from_ticks,
    ticks_from_rad,
)
from gripper_hw.dynamixel.firmware import OVERHEATING_ERROR, OVERLOAD_ERROR
from gripper_hw.dynamixel.packets import BROADCAST_ID, Instruction, Packet
from gripper_hw.dynamixel.servo import DynamixelBus, DynamixelServo
from gripper_hw.dynamixel.virtual import VirtualBus, VirtualServo, register_bus, unregister_bus

MODEL = load_model("XM430-W350")
MS = 1_000_000


DUTY_PER_RAD = 900 / 128 / 885 * 4096 / math.tau  # position gain of an XC330 by its manual


def drive(endpoint, **config) -> DynamixelServo:
    return DynamixelServo(endpoint.config(**config), lambda: endpoint.now_ns)


def write_packet(name: str, value: int, id_: int = 1) -> Packet:
    register = REGISTERS[name]
    return Packet(id_, Instruction.WRITE, register.address.to_bytes(2, "little") + register.encode(value))


def command(position_rad: float = 0.0, current_a: float = 0.1) -> ServoCommand:
    return ServoCommand(0, position_rad, current_a)


@pytest.fixture
def started(endpoint):
    """A bus endpoint and a servo started on it."""
    servo = drive(endpoint)
    servo.start()
    yield endpoint, servo
    servo.close()


# Start.


def test_start_configures_the_servo(endpoint):
    servo: Servo = drive(endpoint, current_limit_a=1.0, bus_watchdog_ms=41)
    firmware = endpoint.bus.servos[0]
    firmware.control(0, 1.0, 0.0)
    state = servo.start()
    assert state.position_rad == pytest.approx(1.0, abs=1e-3)
    expected = {
        "return_delay_time": 0,
        "operating_mode": 5,
        "current_limit": math.floor(1.0 / MODEL.current_unit_a),
        "status_return_level": 2,
        "bus_watchdog": 3,
        "torque_enable": 1,
        "goal_current": 0,
        "goal_position": ticks_from_rad(1.0),
    }
    assert {name: firmware.get(name) for name in expected} == expected
    servo.close()


def test_start_writes_the_present_position_as_goal_before_torque_comes_on(endpoint):
    firmware = endpoint.bus.servos[0]
    firmware.control(0, -0.7, 0.0)
    servo = drive(endpoint)
    servo.start()
    servo.close()
    writes = [packet for packet in endpoint.packets() if packet.instruction == Instruction.WRITE]
    goal = writes.index(write_packet("goal_position", ticks_from_rad(-0.7)))
    watchdog = writes.index(write_packet("bus_watchdog", 2))
    torque_off, torque_on = (writes.index(write_packet("torque_enable", value)) for value in (0, 1))
    mode = writes.index(write_packet("operating_mode", 5))
    assert torque_off == 0
    assert torque_off < mode < goal < watchdog < torque_on == len(writes) - 1


def test_start_reads_back_every_write(memory_endpoint):
    drive(memory_endpoint).start()
    packets = memory_endpoint.packets()
    for write, read in itertools.pairwise(packets):
        if write.instruction == Instruction.WRITE:
            assert (read.id, read.instruction, read.params[:2]) == (1, Instruction.READ, write.params[:2])
            assert 0 <= int.from_bytes(read.params[2:], "little") - (len(write.params) - 2) < 8


def test_second_start_does_not_write_the_eeprom(started):
    endpoint, servo = started
    servo.stop(hold=False)
    servo.close()
    endpoint.received.clear()
    servo.start()
    writes = [packet for packet in endpoint.packets() if packet.instruction == Instruction.WRITE]
    assert all(int.from_bytes(packet.params[:2], "little") >= 64 for packet in writes)


def test_start_clears_a_tripped_watchdog_after_torque_off(memory_endpoint):
    firmware = memory_endpoint.bus.servos[0]
    firmware.set("torque_enable", 1)
    firmware.set("bus_watchdog", -1)
    drive(memory_endpoint).start()
    writes = [packet for packet in memory_endpoint.packets() if packet.instruction == Instruction.WRITE]
    assert writes[:2] == [write_packet("torque_enable", 0), write_packet("bus_watchdog", 0)]


@pytest.mark.parametrize("level", [0, 1])
def test_start_enables_replies(endpoint, level):
    endpoint.bus.servos[0].set("status_return_level", level)
    servo = drive(endpoint)
    servo.start()
    assert endpoint.bus.servos[0].get("status_return_level") == 2
    assert servo.stats.retries == 0
    servo.close()


def test_missing_id_is_reported_and_releases_the_port(endpoint):
    with pytest.raises(DeviceNotFoundError, match=r"id 9 .*does not answer"):
        drive(endpoint, id=9, reply_margin_ms=2.0).start()
    drive(endpoint).start()  # the port was released


def test_another_model_is_refused_and_not_written(make_memory_endpoint):
    endpoint = make_memory_endpoint(VirtualServo(1, load_model("XM430-W210")))
    with pytest.raises(ConfigError, match="XM430-W210"):
        drive(endpoint).start()
    assert all(packet.instruction != Instruction.WRITE for packet in endpoint.packets())


@pytest.mark.parametrize("model", ["XL430-W250", "AX-12"])
def test_unsuitable_model_is_refused_before_the_port_is_opened(model):
    with pytest.raises(ConfigError, match=model):
        DynamixelServo(ServoConfig(port="virtual:nobody", model=model))


def test_current_limit_above_the_models_is_refused():
    with pytest.raises(ConfigError, match=r"current_limit_a is 1.2.*0.91"):
        DynamixelServo(ServoConfig(port="virtual:nobody", model="XC330-T288"))


def test_spec_contains_the_models_data_and_needs_no_port():
    config = ServoConfig(port="virtual:nobody", model="XC330-T288")
    assert DynamixelServo.spec(config) == ServoSpec(
        nm_per_a=pytest.approx(0.92 / 0.80),  # type: ignore[arg-type]
        current_step_a=0.001,
        voltage_range_v=(6.5, 12.0),
        position_loop_a_per_rad=pytest.approx(0.80 * DUTY_PER_RAD),  # type: ignore[arg-type]
        position_loop_gain_per_s=pytest.approx(65 * math.tau / 60 * DUTY_PER_RAD),  # type: ignore[arg-type]
        position_range_rad=(-math.pi, math.pi),
    )
    offset = DynamixelServo.spec(config.model_copy(update={"homing_offset": 2048}))
    assert offset.position_range_rad == pytest.approx((0.0, math.tau))
    with pytest.raises(ConfigError, match=r"unknown servo\.model 'AX-12'"):
        DynamixelServo.spec(ServoConfig(model="AX-12"))


def test_a_servo_that_can_not_move_is_refused(make_memory_endpoint):
    endpoint = make_memory_endpoint()
    endpoint.bus.servos[0].set("pwm_limit", 0)
    with pytest.raises(DeviceError, match=r"PWM Limit 0 and can't move; set the register to 885"):
        drive(endpoint).start()


def test_another_homing_offset_is_refused_with_torque_off(make_memory_endpoint):
    endpoint = make_memory_endpoint(VirtualServo(1, MODEL))
    endpoint.bus.servos[0].set("homing_offset", 1024)
    with pytest.raises(DeviceError, match=r"Homing Offset 1024.*servo\.homing_offset is 0"):
        drive(endpoint).start()
    assert not endpoint.bus.servos[0].get("torque_enable")
    drive(endpoint, homing_offset=1024).start()
    assert endpoint.bus.servos[0].get("torque_enable")


def test_old_firmware_is_refused_with_torque_off(make_memory_endpoint):
    endpoint = make_memory_endpoint(VirtualServo(1, MODEL, firmware=37))
    endpoint.bus.servos[0].set("torque_enable", 1)
    with pytest.raises(DeviceError, match=r"firmware 37.*Bus Watchdog.*update it to 38"):
        drive(endpoint).start()
    assert endpoint.bus.servos[0].get("torque_enable") == 0


def test_missing_servo_fails_start_and_turns_the_others_off(make_memory_endpoint):
    endpoint = make_memory_endpoint(VirtualServo(1, MODEL))
    endpoint.bus.servos[0].set("torque_enable", 1)
    with pytest.raises(DeviceNotFoundError, match="id 2"):
        DynamixelBus(endpoint.config(reply_margin_ms=2.0), (1, 2)).start()
    assert endpoint.bus.servos[0].get("torque_enable") == 0


def test_start_overwrites_gains_of_another_program(endpoint):
    firmware = endpoint.bus.servos[0]
    odd = ("position_p_gain", "position_i_gain", "position_d_gain", "feedforward_1st_gain", "goal_pwm")
    usual = {name: firmware.get(name) for name in odd}
    for name in odd:
        firmware.set(name, 1)
    drive(endpoint).start()
    assert {name: firmware.get(name) for name in odd} == usual


def test_hardware_error_prevents_start_with_torque_off(memory_endpoint):
    firmware = memory_endpoint.bus.servos[0]
    firmware.set("shutdown", 0)
    firmware.set("torque_enable", 1)
    firmware.raise_hardware_error(OVERLOAD_ERROR | OVERHEATING_ERROR)
    with pytest.raises(HardwareFaultError, match="overheating and overload"):
        drive(memory_endpoint).start()
    assert firmware.get("torque_enable") == 0


def test_late_failure_of_start_turns_torque_off(memory_endpoint):
    firmware = memory_endpoint.bus.servos[0]

    def lose_the_last_read(answer):
        return None if firmware.get("torque_enable") and answer[4] == BROADCAST_ID else answer

    memory_endpoint.bus.tamper = lose_the_last_read
    with pytest.raises(DeviceTimeoutError):
        drive(memory_endpoint).start()
    assert firmware.get("torque_enable") == 0


@pytest.mark.parametrize(
    ("forgotten", "instead", "told"),
    [
        (REGISTERS["operating_mode"].address, b"\x03", "operating_mode = 5"),
        (MODEL.indirect_windows(99)[0].address, struct.pack("<21H", *21 * [64]), "its indirect addresses"),
    ],
)
def test_register_that_does_not_keep_its_value_is_reported(memory_endpoint, forgotten, instead, told):
    firmware = memory_endpoint.bus.servos[0]
    real = firmware.write
    firmware.write = lambda address, data: real(address, instead if address == forgotten else data)
    with pytest.raises(DeviceError, match=f"did not keep {told}"):
        drive(memory_endpoint).start()
    assert firmware.get("torque_enable") == 0


@pytest.mark.parametrize("failing", [0, 1])
def test_a_start_is_checked_before_torque_comes_on_and_after(memory_endpoint, failing):
    firmware, torques = memory_endpoint.bus.servos[0], []

    def check(states):
        torques.append(firmware.get("torque_enable"))
        if torques[-1] == failing:
            raise DeviceError("the fingers are apart")

    with pytest.raises(DeviceError, match="apart"):
        DynamixelBus(memory_endpoint.config(), (1,)).start(check)
    assert torques == [0, 1][: failing + 1]
    assert firmware.get("torque_enable") == 0


@pytest.mark.parametrize(
    ("model", "firmware", "data", "size"),
    [
        ("XM430-W350", 52, 224, 15),
        ("XL330-M288", 51, 224, 15),
        ("XL330-M288", 52, 208, 13),
        ("XC330-T288", 52, 208, 13),
    ],
)
def test_cycle_uses_the_models_indirect_data(make_memory_endpoint, model, firmware, data, size):
    endpoint = make_memory_endpoint(VirtualServo(1, load_model(model), firmware))
    servo = drive(endpoint, model=model, current_limit_a=0.9)
    servo.start()
    mapped = struct.unpack(f"<{size + 6}H", endpoint.bus.servos[0].read(168, 2 * (size + 6))[1])
    registers = [r for r in REGISTERS.values() if r.address in mapped]
    # A register of which a part is mapped does not work: emanual.robotis.com/docs/en/dxl/x/xl330-m288/#indirect-data
    assert sorted(mapped) == [r.address + offset for r in registers for offset in range(r.size)]
    endpoint.received.clear()
    servo.read()
    servo.write(command())
    read, write = endpoint.packets()
    assert (read.instruction, write.instruction) == (Instruction.FAST_SYNC_READ, Instruction.SYNC_WRITE)
    assert (read.params[:2], read.params[4:]) == (struct.pack("<H", data), b"\x01")
    assert size <= int.from_bytes(read.params[2:4], "little") <= size + 7
    assert write.params[:4] == struct.pack("<HH", data + size, 6)
    assert servo._bus.firmware == (firmware,)


def test_voltage_that_does_not_fit_a_cycle_is_read_every_20_cycles(make_memory_endpoint):
    endpoint = make_memory_endpoint(*(VirtualServo(id_, load_model("XL330-M288")) for id_ in (1, 2)))
    bus = DynamixelBus(endpoint.config(model="XL330-M288"), (1, 2), lambda: endpoint.now_ns)
    bus.start()
    for servo, voltage_v in zip(endpoint.bus.servos, (4.8, 5.2), strict=True):
        servo.set_conditions(voltage_v=voltage_v)
    endpoint.received.clear()
    voltages = [tuple(state.voltage_v for state in bus.read()) for _ in range(98)]
    old, new = pytest.approx((5.0, 5.0)), pytest.approx((4.8, 5.2))
    assert voltages == [old] * 18 + [new] * 80
    reads = [packet.params[:2] for packet in endpoint.packets()]
    assert reads.count(struct.pack("<H", REGISTERS["present_input_voltage"].address)) == 4
    assert len(reads) == 102
    bus.read()  # the start comes between two readings of the voltage
    bus.close()
    for servo in endpoint.bus.servos:
        servo.set_conditions(voltage_v=5.5)
    bus.start()
    assert [state.voltage_v for state in bus.read()] == pytest.approx((5.5, 5.5))


@pytest.mark.parametrize(("firmwares", "fast"), [((45, 52), True), ((44, 52), False), ((44, 38), False)])
def test_old_firmware_is_read_by_a_plain_sync_read(make_endpoint, firmwares, fast):
    servos = [VirtualServo(id_, MODEL, firmware) for id_, firmware in zip((3, 5), firmwares, strict=True)]
    endpoint = make_endpoint(*servos)
    for servo in servos:
        servo.control(0, 0.1 * servo.id, 0.0)
    bus = DynamixelBus(endpoint.config(), (5, 3))
    bus.start()
    endpoint.received.clear()
    states = [bus.read() for _ in range(10)]
    bus.close()
    assert {(packet.instruction, packet.params[4:]) for packet in endpoint.packets()} == {
        (Instruction.FAST_SYNC_READ if fast else Instruction.SYNC_READ, b"\x05\x03")
    }
    for state in states:
        assert [reply.position_rad for reply in state] == pytest.approx([0.5, 0.3], abs=1e-3)
    assert (bus.stats.retries, bus.stats.cycles) == (0, 12)


# The cycle.


def test_read_returns_signed_si_units(started):
    endpoint, servo = started
    firmware = endpoint.bus.servos[0]
    firmware.set_conditions(temperature_c=41.0, voltage_v=11.3)
    firmware.control(0, -2.0, -1.5, current_noise_a=-0.25)
    endpoint.now_ns = 7 * MS
    state = servo.read()
    assert state.t_ns == 7 * MS
    assert state.position_rad == pytest.approx(-2.0, abs=1e-3)
    assert state.velocity_rad_s == pytest.approx(-1.5, abs=VELOCITY_UNIT_RAD_S)
    assert state.current_a == pytest.approx(-0.25, abs=MODEL.current_unit_a)
    assert (state.temperature_c, state.voltage_v, state.hardware_error) == (41.0, pytest.approx(11.3), 0)


def test_data_that_contains_a_header_pattern_is_read_correctly(started):
    """The SDK's removeStuffing misreads such data; fast sync read is not stuffed."""
    endpoint, servo = started
    current, velocity, ticks = struct.unpack("<hhi", bytes.fromhex("fffffd00aafffdfd"))
    endpoint.bus.servos[0].control(
        0, rad_from_ticks(ticks), velocity * VELOCITY_UNIT_RAD_S, current * MODEL.current_unit_a
    )
    state = servo.read()
    assert state.current_a == pytest.approx(current * MODEL.current_unit_a)
    assert state.velocity_rad_s == pytest.approx(velocity * VELOCITY_UNIT_RAD_S)
    assert state.position_rad == rad_from_ticks(ticks)


def test_write_sets_both_goals_in_one_packet(started):
    endpoint, servo = started
    endpoint.received.clear()
    servo.write(command(0.5, 0.269))
    servo.read()  # so that the write was executed
    assert [packet.instruction for packet in endpoint.packets()] == [
        Instruction.SYNC_WRITE,
        Instruction.FAST_SYNC_READ,
    ]
    firmware = endpoint.bus.servos[0]
    assert (firmware.get("goal_current"), firmware.get("goal_position")) == (100, ticks_from_rad(0.5))


@settings(deadline=None, max_examples=50)
@given(st.floats(allow_nan=False, allow_infinity=False), st.floats(allow_nan=False, allow_infinity=False))
def test_goals_are_clamped_to_current_limit_and_travel(position_rad, current_a):
    bus = VirtualBus([VirtualServo(1, MODEL)], lambda: 0)
    register_bus("goals", bus)
    servo = DynamixelServo(ServoConfig(port="virtual:goals", current_limit_a=0.5), lambda: 0)
    servo.start()
    servo.write(command(position_rad, current_a))
    firmware = bus.servos[0]
    expected_a = max(0.0, min(0.5, current_a))
    assert firmware.get("goal_current") * MODEL.current_unit_a == pytest.approx(expected_a, abs=0.0028)
    assert firmware.get("goal_current") * MODEL.current_unit_a <= 0.5
    turns = max(-255.0, min(255.0, position_rad / (2 * math.pi)))
    expected = 2048 + turns * 4096
    assert firmware.get("goal_position") == pytest.approx(expected, abs=0.51)
    servo.close()
    unregister_bus("goals")


def test_firmware_versions_with_different_indirect_data_are_refused(make_memory_endpoint):
    model = load_model("XL330-M288")
    endpoint = make_memory_endpoint(VirtualServo(1, model, 51), VirtualServo(2, model, 52))
    with pytest.raises(DeviceError, match=r"\(51, 52\).*same version"):
        DynamixelBus(endpoint.config(model="XL330-M288"), (1, 2)).start()


def test_reading_in_time_feeds_the_watchdog(started):
    endpoint, servo = started
    for _ in range(10):
        endpoint.now_ns += 40 * MS
        servo.read()
    assert servo.stats.cycles == 12  # two of them in start


# Stop.


def test_stop_sends_torque_off_and_reads_it_back(started):
    endpoint, servo = started
    endpoint.received.clear()
    servo.stop(hold=False)
    assert endpoint.packets()[0] == write_packet("torque_enable", 0)
    assert endpoint.packets()[1].instruction == Instruction.READ
    assert endpoint.bus.servos[0].get("torque_enable") == 0


def test_hold_after_a_watchdog_trip_does_not_restart_the_motor(started):
    endpoint, servo = started
    servo.write(command(0.5, 0.3))
    servo.read()
    endpoint.now_ns += 41 * MS
    with pytest.raises(HardwareFaultError, match="can't hold"):
        servo.stop(hold=True)
    firmware = endpoint.bus.servos[0]
    assert (firmware.get("torque_enable"), firmware.get("bus_watchdog")) == (0, 0)
    torque, watchdog = (
        endpoint.packets().index(write_packet(name, 0), 10) for name in ("torque_enable", "bus_watchdog")
    )
    assert torque < watchdog


def test_restarted_servo_can_not_hold(memory_endpoint):
    servo = drive(memory_endpoint)
    servo.start()
    memory_endpoint.bus.servos[0].set("torque_enable", 0)
    with pytest.raises(HardwareFaultError, match="can't hold"):
        servo.stop(hold=True)


def test_failed_hold_turns_torque_off(memory_endpoint):
    servo = drive(memory_endpoint)
    servo.start()
    deaf = REGISTERS["bus_watchdog"].address.to_bytes(2, "little")

    def lose_what_is_said_of_the_watchdog(answer):
        packet = memory_endpoint.packets()[-1]
        return None if packet.params[:2] == deaf else answer

    memory_endpoint.bus.tamper = lose_what_is_said_of_the_watchdog
    with pytest.raises(DeviceTimeoutError):
        servo.stop(hold=True)
    assert memory_endpoint.bus.servos[0].get("torque_enable") == 0


def test_stop_retries_after_lost_replies(memory_endpoint):
    servo = drive(memory_endpoint, retries=0)
    servo.start()
    lost = iter(range(4))
    memory_endpoint.bus.tamper = lambda answer: answer if next(lost, None) is None else None
    servo.stop(hold=False)
    assert servo.stats.timeouts == 4
    assert memory_endpoint.bus.servos[0].get("torque_enable") == 0


def test_stop_turns_torque_off_without_any_reply(memory_endpoint):
    servo = drive(memory_endpoint)
    servo.start()
    memory_endpoint.bus.tamper = lambda answer: None
    memory_endpoint.received.clear()
    with pytest.raises(DeviceTimeoutError):
        servo.stop(hold=False)
    assert memory_endpoint.packets().count(write_packet("torque_enable", 0)) == 15
    assert memory_endpoint.bus.servos[0].get("torque_enable") == 0


def test_stop_tries_every_servo(make_memory_endpoint):
    endpoint = make_memory_endpoint(VirtualServo(1, MODEL), VirtualServo(2, MODEL))
    bus = DynamixelBus(endpoint.config(), (1, 2), lambda: endpoint.now_ns)
    bus.start()
    endpoint.bus.servos[0].silent_until_ns = 10**12
    with pytest.raises(DeviceTimeoutError, match="servo 1"):
        bus.stop(hold=False)
    assert [servo.get("torque_enable") for servo in endpoint.bus.servos] == [1, 0]


# Faults on the bus: see test_transport.py and test_bus_faults.py as well.
