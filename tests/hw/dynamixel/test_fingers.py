"""Two servos, one per finger, as one: at the wire, and the arithmetic for any pair of states."""

import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gripper_force.config import ServoConfig, load_config
from gripper_force.control.safety import is_back_driven
from gripper_force.errors import (
    ConfigError,
    DeviceError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    HardwareFaultError,
)
from gripper_force.fault_config import FaultConfig
from gripper_force.types import NS_PER_MS, ServoCommand, ServoState
from gripper_hw.dynamixel.bus_faults import WireFaults
from gripper_hw.dynamixel.control_table import INPUT_VOLTAGE_ERROR, VELOCITY_UNIT_RAD_S, load_model
from gripper_hw.dynamixel.fingers import FingerPair
from gripper_hw.dynamixel.firmware import OVERLOAD_ERROR, REBOOT_NS
from gripper_hw.dynamixel.packets import Instruction
from gripper_hw.dynamixel.pty_server import BenchMotor
from gripper_hw.dynamixel.servo import DynamixelServo
from gripper_hw.dynamixel.virtual import VirtualBus, VirtualServo, register_bus, unregister_bus
from gripper_hw.fault_injection import Faults

MODEL = load_model("XM430-W350")
CYCLE_NS = 5 * NS_PER_MS
OFFSET_RAD = 0.4
PAIR = ServoConfig.model_validate(
    {"port": "virtual:pair", "current_limit_a": 0.8, "second": {"id": 2, "offset_rad": OFFSET_RAD}}
)


class Bus(VirtualBus):
    """Records what it receives."""

    def __init__(self, *args: object) -> None:
        super().__init__(*args)  # type: ignore[arg-type]
        self.received: list[bytes] = []

    def transact(self, data: bytes) -> bytes:
        self.received.append(data)
        return super().transact(data)


@dataclass
class Bench:
    """The driver, its bus, and a motor for each finger; equal closing angles are mirrored servo positions."""

    servo: DynamixelServo
    bus: Bus
    motors: tuple[BenchMotor, BenchMotor]
    now_ns: int = 77 * CYCLE_NS

    def place(self, first_rad: float, second_rad: float) -> None:
        """Sets the closing angles."""
        for motor, position_rad in zip(self.motors, (first_rad, OFFSET_RAD - second_rad), strict=True):
            motor.position_rad, motor.velocity_rad_s = position_rad, 0.0
            motor.servo.control(self.now_ns, position_rad, 0.0)

    @property
    def closing_rad(self) -> tuple[float, float]:
        first, second = self.motors
        return first.position_rad, OFFSET_RAD - second.position_rad

    def cycle(self, goal_rad: float | None = None, current_a: float = 0.3) -> ServoState:
        self.now_ns += CYCLE_NS
        state = self.servo.read()
        if goal_rad is not None:
            self.servo.write(ServoCommand(self.now_ns, goal_rad, current_a))
        return state

    def registers(self, name: str) -> list[int]:
        return [servo.get(name) for servo in self.bus.servos]


@pytest.fixture
def bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    motors = (BenchMotor(VirtualServo(1, MODEL)), BenchMotor(VirtualServo(2, MODEL)))
    bus = Bus([motor.servo for motor in motors], lambda: one.now_ns)
    one: Bench = Bench(DynamixelServo(PAIR, lambda: one.now_ns), bus, motors)
    faults = getattr(request, "param", ())
    wire = WireFaults(bus, Faults([FaultConfig.model_validate(fault) for fault in faults]), seed=0)

    def advance() -> None:
        wire.update(one.now_ns)
        for motor in motors:
            motor.advance(one.now_ns)

    bus.before_packet = advance
    one.place(0.0, 0.0)
    register_bus("pair", bus)
    yield one
    one.servo.close()
    unregister_bus("pair")


# The configuration.


def test_wrong_pairs_are_refused() -> None:
    for sets, text in (
        (["servo.second.id=1"], r"second\.id 1 is servo\.id"),
        (["servo.second.id=2", "gripper.linkage={kind: finger, finger_m: 0.06}"], "set the kind to fingers"),
        (["faults=[{unit: servo, kind: off, id: 2}]"], "no servo has it"),
        (["servo.second.id=2", "faults=[{unit: bus, kind: off, id: 2}]"], "bus has no id"),
        (
            ["servo.second.id=2", "faults=[{unit: plant, kind: off, id: 2}]"],
            "kind off of unit plant has no id",
        ),
    ):
        with pytest.raises(ConfigError, match=text):
            load_config(None, sets)


