"""A bus that the gripper shares with an arm: six more servos, and the arm's program on the same port."""

import threading
from collections.abc import Iterator
from dataclasses import dataclass, field

import pytest
from dynamixel_sdk import (
    COMM_SUCCESS,
    GroupSyncRead,
    GroupSyncWrite,
    PacketHandler,
    PortHandler,
    port_handler,
)

import gripper_force as gf
from gripper_force.errors import (
    ConfigError,
    DeviceError,
    DeviceLostError,
    DeviceNotFoundError,
    DeviceTimeoutError,
)
from gripper_force.interfaces import SharedPort
from gripper_force.types import ServoCommand
from gripper_hw.dynamixel.control_table import REGISTERS, load_model
from gripper_hw.dynamixel.firmware import VirtualServo
from gripper_hw.dynamixel.packets import BROADCAST_ID, Instruction, Packet, Parser
from gripper_hw.dynamixel.pty_server import BenchMotor, PtyServer
from gripper_hw.dynamixel.servo import DynamixelServo
from gripper_hw.dynamixel.virtual import VirtualBus

GRIPPER, ARM = 9, (1, 2, 3, 4, 5, 6)
POSITION, GOAL, TORQUE = (REGISTERS[n] for n in ("present_position", "goal_position", "torque_enable"))


class RecordingBus(VirtualBus):
    """Records all packets."""

    def __init__(self, motors: list[BenchMotor]) -> None:
        super().__init__([motor.servo for motor in motors], before_packet=self._advance)
        self.motors = motors
        self.packets: list[Packet] = []
        self._recorder = Parser()

    def transact(self, data: bytes) -> bytes:
        self.packets += self._recorder.feed(data)
        return super().transact(data)

    def _advance(self) -> None:
        for motor in self.motors:
            motor.advance(self.clock_ns())


@dataclass
class SharedBus:
    """The bus, the arm's port on it, and the arm's program."""

    bus: RecordingBus
    handler: PortHandler
    lock: threading.Lock = field(default_factory=threading.Lock)

    @property
    def port(self) -> SharedPort:
        return SharedPort(self.handler, self.lock)

    def config(self, **values: object) -> gf.ServoConfig:
        tree = {
            "port": self.handler.port_name,
            "id": GRIPPER,
            "reply_margin_ms": 250.0,
            "bus_watchdog_ms": 2540,
        }
        return gf.ServoConfig.model_validate(tree | values)

    def memory(self) -> list[bytes]:
        """Every register below the present values of the arm's servos."""
        with self.bus.lock:
            return [bytes(servo.read(0, 120)[1]) for servo in self.bus.servos if servo.id in ARM]

    def arm_cycles(self, count: int) -> list[int]:
        """The arm's program: reads and writes its servos, and returns the SDK's results."""
        packets = PacketHandler(2.0)
        reader = GroupSyncRead(self.handler, packets, POSITION.address, POSITION.size)
        writer = GroupSyncWrite(self.handler, packets, GOAL.address, GOAL.size)
        for id_ in ARM:
            reader.addParam(id_)
        results = []
        for _ in range(count):
            with self.lock:
                results.append(reader.txRxPacket())
            for id_ in ARM:
                ticks = reader.getData(id_, POSITION.address, POSITION.size)
                writer.addParam(id_, GOAL.encode(ticks + id_))
            with self.lock:
                results.append(writer.txPacket())
            writer.clearParam()
        return results


@pytest.fixture
def shared(monkeypatch: pytest.MonkeyPatch) -> Iterator[SharedBus]:
    monkeypatch.setattr(port_handler, "LATENCY_TIMER", 250)  # of the arm's program, on a busy machine
    gripper = BenchMotor(VirtualServo(GRIPPER, load_model("XM430-W350")))
    arm = [BenchMotor(VirtualServo(id_, load_model("XM540-W270"))) for id_ in ARM]
    with PtyServer(bus := RecordingBus([gripper, *arm])) as server:
        handler = PortHandler(server.device_path)
        assert handler.openPort()
        yield SharedBus(bus, handler)
        handler.closePort()


@pytest.fixture
def servo(shared: SharedBus) -> Iterator[DynamixelServo]:
    servo = DynamixelServo(shared.config(), port=shared.port)
    yield servo
    servo.close()


def addressed(packet: Packet) -> set[int]:
    """Ids that a packet reads or writes."""
    if packet.id != BROADCAST_ID:
        return {packet.id}
    match packet.instruction:
        case Instruction.SYNC_READ | Instruction.FAST_SYNC_READ:
            return set(packet.params[4:])
        case Instruction.SYNC_WRITE:
            return set(packet.params[4 :: 1 + int.from_bytes(packet.params[2:4], "little")])
    return {BROADCAST_ID}


@pytest.mark.parametrize("firmware", [52, 44])
def test_packets_address_only_the_gripper(shared: SharedBus, servo: DynamixelServo, firmware: int) -> None:
    shared.bus.servos[0].set("firmware_version", firmware)
    for arm_servo in shared.bus.servos[1:]:
        arm_servo.set("torque_enable", 1)
        arm_servo.set("status_return_level", 1)
    before = shared.memory()
    for hold in (False, True):
        state = servo.start()
        for _ in range(5):
            servo.write(ServoCommand(0, state.position_rad + 0.1, 0.4))
            servo.read()
        servo.stop(hold=hold)
    servo.close()
    assert {id_ for packet in shared.bus.packets for id_ in addressed(packet)} == {GRIPPER}
    assert len(shared.bus.packets) > 50
    assert shared.memory() == before
    assert shared.bus.servos[0].get("torque_enable") == 1


