"""What every servo keeps to: each model in memory, one behind a device path, and the simulated rig's."""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field

import pytest

from gripper_force.config import ServoConfig, load_config
from gripper_force.errors import DeviceError, DeviceTimeoutError, NonFiniteError
from gripper_force.interfaces import Servo
from gripper_force.types import NS_PER_MS, ServoCommand, ServoState
from gripper_hw.dynamixel.control_table import load_model, model_names
from gripper_hw.dynamixel.firmware import VirtualServo
from gripper_hw.dynamixel.pty_server import BenchMotor, serve_virtual_servo
from gripper_hw.dynamixel.servo import DynamixelServo
from gripper_hw.dynamixel.virtual import VirtualBus, find_bus, register_bus, unregister_bus
from gripper_hw.sim.simulated_rig import SimulatedRig

STEP_NS = 5 * NS_PER_MS
PATIENT = {"bus_watchdog_ms": 2540, "reply_margin_ms": 100.0, "current_limit_a": 0.8}
"""So that nothing happens only because a machine is busy."""


@dataclass
class Fitted:
    """A servo, a second driver of it, its bus and firmware, the time, and a way to let it pass."""

    bus: VirtualBus
    config: ServoConfig
    now_ns: Callable[[], int]
    pause: Callable[[], None]
    servo: Servo = field(init=False)
    other: Servo = field(init=False)

    def __post_init__(self) -> None:
        self.servo, self.other = (DynamixelServo(self.config, self.now_ns) for _ in range(2))

    @property
    def firmware(self) -> VirtualServo:
        return self.bus.servos[0]

    def registers(self, *names: str) -> tuple[int, ...]:
        with self.bus.lock:
            return tuple(self.firmware.get(name) for name in names)

    def go_on(self, steps: int = 40) -> ServoState:
        """Reads on for a while, which keeps the watchdog quiet."""
        for _ in range(steps):
            self.pause()
            state = self.servo.read()
        return state

    def until(self, condition: Callable[[ServoState], bool]) -> ServoState:
        for _ in range(4000):
            if condition(state := self.go_on(1)):
                return state
        raise AssertionError(state)


def in_memory(stack: ExitStack, model_name: str) -> Fitted:
    model = load_model(model_name)
    motor = BenchMotor(VirtualServo(1, model))
    now_ns = [77 * STEP_NS]
    bus = VirtualBus([motor.servo], lambda: now_ns[0], before_packet=lambda: motor.advance(now_ns[0]))
    register_bus("contract", bus)
    stack.callback(unregister_bus, "contract")

    def pause() -> None:
        now_ns[0] += STEP_NS

    config = ServoConfig.model_validate({"model": model_name, "port": "virtual:contract"} | PATIENT)
    return Fitted(bus, config, lambda: now_ns[0], pause)


def served(stack: ExitStack) -> Fitted:
    server = stack.enter_context(serve_virtual_servo("XM430-W350"))
    config = ServoConfig.model_validate({"port": server.device_path} | PATIENT)
    return Fitted(server.bus, config, time.monotonic_ns, lambda: time.sleep(1e-3))


def in_the_rig(stack: ExitStack, quick: list[str]) -> Fitted:
    config = load_config(None, quick)
    rig = SimulatedRig(config)
    stack.callback(rig.close)
    bus = find_bus("rig")
    assert bus is not None
    servo = config.servo.model_copy(update=PATIENT)
    return Fitted(
        bus, servo, rig.clock.now_ns, lambda: rig.clock.sleep_until_ns(rig.clock.now_ns() + STEP_NS)
    )


@pytest.fixture(params=[*model_names(), "served", "rig"])
def fitted(request: pytest.FixtureRequest, quick: list[str]) -> Iterator[Fitted]:
    with ExitStack() as stack:
        match request.param:
            case "served":
                fitted = served(stack)
            case "rig":
                fitted = in_the_rig(stack, quick)
            case _:
                fitted = in_memory(stack, request.param)
        stack.callback(fitted.servo.close)
        stack.callback(fitted.other.close)
        yield fitted


def goals(position_rad: float, current_a: float = 0.4) -> ServoCommand:
    return ServoCommand(0, position_rad, current_a)


def test_time_rises_from_reading_to_reading_and_numbers_are_plausible(fitted):
    before_ns = fitted.now_ns()
    states = [fitted.servo.start(), *(fitted.go_on(1) for _ in range(20))]
    times_ns = [state.t_ns for state in states]
    assert times_ns == sorted(set(times_ns))
    assert before_ns <= times_ns[0]
    assert times_ns[-1] <= fitted.now_ns()
    low_v, high_v = fitted.servo.voltage_range_v
    for state in states:
        assert low_v <= state.voltage_v <= high_v
        assert 0 < state.temperature_c < 100
        assert (state.hardware_error, state.velocity_rad_s, abs(state.current_a) < 0.03) == (0, 0.0, True)
    assert fitted.servo.stats.cycles >= 21
    assert fitted.servo.nm_per_a > 0 < fitted.servo.current_step_a