def test_spec_has_the_torque_of_both_and_the_positions_that_both_can_report() -> None:
    one, two = DynamixelServo.spec(replace_second(id=None)), DynamixelServo.spec(PAIR)
    assert two.nm_per_a == 2 * one.nm_per_a
    assert two.position_range_rad == pytest.approx((OFFSET_RAD - math.pi, math.pi))
    same_way = DynamixelServo.spec(replace_second(mirrored=False, offset_rad=-1.0))
    assert same_way.position_range_rad == pytest.approx((1.0 - math.pi, math.pi))
    assert replace(two, nm_per_a=one.nm_per_a, position_range_rad=one.position_range_rad) == one


def replace_second(**keys: object) -> ServoConfig:
    return PAIR.model_copy(update={"second": PAIR.second.model_copy(update=keys)})


# At the wire.


def test_a_cycle_is_one_read_and_one_write_for_both(bench: Bench) -> None:
    bench.servo.start()
    bench.bus.received.clear()
    bench.cycle(0.2)
    assert [data[7] for data in bench.bus.received] == [Instruction.FAST_SYNC_READ, Instruction.SYNC_WRITE]
    assert (
        bench.registers("goal_current")[0]
        == bench.registers("goal_current")[1]
        == round(0.3 / MODEL.current_unit_a)
    )


def test_both_fingers_reach_the_goal_by_their_own_zero(bench: Bench) -> None:
    bench.servo.start()
    for _ in range(600):
        state = bench.cycle(0.6)
    assert bench.closing_rad == pytest.approx((0.6, 0.6), abs=0.02)
    assert state.position_rad == pytest.approx(sum(bench.closing_rad) / 2, abs=2e-3)


def test_start_and_stop_treat_both_alike(bench: Bench) -> None:
    bench.servo.start()
    assert bench.registers("torque_enable") == [1, 1]
    assert bench.registers("bus_watchdog") == [2, 2]
    assert bench.registers("current_limit") == 2 * [math.floor(0.8 / MODEL.current_unit_a)]
    bench.servo.stop(hold=True)
    assert (bench.registers("torque_enable"), bench.registers("bus_watchdog")) == ([1, 1], [0, 0])
    bench.servo.close()
    bench.servo.start()
    bench.servo.stop(hold=False)
    assert (bench.registers("torque_enable"), bench.registers("bus_watchdog")) == ([0, 0], [0, 0])


@pytest.mark.parametrize("apart_rad", [0.27, -0.27])
def test_fingers_that_start_apart_are_refused_with_the_remedy(bench: Bench, apart_rad: float) -> None:
    bench.place(0.1, 0.1 + apart_rad)
    for motor in bench.motors:
        motor.servo.set("goal_position", 4000)
    with pytest.raises(DeviceError, match=r"0\.27 rad apart.*servo\.second\.offset_rad=") as caught:
        bench.servo.start()
    assert bench.registers("torque_enable") == [0, 0]
    # The remedy, if these fingers are equally far open.
    offset_rad = float(str(caught.value).partition("offset_rad=")[2].split(" ")[0])
    assert FingerPair(replace_second(offset_rad=offset_rad), MODEL).difference_rad(
        *(motor.position_rad for motor in bench.motors)
    ) == pytest.approx(0.0, abs=2e-3)


def test_fingers_that_start_a_little_apart_do_not_move(bench: Bench) -> None:
    bench.place(0.0, 0.2)
    state = bench.servo.start()
    for _ in range(100):
        bench.cycle(state.position_rad)
    assert bench.closing_rad == pytest.approx((0.0, 0.2), abs=2e-3)


def test_the_one_behind_catches_up_while_both_move(bench: Bench) -> None:
    bench.place(0.0, 0.2)
    state = bench.servo.start()
    for _ in range(400):
        state = bench.cycle(min(state.position_rad + 0.06, 1.5))
    assert bench.closing_rad[1] - bench.closing_rad[0] == pytest.approx(0.0, abs=0.03)


def test_a_finger_that_stays_behind_is_a_fault(bench: Bench) -> None:
    bench.motors[1]._friction_nm = 10.0
    state = bench.servo.start()
    with pytest.raises(
        HardwareFaultError, match=r"servos 1 and 2 are 0\.5\d rad apart.*max_difference_rad 0\.5"
    ):
        for _ in range(1000):
            state = bench.cycle(state.position_rad + 0.06)
    assert 0.5 < bench.closing_rad[0] < 0.55
    bench.servo.stop(hold=False)
    assert bench.registers("torque_enable") == [0, 0]


def test_a_push_meets_the_goal_current_of_both(bench: Bench) -> None:
    """A push that moves one finger on and the other one back changes no force on average."""
    bench.servo.start()
    for _ in range(100):
        bench.cycle(0.05, 0.1)
    first_rad, second_rad = bench.closing_rad
    bench.place(first_rad + 0.15, second_rad - 0.15)
    bench.cycle(0.05, 0.1)
    later_ns = bench.now_ns + 20 * NS_PER_MS  # ten time constants of the current loop
    currents_a = [motor.servo.control(later_ns, motor.position_rad, 0.0) for motor in bench.motors]
    assert currents_a[0] == pytest.approx(-0.1, abs=0.01)  # opens, against the push
    assert -currents_a[1] == pytest.approx(0.1, abs=0.01)  # mirrored: closes