def test_arm_and_gripper_take_turns(shared: SharedBus, servo: DynamixelServo) -> None:
    results: list[int] = []
    state = servo.start()
    arm = threading.Thread(target=lambda: results.extend(shared.arm_cycles(60)))
    arm.start()
    for _ in range(120):
        servo.write(ServoCommand(0, state.position_rad, 0.0))
        state = servo.read()
    arm.join()
    assert results == [COMM_SUCCESS] * 120
    assert (servo.stats.retries, servo.stats.timeouts, servo.stats.corrupt) == (0, 0, 0)
    ids = {frozenset(addressed(packet)) for packet in shared.bus.packets}
    assert ids == {frozenset((GRIPPER,)), frozenset(ARM)}
    servo.stop(hold=False)


def test_reply_that_the_arms_program_left_is_skipped(shared: SharedBus, servo: DynamixelServo) -> None:
    servo.start()
    for id_, length in ((1, 13), (GRIPPER, 4)):
        with shared.lock:
            PacketHandler(2.0).readTx(shared.handler, id_, 132, length)
            shared.handler.is_using = False  # given up before the reply came
        assert servo.read().position_rad == pytest.approx(0.0, abs=1e-3)
    servo.stop(hold=False)


def test_lock_that_is_never_free_is_named(shared: SharedBus) -> None:
    servo = DynamixelServo(shared.config(bus_watchdog_ms=20), port=shared.port)
    with shared.lock, pytest.raises(DeviceTimeoutError, match=r"its lock was not free for 20 ms"):
        servo.start()
    assert shared.bus.packets == []
    shared.lock.acquire()  # the driver has not kept it
    shared.lock.release()


def test_closing_the_gripper_leaves_the_port_open(shared: SharedBus, servo: DynamixelServo) -> None:
    baud_rate = shared.handler.getBaudRate()
    servo.start()
    servo.stop(hold=False)
    servo.close()
    assert shared.arm_cycles(2) == [COMM_SUCCESS] * 4
    assert (shared.handler.is_open, shared.handler.getBaudRate()) == (True, baud_rate)


def test_port_that_its_owner_closes_is_lost(shared: SharedBus, servo: DynamixelServo) -> None:
    servo.start()
    shared.handler.closePort()
    for _ in range(2):
        with pytest.raises(DeviceLostError, match=r"shared port .* is gone or closed"):
            servo.read()
    assert not shared.lock.locked()
    shared.handler.openPort()
    servo.stop(hold=False)


def test_port_that_is_not_open_is_refused(shared: SharedBus) -> None:
    servo = DynamixelServo(shared.config(), port=SharedPort(PortHandler("/dev/ttyUSB7"), shared.lock))
    with pytest.raises(DeviceError, match=r"is not open; call its openPort\(\) first"):
        servo.start()


# The public interface.


def test_gripper_on_a_shared_port(shared: SharedBus) -> None:
    shared.arm_cycles(1)
    overrides = {
        "clock": "realtime",
        "servo.port": shared.handler.port_name,
        "servo.id": GRIPPER,
        "servo.bus_watchdog_ms": 2540,
        "servo.reply_margin_ms": 250,
        "camera.backend": "none",
        "vision.checkpoint": "none",
        "control.feedback": "current",
        "load_cell.backend": "none",
    }
    with gf.open_gripper(overrides=overrides, port=shared.handler, port_lock=shared.lock) as gripper:
        gripper.move(0.05, wait=False)
        assert shared.arm_cycles(40) == [COMM_SUCCESS] * 80
        assert shared.bus.servos[0].get("torque_enable") == 1
        assert gripper.width_m <= gripper.config.gripper.open_width_m + 1e-3
    assert [servo.get("torque_enable") for servo in shared.bus.servos] == [0] * 7
    ids = {frozenset(addressed(packet)) for packet in shared.bus.packets}
    assert ids == {frozenset((GRIPPER,)), frozenset(ARM)}
    assert shared.handler.is_open


def test_a_servo_that_does_not_answer_is_not_blamed_on_a_key_without_effect(shared: SharedBus) -> None:
    """The owner of a shared port sets its baud rate; `servo.baud_rate` has no effect."""
    servo = DynamixelServo(shared.config(id=33, reply_margin_ms=5.0, retries=0), port=shared.port)
    with pytest.raises(
        DeviceNotFoundError,
        match=r"does not answer at the shared port's baud rate; check its power, servo\.id and the rate that your "
        r"program sets by setBaudRate\(\)$",
    ):
        servo.start()


def test_port_without_lock_is_refused(shared: SharedBus) -> None:
    with pytest.raises(ConfigError, match="pass both"):
        gf.open_gripper(port=shared.handler)
    with pytest.raises(ConfigError, match="pass both"):
        gf.open_gripper(port_lock=shared.lock)


def test_what_is_no_port_or_no_lock_is_refused(shared: SharedBus) -> None:
    with pytest.raises(ConfigError, match="needs port, an open PortHandler"):
        gf.open_gripper(port="/dev/ttyUSB0", port_lock=shared.lock)
    with pytest.raises(ConfigError, match="and port_lock, a Lock"):
        gf.open_gripper(port=shared.handler, port_lock=True)  # type: ignore[arg-type]
    assert shared.bus.packets == []


@pytest.mark.parametrize("key", ["servo.port=virtual:rig", "servo.backend=mine"])
def test_port_for_another_servo_is_refused(shared: SharedBus, key: str, quick: list[str]) -> None:
    overrides = [*quick, "servo.port=/dev/ttyUSB0", "load_cell.backend=none", "clock=realtime", key]
    with pytest.raises(ConfigError):
        gf.open_gripper(overrides=overrides, port=shared.handler, port_lock=shared.lock)
    assert shared.bus.packets == []
