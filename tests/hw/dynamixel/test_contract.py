"""Servo contract, run on every model in memory, on old firmware, on a model of one's own, behind a pty, on a port
shared with another program, on the simulated rig's servo, and on two servos as one."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from dynamixel_sdk import PortHandler

from gripper_force.config import ServoConfig, load_config
from gripper_force.errors import NonFiniteError
from gripper_force.interfaces import ServoSpec, SharedPort
from gripper_force.testing.servo_contract import ServoContract
from gripper_force.types import NS_PER_MS, ServoCommand, ServoState
from gripper_hw.dynamixel.control_table import load_model, model_names
from gripper_hw.dynamixel.firmware import VirtualServo
from gripper_hw.dynamixel.pty_server import BenchMotor, serve_virtual_servo
from gripper_hw.dynamixel.servo import DynamixelServo
from gripper_hw.dynamixel.virtual import VirtualBus, find_bus, register_bus, unregister_bus
from gripper_hw.sim.simulated_rig import SimulatedRig

STEP_NS = 5 * NS_PER_MS
GENEROUS = {"bus_watchdog_ms": 2540, "reply_margin_ms": 100.0, "current_limit_a": 0.8}
"""Timeouts that even a busy machine keeps."""


@dataclass
class ServoSetup:
    """A servo, a second driver of it, its bus and firmware, its clock, and a function that waits a cycle."""

    bus: VirtualBus
    config: ServoConfig
    now_ns: Callable[[], int]
    wait: Callable[[], None]
    port: SharedPort | None = None
    servo: DynamixelServo = field(init=False)
    second_servo: DynamixelServo = field(init=False)

    def __post_init__(self) -> None:
        self.servo, self.second_servo = (
            DynamixelServo(self.config, self.now_ns, self.port) for _ in range(2)
        )

    @property
    def firmware(self) -> VirtualServo:
        return self.bus.servos[0]

    def registers(self, *names: str) -> tuple[int, ...]:
        with self.bus.lock:
            return tuple(self.firmware.get(name) for name in names)

    def cycles(self, count: int = 40) -> ServoState:
        """Reads ``count`` times, which feeds the watchdog, and returns the last state."""
        for _ in range(count):
            self.wait()
            state = self.servo.read()
        return state

    def read_until(self, condition: Callable[[ServoState], bool]) -> ServoState:
        for _ in range(4000):
            if condition(state := self.cycles(1)):
                return state
        raise AssertionError(state)


def in_memory(
    stack: ExitStack, model_name: str, firmware: int = 52, ids: tuple[int, ...] = (1,)
) -> ServoSetup:
    model = load_model(model_name)
    motors = [BenchMotor(VirtualServo(id_, model, firmware)) for id_ in ids]
    now_ns = [77 * STEP_NS]

    def advance() -> None:
        for motor in motors:
            motor.advance(now_ns[0])

    bus = VirtualBus((motor.servo for motor in motors), lambda: now_ns[0], before_packet=advance)
    register_bus("contract", bus)
    stack.callback(unregister_bus, "contract")

    def wait() -> None:
        now_ns[0] += STEP_NS

    second = {"id": ids[1]} if len(ids) > 1 else {}
    config = ServoConfig.model_validate(
        {"model": model_name, "port": "virtual:contract", "second": second} | GENEROUS
    )
    return ServoSetup(bus, config, lambda: now_ns[0], wait)


def behind_a_pty(stack: ExitStack) -> ServoSetup:
    server = stack.enter_context(serve_virtual_servo("XM430-W350"))
    config = ServoConfig.model_validate({"port": server.device_path} | GENEROUS)
    return ServoSetup(server.bus, config, time.monotonic_ns, lambda: time.sleep(1e-3))


def on_a_shared_port(stack: ExitStack) -> ServoSetup:
    setup = behind_a_pty(stack)
    handler = PortHandler(setup.config.port)
    assert handler.openPort()
    stack.callback(handler.closePort)
    port = SharedPort(handler, threading.Lock())
    return ServoSetup(setup.bus, setup.config, setup.now_ns, setup.wait, port)


def in_the_rig(stack: ExitStack, quick: list[str]) -> ServoSetup:
    config = load_config(None, quick)
    rig = SimulatedRig(config)
    stack.callback(rig.close)
    bus = find_bus("rig")
    assert bus is not None
    servo = config.servo.model_copy(update=GENEROUS)
    return ServoSetup(
        bus, servo, rig.clock.now_ns, lambda: rig.clock.sleep_until_ns(rig.clock.now_ns() + STEP_NS)
    )


OLD_FIRMWARE = {"firmware 44": ("XM430-W350", 44), "firmware 45": ("XL330-M288", 45)}
"""The last firmware without Fast Sync Read; that of the XL330 also has its indirect data at another address."""


@pytest.fixture(
    params=[
        *model_names(),
        *OLD_FIRMWARE,
        "model of one's own",
        "pty",
        "shared port",
        "rig",
        "two",
        "rig of two",
    ]
)
def setup(request: pytest.FixtureRequest, quick: list[str], tmp_path: Path) -> Iterator[ServoSetup]:
    with ExitStack() as stack:
        match request.param:
            case "firmware 44" | "firmware 45":
                setup = in_memory(stack, *OLD_FIRMWARE[request.param])
            case "model of one's own":
                path = tmp_path / "geared.yaml"
                path.write_text("like: XM430-W350-R\nstall_torque_nm: 8.2\nno_load_rpm: 23\n")
                setup = in_memory(stack, str(path))
            case "pty":
                setup = behind_a_pty(stack)
            case "shared port":
                setup = on_a_shared_port(stack)
            case "rig":
                setup = in_the_rig(stack, quick)
            case "two":
                setup = in_memory(stack, "XM430-W350", ids=(1, 2))
            case "rig of two":
                setup = in_the_rig(stack, [*quick, "servo.second.id=2"])
            case _:
                setup = in_memory(stack, request.param)
        stack.callback(setup.servo.close)
        stack.callback(setup.second_servo.close)
        yield setup


class TestDynamixelServo(ServoContract):
    @pytest.fixture
    def config(self, setup: ServoSetup) -> ServoConfig:
        return setup.config

    @pytest.fixture
    def servo(self, setup: ServoSetup) -> DynamixelServo:
        return setup.servo

    @pytest.fixture
    def spec(self, config: ServoConfig) -> ServoSpec:
        return DynamixelServo.spec(config)

    @pytest.fixture
    def second_servo(self, setup: ServoSetup) -> DynamixelServo | None:
        return setup.second_servo if setup.port is None else None

    @pytest.fixture
    def now_ns(self, setup: ServoSetup) -> Callable[[], int]:
        return setup.now_ns

    @pytest.fixture
    def wait(self, setup: ServoSetup) -> Callable[[], None]:
        return setup.wait

    @pytest.fixture
    def torque_on(self, setup: ServoSetup) -> Callable[[], bool]:
        def is_on() -> bool:
            (value,) = {servo.get("torque_enable") for servo in setup.bus.servos}  # both or none
            return value == 1

        return is_on


# Tests that need the virtual bus.


def goals(position_rad: float, current_a: float = 0.4) -> ServoCommand:
    return ServoCommand(0, position_rad, current_a)


def test_motor_at_rest_has_no_speed_and_only_noise_as_current(setup):
    states = [setup.servo.start(), *(setup.cycles(1) for _ in range(20))]
    assert all(state.velocity_rad_s == 0.0 and abs(state.current_a) < 0.03 for state in states)
    assert setup.servo.stats.cycles >= 21


def test_goal_current_is_clamped_to_the_limit(setup):
    start_rad = setup.servo.start().position_rad
    setup.servo.write(goals(start_rad + 0.2, 1e9))
    setup.cycles(1)
    limit, goal = setup.registers("current_limit", "goal_current")
    assert goal == limit
    assert goal * DynamixelServo.spec(setup.config).current_step_a <= 0.8


def test_stop_disarms_the_watchdog(setup):
    start_rad = setup.servo.start().position_rad
    setup.servo.write(goals(start_rad + 0.1))
    setup.cycles()
    setup.servo.stop(hold=False)
    assert setup.registers("torque_enable", "bus_watchdog") == (0, 0)
    assert abs(setup.cycles(5).current_a) < 0.03  # noise


def test_stop_with_hold_keeps_the_goals_and_disarms_the_watchdog(setup):
    start_rad = setup.servo.start().position_rad
    setup.servo.write(goals(start_rad + 0.1, 0.5))
    setup.cycles()
    goals_before = setup.registers("goal_position", "goal_current")
    setup.servo.stop(hold=True)
    setup.servo.close()
    for _ in range(100):
        setup.wait()
    assert setup.registers("torque_enable", "bus_watchdog") == (1, 0)
    assert setup.registers("goal_position", "goal_current") == goals_before


def test_nothing_is_sent_for_a_non_finite_goal(setup):
    setup.servo.start()
    sent: list[bytes] = []

    def transact(data: bytes) -> bytes:
        sent.append(data)
        return b""

    setup.bus.transact = transact
    for command in (goals(float("nan")), goals(0.1, float("inf"))):
        with pytest.raises(NonFiniteError, match="nothing was sent"):
            setup.servo.write(command)
    assert sent == []
