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
"""Where Present Position lies in what is read from there."""


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
    "short, yet sound": lambda answer: frame(BROADCAST_ID, 0x55, b"\x00"),
    "of another size": lambda answer: frame(BROADCAST_ID, 0x55, b"\x00\x01" + bytes(4)),
    "of nobody": lambda answer: frame(BROADCAST_ID, 0x55, b"\x00\x07" + bytes(15)),
    "of another servo": lambda answer: status(7, 0, bytes(15)),
    "noise": lambda answer: b"\xff\xff\xfd\x00\x01\x00\x00" + bytes(20),
}


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("count", [1, 2])
def test_a_damaged_answer_is_retried_and_counted(opened, damage, count):
    endpoint, transport = opened
    endpoint.bus.tamper = first(count, DAMAGES[damage])
    _, (block,) = transport.sync_read((1,), START, SIZE)
    assert int.from_bytes(block[TICKS], "little") == 2048
    assert transport.stats.retries == count
    assert transport.stats.timeouts + transport.stats.corrupt == count


@pytest.mark.parametrize("damage", DAMAGES)
def test_damage_without_end_is_a_timeout(opened, damage):
    endpoint, transport = opened
    endpoint.bus.tamper = DAMAGES[damage]
    with pytest.raises(DeviceTimeoutError, match="after 3 tries"):
        transport.sync_read((1,), START, SIZE)
    assert len(endpoint.packets()) == 3
    endpoint.bus.tamper = None
    transport.sync_read((1,), START, SIZE)  # it comes back by itself


def test_an_answer_that_is_too_short_is_no_value(opened):
    """The SDK fills short data up with the packet's CRC."""
    endpoint, transport = opened
    endpoint.bus.tamper = first(1, lambda answer: status(1, 0))
    assert transport.get(1, "present_position") == 2048
    assert transport.stats.retries == 1


def test_noise_before_an_answer_is_skipped(opened):
    endpoint, transport = opened
    endpoint.bus.tamper = lambda answer: b"\x00\xff\xff\x12" + answer
    transport.sync_read((1,), START, SIZE)
    assert transport.get(1, "present_position") == 2048
    assert transport.stats.retries == 0


def test_an_instruction_damaged_on_its_way_is_retried(opened):
    endpoint, transport = opened
    for number, call in enumerate(
        (lambda: transport.ping(1), lambda: transport.set(1, "goal_current", 7)), 1
    ):
        endpoint.bus.tamper = first(1, lambda answer: status(1, 3))
        call()
        assert (transport.stats.retries, transport.stats.corrupt) == (number, number)
    assert endpoint.bus.servos[0].get("goal_current") == 7


def test_a_late_answer_is_not_taken_for_the_next():
    """It comes after the time for it is over and before a retry without a pause would have had its own."""
    firmware = VirtualServo(1, MODEL)
    bus = VirtualBus([firmware], lambda: 0)
    margin_s = 0.2
    with PtyServer(bus) as server:
        transport = Transport(ServoConfig(port=server.device_path, reply_margin_ms=margin_s * 1e3))
        transport.open()

        def delay(answer):
            bus.tamper = None
            firmware.control(0, 1.0, 0.0)  # the world moves on
            time.sleep(1.5 * margin_s)
            return answer

        bus.tamper = delay
        _, (block,) = transport.sync_read((1,), START, SIZE)
        assert int.from_bytes(block[TICKS], "little") > 2048
        assert (transport.stats.timeouts, transport.stats.retries) == (1, 1)
        transport.close()


def test_a_servo_that_refuses_says_what(opened):
    endpoint, transport = opened
    endpoint.bus.servos[0].set("bus_watchdog", -1)
    with pytest.raises(DeviceError, match="data range error"):
        transport.set(1, "goal_current", 1)


def test_blocks_go_to_the_servo_that_they_are_for(make_endpoint):
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


def test_nothing_is_sent_without_a_port(endpoint):
    transport = Transport(endpoint.config())
    with pytest.raises(DeviceError, match="not open, so a ping of servo 1 was not sent"):
        transport.ping(1)
    transport.open()
    endpoint.unplug()
    with pytest.raises(DeviceLostError, match="gone"):
        transport.ping(1)
    transport.close()
    transport.close()