def test_it_goes_where_it_is_sent_and_presses_no_harder_than_it_may(fitted):
    start_rad = fitted.servo.start().position_rad
    fitted.servo.write(goals(start_rad + 0.2))
    moved = fitted.until(lambda state: state.position_rad > start_rad + 0.1)
    assert moved.t_ns <= fitted.now_ns()
    fitted.servo.write(goals(start_rad + 0.2, 1e9))
    fitted.go_on(1)
    limit, goal = fitted.registers("current_limit", "goal_current")
    assert goal == limit
    assert goal * fitted.servo.current_step_a <= 0.8


@pytest.mark.parametrize("call", ["read", "write", "stop"])
def test_what_is_not_started_or_closed_says_so(fitted, call):
    servo = fitted.servo
    calls = {
        "read": servo.read,
        "write": lambda: servo.write(goals(0.0)),
        "stop": lambda: servo.stop(hold=False),
    }
    with pytest.raises(DeviceError, match="not open"):
        calls[call]()
    servo.close()
    servo.start()
    servo.close()
    servo.close()
    with pytest.raises(DeviceError, match="not open"):
        calls[call]()


def test_one_at_a_time(fitted):
    fitted.servo.start()
    with pytest.raises(DeviceError, match="in use"):
        fitted.other.start()
    fitted.go_on(1)  # and the first was not disturbed
    fitted.servo.stop(hold=False)
    fitted.servo.close()
    fitted.other.start()


def test_nothing_moves_at_start_wherever_the_last_goal_was(fitted):
    start_rad = fitted.servo.start().position_rad
    fitted.servo.write(goals(start_rad + 0.4))
    fitted.until(lambda state: state.position_rad > start_rad + 0.1)
    fitted.servo.stop(hold=False)
    fitted.until(lambda state: state.velocity_rad_s == 0.0)
    fitted.servo.close()
    with fitted.bus.lock:
        fitted.firmware.set("goal_position", 4000)
        fitted.firmware.set("goal_current", fitted.firmware.get("current_limit"))
    again_rad = fitted.servo.start().position_rad
    assert fitted.registers("torque_enable") == (1,)
    for _ in range(10):
        assert fitted.go_on(5).position_rad == pytest.approx(again_rad, abs=0.005)


def test_stop_lets_go(fitted):
    start_rad = fitted.servo.start().position_rad
    fitted.servo.write(goals(start_rad + 0.1))
    fitted.go_on()
    fitted.servo.stop(hold=False)
    assert fitted.registers("torque_enable", "bus_watchdog") == (0, 0)
    assert abs(fitted.go_on(5).current_a) < 0.03  # what remains is noise
    fitted.servo.stop(hold=False)


def test_stop_with_hold_holds_without_anyone_on_the_bus(fitted):
    start_rad = fitted.servo.start().position_rad
    fitted.servo.write(goals(start_rad + 0.1, 0.5))
    fitted.go_on()
    kept = fitted.registers("goal_position", "goal_current")
    fitted.servo.stop(hold=True)
    fitted.servo.close()
    for _ in range(100):
        fitted.pause()
    assert fitted.registers("torque_enable", "bus_watchdog") == (1, 0)
    assert fitted.registers("goal_position", "goal_current") == kept


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_goal_that_is_no_number_is_refused_and_nothing_is_sent(fitted, bad):
    fitted.servo.start()
    sent: list[bytes] = []
    fitted.bus.transact = lambda data: sent.append(data) or b""
    for command in (goals(bad), goals(0.1, bad)):
        with pytest.raises(NonFiniteError, match="nothing was sent"):
            fitted.servo.write(command)
    assert sent == []


def test_a_bus_that_falls_silent_is_told_and_comes_back(fitted):
    start_rad = fitted.servo.start().position_rad
    fitted.servo.write(goals(start_rad + 0.1))
    fitted.go_on(5)
    fitted.bus.tamper = lambda answer: None
    for _ in range(2):
        with pytest.raises(DeviceTimeoutError, match="no valid reply"):
            fitted.servo.read()
    with pytest.raises(DeviceTimeoutError):
        fitted.servo.stop(hold=False)
    assert fitted.registers("torque_enable") == (0,)
    fitted.servo.close()
    with pytest.raises(DeviceError, match="does not answer"):
        fitted.servo.start()
    fitted.bus.tamper = None
    fitted.servo.start()
    fitted.go_on(5)
    assert fitted.registers("torque_enable") == (1,)
