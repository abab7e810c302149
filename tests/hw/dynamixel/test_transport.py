import time

import pytest

from gripper_force.config import ServoConfig
from gripper_force.errors import DeviceError, DeviceLostError, DeviceTimeoutError
from gripper_hw.dynamixel.control_table import REGISTERS, load_model
from gripper_hw.dynamixel.packets import BROADCAST_ID, frame, status
from gripper_hw.dynamixel.pty_server import PtyServer
from gripper_hw.dynamixel.transport import Transport
from gripper_hw.dynamixel.virtual import VirtualBus, VirtualServo

MODEL = load_model("XM430-W350")
START = REGISTERS["present_current"].address
SIZE = 13
TICKS = slice(6, 10)
"""Present Position within the bytes read from there."""


@pytest.fixture
def opened(endpoint):
    """A virtual bus endpoint and an open transport to it."""
    transport = Transport(endpoint.config(), lambda: endpoint.now_ns)
    transport.open()
    yield endpoint, transport
    transport.close()


def first(count, damage):
    """Damages the first answers and lets the others pass."""
    left = iter(range(count))
    return lambda answer: answer if next(left, None) is None else damage(answer)


DAMAGES = {
    "silence": lambda answer: None,
    "truncated": lambda answer: answer[:-3],
    "corrupt": lambda answer: answer[:-1] + bytes((answer[-1] ^ 0x5A,)),
    "short, with valid CRC": lambda answer: frame(BROADCAST_ID, 0x55, b"\x00"),
    "of another size": lambda answer: frame(BROADCAST_ID, 0x55, b"\x00\x01" + bytes(4)),
    "of a missing id": lambda answer: frame(BROADCAST_ID, 0x55, b"\x00\x07" + bytes(15)),
    "of another servo": lambda answer: status(7, 0, bytes(15)),
    "noise": lambda answer: b"\xff\xff\xfd\x00\x01\x00\x00" + bytes(20),
}


@pytest.mark.parametrize(
    ("damage", "count", "make_endpoint"),
    [
        *((damage, count, "memory") for damage in DAMAGES for count in (1, 2)),
        ("silence", 2, "pty"),
        ("truncated", 1, "pty"),
        ("noise", 1, "pty"),
    ],
    indirect=["make_endpoint"],
)
def test_damaged_reply_is_retried_and_counted(opened, damage, count):
    endpoint, transport = opened
    endpoint.bus.tamper = first(count, DAMAGES[damage])
    _, (block,) = transport.sync_read((1,), START, SIZE)
    assert int.from_bytes(block[TICKS], "little") == 2048
    assert transport.stats.retries == count
    assert transport.stats.timeouts + transport.stats.corrupt == count


@pytest.mark.parametrize(
    ("damage", "make_endpoint"),
    [*((damage, "memory") for damage in DAMAGES), ("silence", "pty"), ("corrupt", "pty")],
    indirect=["make_endpoint"],
)
def test_persistent_damage_is_a_timeout(opened, damage):
    endpoint, transport = opened
    endpoint.bus.tamper = DAMAGES[damage]
    with pytest.raises(DeviceTimeoutError, match="after 3 tries"):
        transport.sync_read((1,), START, SIZE)
    assert len(endpoint.packets()) == 3
    endpoint.bus.tamper = None
    transport.sync_read((1,), START, SIZE)  # works again without a restart


def test_short_reply_is_rejected(opened):
    """The SDK pads short data with the packet's CRC."""
    endpoint, transport = opened
    endpoint.bus.tamper = first(1, lambda answer: status(1, 0))
    assert transport.get(1, "present_position") == 2048
    assert transport.stats.retries == 1


def test_noise_before_a_reply_is_skipped(opened):
    endpoint, transport = opened
    endpoint.bus.tamper = lambda answer: b"\x00\xff\xff\x12" + answer
    transport.sync_read((1,), START, SIZE)
    assert transport.get(1, "present_position") == 2048
    assert transport.stats.retries == 0


def test_corrupt_instruction_is_retried(opened):
    endpoint, transport = opened
    for number, call in enumerate(
        (lambda: transport.ping(1), lambda: transport.set(1, "goal_current", 7)), 1
    ):
        endpoint.bus.tamper = first(1, lambda answer: status(1, 3))
        call()
        assert (transport.stats.retries, transport.stats.corrupt) == (number, number)
    assert endpoint.bus.servos[0].get("goal_current") == 7


def test_late_reply_is_not_used_for_the_next_request():
    """The reply arrives after its timeout, when a retry without a pause would still be waiting."""
    firmware = VirtualServo(1, MODEL)
    bus = VirtualBus([firmware], lambda: 0)
    margin_s = 0.2
    with PtyServer(bus) as server:
        transport = Transport(ServoConfig(port=server.device_path, reply_margin_ms=margin_s * 1e3))
        transport.open()

        def delay(answer):
            bus.tamper = None
            firmware.control(0, 1.0, 0.0)  # the horn moves meanwhile
            time.sleep(1.5 * margin_s)
            return answer

        bus.tamper = delay
        _, (block,) = transport.sync_read((1,), START, SIZE)
        assert int.from_bytes(block[TICKS], "little") > 2048
        assert (transport.stats.timeouts, transport.stats.retries) == (1, 1)
        transport.close()


def test_refusal_names_the_error(opened):
    endpoint, transport = opened
    endpoint.bus.servos[0].set("bus_watchdog", -1)
    with pytest.raises(DeviceError, match=r"was refused: error 4 \(data range\); power-cycle"):
        transport.set(1, "goal_current", 1)


def test_sync_write_and_read_map_blocks_to_ids(make_endpoint):
    endpoint = make_endpoint(VirtualServo(1, MODEL), VirtualServo(2, MODEL))
    transport = Transport(endpoint.config(), lambda: endpoint.now_ns)
    transport.open()
    goal = REGISTERS["goal_current"]
    transport.sync_write(goal.address, {2: goal.encode(20), 1: goal.encode(10)})
    assert [transport.get(id_, "goal_current") for id_ in (1, 2)] == [10, 20]
    _, blocks = transport.sync_read((2, 1), goal.address, goal.size)
    assert [goal.decode(block) for block in blocks] == [20, 10]
    assert transport.scan().keys() == {1, 2}
    transport.close()


def test_closed_or_unplugged_port_raises(endpoint):
    transport = Transport(endpoint.config())
    with pytest.raises(DeviceError, match="not open, so a ping of servo 1 was not sent"):
        transport.ping(1)
    transport.open()
    endpoint.unplug()
    with pytest.raises(DeviceLostError, match="gone"):
        transport.ping(1)
    transport.close()
    transport.close()