@pytest.mark.parametrize("id_", [1, 2])
@pytest.mark.parametrize("hold", [False, True])
def test_a_silent_servo_times_out_and_the_other_one_is_limp_after_the_stop(
    bench: Bench, id_: int, hold: bool
) -> None:
    bench.servo.start()
    bench.cycle(0.2)
    bench.bus.servos[id_ - 1].silent_until_ns = 10**15
    with pytest.raises(DeviceTimeoutError):
        bench.cycle()
    with pytest.raises(DeviceTimeoutError, match=f"servo {id_}"):
        bench.servo.stop(hold=hold)
    assert bench.bus.servos[2 - id_].get("torque_enable") == 0
    # The silent one hears nothing, and stops by itself.
    bench.now_ns += 60 * NS_PER_MS
    bench.motors[id_ - 1].advance(bench.now_ns)
    assert bench.bus.servos[id_ - 1].get("bus_watchdog") == -1


def test_a_missing_second_servo_is_named_by_its_key(bench: Bench) -> None:
    bench.bus.servos[1].silent_until_ns = 10**15
    with pytest.raises(DeviceNotFoundError, match=r"id 2 .*servo\.second\.id"):
        bench.servo.start()
    assert bench.registers("torque_enable") == [0, 0]


@pytest.mark.parametrize(
    "bench", [[{"unit": "servo", "kind": "off", "id": 2, "at_s": 0.5, "for_s": 0.005}]], indirect=True
)
def test_a_brownout_of_the_second_is_a_restart(bench: Bench) -> None:
    bench.servo.start()
    with pytest.raises(DeviceTimeoutError):
        for _ in range(30):
            bench.cycle()
    with pytest.raises(HardwareFaultError, match=r"servo 2 stopped by itself: it restarted"):
        for _ in range(REBOOT_NS // CYCLE_NS + 10):
            with suppress(DeviceTimeoutError):
                bench.cycle()
    with pytest.raises(HardwareFaultError, match=r"servo 2 can't hold"):
        bench.servo.stop(hold=True)
    assert bench.registers("torque_enable") == [0, 0]


@pytest.mark.parametrize("bench", [[{"unit": "servo", "kind": "stuck", "id": 2, "at_s": 0.5}]], indirect=True)
def test_a_watchdog_trip_of_one_ends_the_run_with_both_off(bench: Bench) -> None:
    bench.servo.start()
    bench.cycle(0.2)
    bench.now_ns = 500 * NS_PER_MS
    for servo in bench.bus.servos:
        servo.feed_watchdog(bench.now_ns)
    with pytest.raises(HardwareFaultError, match="servo 2 stopped by itself: its bus watchdog tripped"):
        bench.cycle()
    with pytest.raises(HardwareFaultError, match="servo 2 can't hold"):
        bench.servo.stop(hold=True)
    assert bench.registers("torque_enable") == [0, 0]


@pytest.mark.parametrize("id_", [1, 2])
def test_an_error_that_stops_one_servo_stops_the_other_one(bench: Bench, id_: int) -> None:
    bench.servo.start()
    bench.cycle(0.2)
    assert all(bench.registers("goal_current"))
    bench.bus.servos[id_ - 1].raise_hardware_error(OVERLOAD_ERROR)
    assert bench.cycle(0.2).hardware_error == OVERLOAD_ERROR
    assert bench.registers("goal_current") == [0, 0]


def test_an_input_voltage_error_keeps_the_grip(bench: Bench) -> None:
    bench.servo.start()
    bench.bus.servos[1].raise_hardware_error(INPUT_VOLTAGE_ERROR)
    assert bench.cycle(0.2).hardware_error == INPUT_VOLTAGE_ERROR
    assert all(bench.registers("goal_current"))


@pytest.mark.parametrize(
    ("model", "holds"),
    [("XM430-W350", True), ("XC330-T288", True), ("XL330-M288", False), ("XL330-M077", False)],
)
def test_an_input_voltage_error_stops_both_if_it_stops_one(model: str, holds: bool) -> None:
    servo = VirtualServo(1, load_model(model))
    servo.set("torque_enable", 1)
    servo.raise_hardware_error(INPUT_VOLTAGE_ERROR)
    assert servo.get("torque_enable") == holds
    pair = FingerPair(PAIR, load_model(model))
    state = ServoState(0, 0.0, 0.0, 0.0, 30.0, 5.0, 0)
    pair.start((state, replace(state, position_rad=OFFSET_RAD)))
    pair.combine(
        (replace(state, hardware_error=INPUT_VOLTAGE_ERROR), replace(state, position_rad=OFFSET_RAD))
    )
    first, second = pair.split(ServoCommand(0, 0.5, 0.3))
    assert (first.goal_current_a > 0, second.goal_current_a > 0) == (holds, holds)


@pytest.mark.parametrize("bench", [[{"unit": "plant", "kind": "wrong", "id": 2, "at_s": 0.4}]], indirect=True)
def test_excess_current_of_one_motor_is_not_halved(bench: Bench) -> None:
    bench.servo.start()
    for _ in range(200):
        bench.place(0.0, 0.0)
        state = bench.cycle(0.5, 0.3)
    first_a, second_a = (motor.servo._present_current_a for motor in bench.motors)
    assert first_a == pytest.approx(0.3, abs=0.01)
    assert second_a < -0.4
    assert state.current_a == pytest.approx(-second_a, abs=0.01)


# For any pair of states.

angles = st.floats(-2, 2)
speeds = st.integers(-60, 60).map(lambda steps: steps * VELOCITY_UNIT_RAD_S)
currents = st.floats(-0.8, 0.8)


@st.composite
def states(draw: st.DrawFn) -> tuple[ServoState, ServoState]:
    """Servo states of fingers that do not differ too much."""
    first_rad, apart_rad = (
        draw(angles),
        draw(st.floats(-0.2499, 0.2499)),
    )  # 0.25 is the bound, and angles are rounded
    common = {"t_ns": 0, "hardware_error": 0}
    return tuple(  # type: ignore[return-value]
        ServoState(
            position_rad=position_rad,
            velocity_rad_s=draw(speeds),
            current_a=draw(currents),
            temperature_c=draw(st.floats(10, 90)),
            voltage_v=draw(st.floats(8, 15)),
            **common,
        )
        for position_rad in (first_rad, OFFSET_RAD - first_rad - apart_rad)
    )


def closing(first: ServoState, second: ServoState) -> tuple[float, float]:
    return first.position_rad, OFFSET_RAD - second.position_rad


@given(
    st.lists(states(), min_size=1, max_size=6), st.lists(angles, min_size=6, max_size=6), st.floats(0, 0.8)
)
def test_no_finger_is_led_further_than_the_controller_leads(
    readings: list[tuple[ServoState, ServoState]], goals_rad: list[float], goal_a: float
) -> None:
    pair = FingerPair(PAIR, MODEL)
    pair.start(readings[0])
    static_rad = 1.3 * goal_a / (MODEL.position_loop_per_rad * MODEL.stall_current_a)
    for reading, goal_rad in zip(readings, goals_rad, strict=False):
        state = pair.combine(reading)
        first, second = pair.split(ServoCommand(0, goal_rad, goal_a))
        most_rad = max(abs(goal_rad - state.position_rad), static_rad) + 1e-9
        now_rad = closing(*reading)
        assert abs(first.goal_position_rad - now_rad[0]) <= most_rad
        assert abs(OFFSET_RAD - second.goal_position_rad - now_rad[1]) <= most_rad
        assert min(first.goal_current_a, second.goal_current_a) == goal_a
        assert max(first.goal_current_a, second.goal_current_a) <= 1.3 * goal_a
        if all(abs(one.velocity_rad_s) < VELOCITY_UNIT_RAD_S for one in reading):
            assert first.goal_current_a == second.goal_current_a == goal_a


@given(states(), st.floats(0, 0.8))
def test_the_common_state_is_the_mean_and_the_worse_one(
    reading: tuple[ServoState, ServoState], goal_a: float
) -> None:
    pair = FingerPair(PAIR, MODEL)
    pair.start(reading)
    pair.combine(reading)
    pair.split(ServoCommand(0, 0.0, goal_a))
    first, second = reading
    state = pair.combine(reading)
    assert state.position_rad == pytest.approx(sum(closing(first, second)) / 2)
    assert state.velocity_rad_s == pytest.approx((first.velocity_rad_s - second.velocity_rad_s) / 2)
    assert state.temperature_c == max(first.temperature_c, second.temperature_c)
    assert state.voltage_v == min(first.voltage_v, second.voltage_v)
    mean_a = (first.current_a - second.current_a) / 2
    # A finger that is turned against its motor brakes; its current says nothing about the motor.
    most_a = max((abs(each.current_a) for each in reading if not is_back_driven(each)), default=0.0)
    if max(abs(each.current_a) for each in reading) <= goal_a:
        assert state.current_a == pytest.approx(mean_a)
    elif most_a > 1.3 * (1.15 * goal_a) + 0.04:
        assert abs(state.current_a) == pytest.approx(most_a)
